// CUDA implementations of what contact leaves of an acceleration.
#include "../unsupported.h"

#include <torch/csrc/stable/accelerator.h>
#include <torch/csrc/stable/library.h>

#include <tuple>
#include <vector>

#include "../../cuda/contact.h"
#include "binding.h"

namespace {

namespace cuda = diffvbd::cuda;
using cuda::check, cuda::current_stream, cuda::empty, cuda::Zeroed;
using diffvbd::data, diffvbd::dispatch_float;
using torch::stable::Tensor;
using torch::stable::accelerator::DeviceGuard;

Tensor contact_unsupported(const Tensor& x, const Tensor& origin, const Tensor& lift, const Tensor& force,
                           const Tensor& mass, const Tensor& planes, const Tensor& held_bodies,
                           const Tensor& body_order, const Tensor& body_ptr, double time_step) {
  const DeviceGuard guard(x.get_device_index());
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::unsupported_inputs<T>(
        {x, origin, lift, force, mass, planes, held_bodies, body_order, body_ptr}, time_step);
    Tensor out = empty(x, {in.scene.scenes, in.scene.vertices, 3});
    check(cuda::residual_acceleration<T>(in, data<T>(out), current_stream(x)),
          "what contact leaves of an acceleration");
    return out;
  });
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> contact_unsupported_backward(
    const Tensor& bar, const Tensor& x, const Tensor& origin, const Tensor& lift, const Tensor& force,
    const Tensor& mass, const Tensor& planes, const Tensor& held_bodies, const Tensor& body_order,
    const Tensor& body_ptr, double time_step, bool wants_planes) {
  const DeviceGuard guard(x.get_device_index());
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::unsupported_inputs<T>(
        {x, origin, lift, force, mass, planes, held_bodies, body_order, body_ptr}, time_step);
    diffvbd::require_like("bar", bar, x, 3 * in.scene.scenes * in.scene.vertices);
    Zeroed zeros(x);
    const diffvbd::UnsupportedBars bars(
        in, wants_planes, [&](const std::vector<int64_t>& sizes) { return empty(x, sizes); }, zeros);
    zeros.clear();
    check(cuda::residual_acceleration_backward<T>(in, data<const T>(bar), bars.pointers<T>(), current_stream(x)),
          "what contact leaves of an acceleration");
    return bars.tensors();
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CUDA, m) {
  m.impl("contact_unsupported", TORCH_BOX(&contact_unsupported));
  m.impl("contact_unsupported_backward", TORCH_BOX(&contact_unsupported_backward));
}
