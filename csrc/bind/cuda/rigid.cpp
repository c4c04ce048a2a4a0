// CUDA implementations of the rigid correction.
#include "../rigid.h"

#include <torch/csrc/stable/accelerator.h>
#include <torch/csrc/stable/library.h>

#include <tuple>
#include <vector>

#include "../../cuda/bodies.h"
#include "bodies.h"

namespace {

namespace cuda = diffvbd::cuda;
namespace rigid = diffvbd::rigid;
using cuda::check, cuda::current_stream, cuda::empty, cuda::groups_of, cuda::workspace_of, cuda::Zeroed;
using diffvbd::data, diffvbd::dispatch_float, diffvbd::RigidFields;
using torch::stable::Tensor;
using torch::stable::accelerator::DeviceGuard;

std::tuple<Tensor, Tensor> correct(DIFFVBD_PARAMETERS(RIGID) std::vector<int64_t> groups,
                                   std::vector<int64_t> data_count, double time_step) {
  const RigidFields f{DIFFVBD_ITEMS(RIGID)};
  const DeviceGuard guard(x.get_device_index());
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::rigid_inputs<T>(f, data_count, time_step);
    const auto teams = groups_of(groups, f.spread.numel());
    const Tensor out = empty(x, {in.scenes, in.vertices, 3}), v = empty(x, {in.scenes, in.vertices, 3});
    const Tensor workspace = workspace_of(teams, x);
    check(cuda::rigid_correct<T>(in, teams, order.numel() < in.vertices, data<T>(out), data<T>(v),
                                 data<double>(workspace), current_stream(x)),
          "the rigid correction");
    return std::make_tuple(out, v);
  });
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> correct_backward(
    DIFFVBD_PARAMETERS(RIGID) const Tensor& x_bar, const Tensor& v_bar, std::vector<int64_t> groups,
    std::vector<int64_t> data_count, double time_step, bool wants_data) {
  const RigidFields f{DIFFVBD_ITEMS(RIGID)};
  const DeviceGuard guard(x.get_device_index());
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::rigid_inputs<T>(f, data_count, time_step);
    const auto teams = groups_of(groups, f.spread.numel());
    const Tensor workspace = workspace_of(teams, x);
    Zeroed zeros(x);
    const diffvbd::RigidBars bars(
        in, data_count, v_bar.numel() > 0, wants_data,
        [&](const std::vector<int64_t>& shape, bool zeroed) { return zeroed ? zeros(shape) : empty(x, shape); });
    zeros.clear();
    check(cuda::rigid_reverse<T>(in, teams, order.numel() < in.vertices, bars.pointers<T>(x_bar, v_bar),
                                 data<double>(workspace), current_stream(x)),
          "the adjoint of the rigid correction");
    return bars.tensors();
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CUDA, m) {
  m.impl("rigid", TORCH_BOX(&correct));
  m.impl("rigid_backward", TORCH_BOX(&correct_backward));
}
