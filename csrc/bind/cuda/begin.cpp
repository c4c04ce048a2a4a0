// CUDA implementation of the beginning of a step.
#include "../begin.h"

#include <torch/csrc/stable/accelerator.h>
#include <torch/csrc/stable/library.h>

#include <tuple>
#include <vector>

#include "../../cuda/bodies.h"
#include "bodies.h"

namespace {

namespace cuda = diffvbd::cuda;
namespace start = diffvbd::start;
using cuda::check, cuda::current_stream, cuda::empty, cuda::groups_of, cuda::workspace_of, cuda::Zeroed;
using diffvbd::BeginSettings, diffvbd::BeginFields, diffvbd::data, diffvbd::dispatch_float;
using torch::headeronly::ScalarType;
using torch::stable::Tensor;
using torch::stable::accelerator::DeviceGuard;

std::tuple<Tensor, Tensor, Tensor, Tensor> begin(DIFFVBD_PARAMETERS(BEGIN) std::vector<int64_t> groups,
                                                 std::vector<int64_t> other_groups, std::vector<int64_t> data_count,
                                                 double time_step, double filter_eta, double chord, int64_t from,
                                                 bool filters, bool parts) {
  const BeginFields f{DIFFVBD_ITEMS(BEGIN)};
  diffvbd::require_states(f);
  const DeviceGuard guard(x.get_device_index());
  const BeginSettings settings{data_count, time_step, filter_eta, chord, from, filters};
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const std::vector<int64_t> shape{x.size(0), x.size(1), 3};
    const bool chooses = from == start::kLower && diffvbd::other_bodies(f) > 0;
    const Tensor x_start = empty(x, shape), y = empty(x, shape);
    const Tensor from_y = chooses && filters ? empty(x, shape) : y;
    const bool may_part = parts && diffvbd::corrected_bodies(f) > 0;
    const Tensor apart = may_part ? empty(x, shape) : y;
    const Tensor falls = empty(x, {from == start::kLower ? x.size(0) : 0, diffvbd::other_bodies(f)}, ScalarType::Byte);
    const Tensor alone = empty(x, {parts ? x.size(0) : 0, diffvbd::corrected_bodies(f)}, ScalarType::Byte);
    const auto in = diffvbd::begin_inputs<T>(f, settings, x_start, y, falls, alone);
    const auto teams = groups_of(groups, f.spread.numel());
    const auto other_teams = groups_of(other_groups, diffvbd::other_bodies(f));
    const Tensor workspace = workspace_of(teams, x), other_workspace = workspace_of(other_teams, x);
    const Tensor& shared = workspace.numel() > 0 ? workspace : other_workspace;
    start::Candidates<T> two{}, parting{};
    if (chooses) two = diffvbd::candidates<T>(f, settings, false, x_start, from_y, y);
    if (may_part) parting = diffvbd::candidates<T>(f, settings, true, x_start, apart, y);
    const cuda::StartChoice<T> of_others{chooses ? &two : nullptr, data<T>(from_y), data<uint8_t>(falls)};
    const cuda::StartChoice<T> of_corrected{may_part ? &parting : nullptr, data<T>(apart), data<uint8_t>(alone)};
    check(cuda::begin<T>(in, teams, of_corrected, other_teams, of_others, data<T>(x_start), data<T>(y),
                         data<double>(shared), current_stream(x)),
          "the beginning of a step");
    return std::make_tuple(x_start, y, falls, alone);
  });
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> begin_backward(
    DIFFVBD_PARAMETERS(BEGIN) const Tensor& x_start_bar, const Tensor& y_bar, const Tensor& falls, const Tensor& alone,
    std::vector<int64_t> groups, std::vector<int64_t> data_count, double time_step, double filter_eta, double chord,
    int64_t from, bool filters, std::vector<bool> wants) {
  const BeginFields f{DIFFVBD_ITEMS(BEGIN)};
  diffvbd::require_states(f);
  const DeviceGuard guard(x.get_device_index());
  const BeginSettings settings{data_count, time_step, filter_eta, chord, from, filters};
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    // where the bodies that are corrected coast to, and their predictor, once more
    const std::vector<int64_t> shape{x.size(0), x.size(1), 3};
    const Tensor coasted = order.numel() > 0 ? empty(x, shape) : x, y = order.numel() > 0 ? empty(x, shape) : x;
    const auto in = diffvbd::begin_inputs<T>(f, settings, coasted, y, falls, alone);
    const auto teams = groups_of(groups, f.spread.numel());
    const Tensor workspace = workspace_of(teams, x);
    Zeroed zeros(x);
    const diffvbd::BeginBars bars(f, in, wants, [&](const std::vector<int64_t>& sizes, bool zeroed) {
      return zeroed ? zeros(sizes) : empty(x, sizes);
    });
    zeros.clear();
    check(cuda::begin_backward<T>(in, teams, bars.pointers<T>(x_start_bar, y_bar), data<T>(coasted), data<T>(y),
                                  data<double>(workspace), current_stream(x)),
          "the adjoint of the beginning of a step");
    return bars.tensors();
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CUDA, m) {
  m.impl("begin", TORCH_BOX(&begin));
  m.impl("begin_backward", TORCH_BOX(&begin_backward));
}
