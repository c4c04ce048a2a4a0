// CPU implementations of what contact leaves of an acceleration.
#include "../unsupported.h"

#include <torch/csrc/stable/library.h>

#include <tuple>
#include <vector>

#include "../../cpu/threads.h"
#include "sweep.h"

namespace {

namespace contact = diffvbd::contact;
namespace rigid = diffvbd::rigid;
using diffvbd::data, diffvbd::dispatch_float, diffvbd::empty, diffvbd::for_bodies, diffvbd::Threads, diffvbd::zeros;
using torch::stable::Tensor;

Tensor contact_unsupported(const Tensor& x, const Tensor& origin, const Tensor& lift, const Tensor& force,
                           const Tensor& mass, const Tensor& planes, const Tensor& held_bodies,
                           const Tensor& body_order, const Tensor& body_ptr, double time_step) {
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::unsupported_inputs<T>(
        {x, origin, lift, force, mass, planes, held_bodies, body_order, body_ptr}, time_step);
    Tensor out = empty(x, {in.scene.scenes, in.scene.vertices, 3});
    for_bodies(in.scene, [&](const rigid::Body<T>& b, const Threads& team) {
      contact::residual_acceleration(in, b, team, data<T>(out));
    });
    return out;
  });
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> contact_unsupported_backward(
    const Tensor& bar, const Tensor& x, const Tensor& origin, const Tensor& lift, const Tensor& force,
    const Tensor& mass, const Tensor& planes, const Tensor& held_bodies, const Tensor& body_order,
    const Tensor& body_ptr, double time_step, bool wants_planes) {
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::unsupported_inputs<T>(
        {x, origin, lift, force, mass, planes, held_bodies, body_order, body_ptr}, time_step);
    diffvbd::require_like("bar", bar, x, 3 * in.scene.scenes * in.scene.vertices);
    const diffvbd::UnsupportedBars bars(
        in, wants_planes, [&](const std::vector<int64_t>& sizes) { return empty(x, sizes); },
        [&](const std::vector<int64_t>& sizes) { return zeros(x, sizes); });
    const auto out = bars.pointers<T>();
    for_bodies(in.scene, [&](const rigid::Body<T>& b, const Threads& team) {
      contact::reverse_residual_acceleration(in, b, team, data<const T>(bar), out);
    });
    return bars.tensors();
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CPU, m) {
  m.impl("contact_unsupported", TORCH_BOX(&contact_unsupported));
  m.impl("contact_unsupported_backward", TORCH_BOX(&contact_unsupported_backward));
}
