// CPU implementations of the rigid correction: bodies side by side, or the vertices of a large one.
#include "../rigid.h"

#include <torch/csrc/stable/library.h>

#include <tuple>
#include <vector>

#include "../../cpu/threads.h"
#include "sweep.h"

namespace {

namespace rigid = diffvbd::rigid;
using diffvbd::data, diffvbd::dispatch_float, diffvbd::empty, diffvbd::for_bodies, diffvbd::for_vertices,
    diffvbd::RigidFields, diffvbd::Threads, diffvbd::zeros;
using torch::stable::Tensor;

template <class T>
bool has_energies(const rigid::Inputs<T>& in) {
  return in.data.data != nullptr;
}

std::tuple<Tensor, Tensor> correct(DIFFVBD_PARAMETERS(RIGID) std::vector<int64_t> /*groups*/,
                                   std::vector<int64_t> data_count, double time_step) {
  const RigidFields f{DIFFVBD_ITEMS(RIGID)};
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::rigid_inputs<T>(f, data_count, time_step);
    const Tensor out = empty(x, {in.scenes, in.vertices, 3}), v = empty(x, {in.scenes, in.vertices, 3});
    T *to = data<T>(out), *velocity = data<T>(v);
    if (order.numel() < in.vertices) {
      for_vertices(in, [&](int64_t scene, int32_t i) { keep_vertex(in, scene, i, to, velocity); });
    }
    for_bodies(in, [&](const rigid::Body<T>& body, const Threads& team) {
      rigid::Iteration record[rigid::kMaxIterations];
      if (has_energies(in)) {
        rigid::correct<true>(body, team, record, to, velocity);
      } else {
        rigid::correct<false>(body, team, record, to, velocity);
      }
    });
    return std::make_tuple(out, v);
  });
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> correct_backward(
    DIFFVBD_PARAMETERS(RIGID) const Tensor& x_bar, const Tensor& v_bar, std::vector<int64_t> /*groups*/,
    std::vector<int64_t> data_count, double time_step, bool wants_data) {
  const RigidFields f{DIFFVBD_ITEMS(RIGID)};
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::rigid_inputs<T>(f, data_count, time_step);
    const diffvbd::RigidBars bars(
        in, data_count, v_bar.numel() > 0, wants_data,
        [&](const std::vector<int64_t>& shape, bool zeroed) { return zeroed ? zeros(x, shape) : empty(x, shape); });
    const auto a = bars.pointers<T>(x_bar, v_bar);
    if (order.numel() < in.vertices) {
      for_vertices(in, [&](int64_t scene, int32_t i) { reverse_kept(in, a, scene, i); });
    }
    for_bodies(in, [&](const rigid::Body<T>& body, const Threads& team) {
      rigid::Iteration record[rigid::kMaxIterations];
      if (has_energies(in)) {
        rigid::reverse<true>(body, team, record, a);
      } else {
        rigid::reverse<false>(body, team, record, a);
      }
    });
    return bars.tensors();
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CPU, m) {
  m.impl("rigid", TORCH_BOX(&correct));
  m.impl("rigid_backward", TORCH_BOX(&correct_backward));
}
