// CUDA implementations of the rigid correction.
#include <torch/csrc/stable/accelerator.h>
#include <torch/csrc/stable/library.h>

#include <tuple>
#include <vector>

#include "arguments_rigid.h"
#include "binding_cuda.h"
#include "cuda/rigid.h"

namespace {

namespace cuda = diffvbd::cuda;
namespace rigid = diffvbd::rigid;
using cuda::check, cuda::current_stream, cuda::empty, cuda::zeros;
using diffvbd::data, diffvbd::dispatch_float, diffvbd::require, diffvbd::RigidTensors;
using torch::headeronly::ScalarType;
using torch::stable::Tensor;
using torch::stable::accelerator::DeviceGuard;

cuda::RigidGroups groups_of(const std::vector<int64_t>& groups, const Tensor& spread) {
  require(groups.size() == 3 && groups[0] + groups[1] + groups[2] == spread.numel(),
          "diffvbd::rigid: expected three groups of bodies");
  return {static_cast<int32_t>(groups[0]), static_cast<int32_t>(groups[1]), static_cast<int32_t>(groups[2])};
}

Tensor workspace_of(const cuda::RigidGroups& groups, const Tensor& x) {
  return empty(x, {cuda::rigid_workspace(groups, x.size(0))}, ScalarType::Double);
}

void copy(const Tensor& from, const Tensor& to) {
  const size_t bytes = from.numel() * (from.scalar_type() == ScalarType::Double ? sizeof(double) : sizeof(float));
  if (bytes > 0) {
    check(cudaMemcpyAsync(to.data_ptr(), from.data_ptr(), bytes, cudaMemcpyDeviceToDevice, current_stream(from)),
          "a copy");
  }
}

Tensor correct(const Tensor& x, const Tensor& x_prev, const Tensor& y, const Tensor& mass, const Tensor& energy_data,
               const Tensor& origin, const Tensor& order, const Tensor& ptr, const Tensor& spread,
               std::vector<int64_t> groups, std::vector<int64_t> data_count, double time_step) {
  const DeviceGuard guard(x.get_device_index());
  const RigidTensors given{x, x_prev, y, mass, energy_data, origin, order, ptr, spread};
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::rigid_inputs<T>(given, data_count, time_step);
    const auto teams = groups_of(groups, spread);
    Tensor out = empty(x, {in.scenes, in.vertices, 3});
    const Tensor workspace = workspace_of(teams, x);
    if (order.numel() < in.vertices) copy(x, out);
    check(cuda::rigid_correct<T>(in, teams, data<T>(out), data<double>(workspace), current_stream(x)),
          "the rigid correction");
    return out;
  });
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> correct_backward(
    const Tensor& x_bar, const Tensor& x, const Tensor& x_prev, const Tensor& y, const Tensor& mass,
    const Tensor& energy_data, const Tensor& origin, const Tensor& order, const Tensor& ptr, const Tensor& spread,
    std::vector<int64_t> groups, std::vector<int64_t> data_count, double time_step, bool wants_data) {
  const DeviceGuard guard(x.get_device_index());
  const RigidTensors given{x, x_prev, y, mass, energy_data, origin, order, ptr, spread};
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::rigid_inputs<T>(given, data_count, time_step);
    const auto teams = groups_of(groups, spread);
    const Tensor workspace = workspace_of(teams, x);
    const diffvbd::RigidBars bars(
        given, in, data_count, wants_data,
        [&](const std::vector<int64_t>& shape, bool zeroed) { return zeroed ? zeros(x, shape) : empty(x, shape); });
    if (!bars.all) copy(x_bar, bars.x);
    check(cuda::rigid_reverse<T>(in, teams, bars.pointers<T>(x_bar), data<double>(workspace), current_stream(x)),
          "the adjoint of the rigid correction");
    return bars.tensors();
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CUDA, m) {
  m.impl("rigid", TORCH_BOX(&correct));
  m.impl("rigid_backward", TORCH_BOX(&correct_backward));
}
