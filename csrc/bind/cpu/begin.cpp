// CPU implementation of the beginning of a step.
#include "../begin.h"

#include <torch/csrc/stable/library.h>

#include <tuple>
#include <vector>

#include "../../cpu/threads.h"
#include "sweep.h"

namespace {

namespace rigid = diffvbd::rigid;
namespace start = diffvbd::start;
using diffvbd::BeginSettings, diffvbd::BeginFields, diffvbd::data, diffvbd::dispatch_float, diffvbd::empty,
    diffvbd::for_bodies, diffvbd::for_vertices, diffvbd::Threads, diffvbd::zeros;
using torch::stable::Tensor;

std::tuple<Tensor, Tensor, Tensor, Tensor> begin(DIFFVBD_PARAMETERS(BEGIN) std::vector<int64_t> /*groups*/,
                                                 std::vector<int64_t> /*other_groups*/, std::vector<int64_t> data_count,
                                                 double time_step, double filter_eta, double chord, int64_t from,
                                                 bool filters, bool parts) {
  const BeginFields f{DIFFVBD_ITEMS(BEGIN)};
  diffvbd::require_states(f);
  const BeginSettings settings{data_count, time_step, filter_eta, chord, from, filters};
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const std::vector<int64_t> shape{x.size(0), x.size(1), 3};
    const bool chooses = from == start::kLower && diffvbd::other_bodies(f) > 0;
    const Tensor x_start = empty(x, shape), y = empty(x, shape);
    const Tensor from_y = chooses && filters ? empty(x, shape) : y;
    const auto decisions = [&](bool made, int64_t bodies) {
      return torch::stable::new_empty(x, {made ? x.size(0) : 0, bodies}, std::make_optional(diffvbd::ScalarType::Byte));
    };
    const Tensor falls = decisions(from == start::kLower, diffvbd::other_bodies(f));
    const Tensor alone = decisions(parts, diffvbd::corrected_bodies(f));
    const auto in = diffvbd::begin_inputs<T>(f, settings, x_start, y, falls, alone);
    T *to = data<T>(x_start), *to_y = data<T>(y), *to_other = data<T>(from_y);
    if (in.some_alone) {
      T* second = chooses && filters ? to_other : nullptr;
      for_vertices(in.bodies, [&](int64_t scene, int32_t i) { begin_vertex(in, to, second, to_y, scene, i); });
    }
    if (chooses) {
      const auto two = diffvbd::candidates<T>(f, settings, false, x_start, from_y, y);
      uint8_t* chosen = data<uint8_t>(falls);
      for_bodies(two.bodies, [&](const rigid::Body<T>& body, const Threads& team) {
        chosen[body.scene * in.others + body.body] = start::path_between(two, body, team).increase <= 0;
      });
      for_vertices(in.bodies, [&](int64_t scene, int32_t i) { choose_vertex(in, to, to_other, scene, i); });
    }
    uint8_t* parted = parts ? data<uint8_t>(alone) : nullptr;
    for_bodies(in.bodies, [&](const rigid::Body<T>& body, const Threads& team) {
      if (in.bodies.data.data != nullptr) {
        start::begin_body<true>(in, body, team, to, to_y, parted);
      } else {
        start::begin_body<false>(in, body, team, to, to_y, parted);
      }
    });
    if (parts && diffvbd::corrected_bodies(f) > 0) {
      const Tensor apart = empty(x, shape);
      const auto two = diffvbd::candidates<T>(f, settings, true, x_start, apart, y);
      for_bodies(two.bodies, [&](const rigid::Body<T>& body, const Threads& team) {
        start::release_body(in, two, body, team, to, data<T>(apart), parted);
      });
    }
    return std::make_tuple(x_start, y, falls, alone);
  });
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> begin_backward(
    DIFFVBD_PARAMETERS(BEGIN) const Tensor& x_start_bar, const Tensor& y_bar, const Tensor& falls, const Tensor& alone,
    std::vector<int64_t> /*groups*/, std::vector<int64_t> data_count, double time_step, double filter_eta, double chord,
    int64_t from, bool filters, std::vector<bool> wants) {
  const BeginFields f{DIFFVBD_ITEMS(BEGIN)};
  diffvbd::require_states(f);
  const BeginSettings settings{data_count, time_step, filter_eta, chord, from, filters};
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    // where the bodies that are corrected coast to, and their predictor, once more
    const std::vector<int64_t> shape{x.size(0), x.size(1), 3};
    const Tensor coasted = order.numel() > 0 ? empty(x, shape) : x, y = order.numel() > 0 ? empty(x, shape) : x;
    const auto in = diffvbd::begin_inputs<T>(f, settings, coasted, y, falls, alone);
    const diffvbd::BeginBars bars(f, in, wants, [&](const std::vector<int64_t>& sizes, bool zeroed) {
      return zeroed ? zeros(x, sizes) : empty(x, sizes);
    });
    const auto a = bars.pointers<T>(x_start_bar, y_bar);
    if (in.some_alone) {
      for_vertices(in.bodies, [&](int64_t scene, int32_t i) { reverse_vertex(in, a, scene, i); });
    }
    T *to = data<T>(coasted), *to_y = data<T>(y);
    for_bodies(in.bodies, [&](const rigid::Body<T>& body, const Threads& team) {
      rigid::Iteration record[rigid::kMaxIterations];
      if (in.bodies.data.data != nullptr) {
        start::reverse_body<true>(in, body, team, record, to, to_y, a);
      } else {
        start::reverse_body<false>(in, body, team, record, to, to_y, a);
      }
    });
    return bars.tensors();
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CPU, m) {
  m.impl("begin", TORCH_BOX(&begin));
  m.impl("begin_backward", TORCH_BOX(&begin_backward));
}
