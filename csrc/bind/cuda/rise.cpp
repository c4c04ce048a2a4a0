// CUDA implementation of the rise of the potentials of bodies.
#include "../rise.h"

#include <torch/csrc/stable/accelerator.h>
#include <torch/csrc/stable/library.h>

#include <vector>

#include "../../cuda/bodies.h"
#include "binding.h"

namespace {

namespace cuda = diffvbd::cuda;
using diffvbd::data, diffvbd::dispatch_float;
using torch::headeronly::ScalarType;
using torch::stable::Tensor;
using torch::stable::accelerator::DeviceGuard;

Tensor potential_rise(const Tensor& x, const Tensor& to, const Tensor& x_prev, const Tensor& y, const Tensor& mass,
                      const Tensor& energy_data, const Tensor& origin, const Tensor& material, const Tensor& rest,
                      const Tensor& order, const Tensor& ptr, const Tensor& other, const Tensor& corner,
                      const Tensor& block_ptr, std::vector<int64_t> data_count, double time_step) {
  const DeviceGuard guard(x.get_device_index());
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::rise_inputs<T>({x, x_prev, y, mass, energy_data, origin, order, ptr, order, other}, to,
                                            material, rest, corner, block_ptr, data_count, time_step);
    const Tensor out = cuda::empty(x, {in.bodies.scenes, in.bodies.bodies, 2}, ScalarType::Double);
    const Tensor work = cuda::empty(x, {cuda::energy_increase_workspace(in)}, ScalarType::Double);
    cuda::check(cuda::energy_increase(in, data<double>(work), data<double>(out), cuda::current_stream(x)),
                "the rise of potentials");
    return out;
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CUDA, m) { m.impl("potential_rise", TORCH_BOX(&potential_rise)); }
