// CUDA implementations of the operators that sweeps with contact start from: lagged pairs, lowest vertices.
#include <torch/csrc/stable/library.h>

#include <tuple>
#include <vector>

#include "../../cuda/contact.h"
#include "sweep.h"

namespace {

namespace contact = diffvbd::contact;
namespace cuda = diffvbd::cuda;
using cuda::check, cuda::current_stream, cuda::DeviceGuard, cuda::empty;
using diffvbd::data, diffvbd::dispatch_float;
using torch::headeronly::ScalarType;
using torch::stable::Tensor;

Tensor contact_lag(const Tensor& x, const Tensor& origin, const Tensor& collider, const Tensor& kappa,
                   const Tensor& pairs, const Tensor& constants, const Tensor& ptr, const Tensor& entry) {
  const DeviceGuard guard(x.get_device_index());
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::lag_inputs<T>(x, origin, collider, kappa, pairs, constants, ptr, entry);
    Tensor out = empty(x, {pairs.size(0), contact::kLagScalars});
    check(cuda::pair_lag<T>(in, data<const T>(x), x.size(0), pairs.size(0), data<T>(out), current_stream(x)),
          "the lag of pairs");
    return out;
  });
}

std::tuple<Tensor, Tensor> contact_lag_backward(const Tensor& bar, const Tensor& x, const Tensor& origin,
                                                const Tensor& collider, const Tensor& kappa, const Tensor& pairs,
                                                const Tensor& constants, const Tensor& ptr, const Tensor& entry) {
  const DeviceGuard guard(x.get_device_index());
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::lag_inputs<T>(x, origin, collider, kappa, pairs, constants, ptr, entry);
    diffvbd::require_like("bar", bar, x, pairs.size(0) * contact::kLagScalars);
    const int64_t b = x.size(0);
    Tensor points = empty(x, {b, in.corners, 3}), kappa_bar = empty(x, {b});
    const Tensor slots = empty(x, {pairs.size(0), cuda::kLagSlots});
    check(cuda::pair_lag_backward<T>(in, data<const T>(x), b, pairs.size(0), data<const T>(bar), data<T>(slots),
                                     data<T>(points), data<T>(kappa_bar), current_stream(x)),
          "the lag of pairs");
    return std::make_tuple(points, kappa_bar);
  });
}

std::tuple<Tensor, Tensor> contact_rubbing(const Tensor& x, const Tensor& origin, const Tensor& collider,
                                           const Tensor& kappa, const Tensor& friction, const Tensor& damping,
                                           const Tensor& pairs, const Tensor& constants, const Tensor& ptr,
                                           const Tensor& entry) {
  const DeviceGuard guard(x.get_device_index());
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::lag_inputs<T>(x, origin, collider, kappa, pairs, constants, ptr, entry);
    const auto by = diffvbd::lag_coefficients<T>(friction, damping, x);
    Tensor lag = empty(x, {pairs.size(0), contact::kLagScalars}), push = empty(x, {x.size(0), in.corners, 3});
    const Tensor slots = empty(x, {pairs.size(0), cuda::kLagSlots});
    check(cuda::lagged_friction<T>(in, by, data<const T>(x), x.size(0), pairs.size(0), data<T>(lag), data<T>(slots),
                                   data<T>(push), current_stream(x)),
          "the lag of pairs");
    return std::make_tuple(lag, push);
  });
}

std::tuple<Tensor, Tensor, Tensor, Tensor> contact_rubbing_backward(const Tensor& lag_bar, const Tensor& push_bar,
                                                                    const Tensor& x, const Tensor& origin,
                                                                    const Tensor& collider, const Tensor& kappa,
                                                                    const Tensor& friction, const Tensor& damping,
                                                                    const Tensor& pairs, const Tensor& constants,
                                                                    const Tensor& ptr, const Tensor& entry) {
  const DeviceGuard guard(x.get_device_index());
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::lag_inputs<T>(x, origin, collider, kappa, pairs, constants, ptr, entry);
    const auto by = diffvbd::lag_coefficients<T>(friction, damping, x);
    const auto given = diffvbd::rubbing_bars<T>(lag_bar, push_bar, x, in.corners, pairs.size(0));
    const int64_t b = x.size(0);
    Tensor points = empty(x, {b, in.corners, 3}), kappa_bar = empty(x, {b});
    Tensor friction_bar = empty(x, {friction.numel() ? b : 0}), damping_bar = empty(x, {damping.numel() ? b : 0});
    const auto wanted = [](Tensor& t) { return t.numel() ? data<T>(t) : nullptr; };
    const Tensor slots = empty(x, {pairs.size(0), cuda::kLagSlots});
    check(cuda::lagged_friction_backward<T>(in, by, given, data<const T>(x), b, pairs.size(0), data<T>(slots),
                                            data<T>(points), data<T>(kappa_bar), wanted(friction_bar),
                                            wanted(damping_bar), current_stream(x)),
          "the lag of pairs");
    return std::make_tuple(points, kappa_bar, friction_bar, damping_bar);
  });
}

Tensor contact_lowest(const Tensor& x, const Tensor& origin, const Tensor& planes, const Tensor& body_order,
                      const Tensor& body_ptr, const Tensor& island) {
  const DeviceGuard guard(x.get_device_index());
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::lowest_inputs<T>(x, origin, planes, body_order, body_ptr, island);
    const std::vector<int64_t> shape{in.scenes, in.bodies, in.num_planes};
    const Tensor own = empty(x, shape, ScalarType::Int);
    Tensor out = empty(x, shape, ScalarType::Int);
    check(cuda::support_vertices<T>(in, data<int32_t>(own), data<int32_t>(out), current_stream(x)),
          "the search for the lowest vertices");
    return out;
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CUDA, m) {
  m.impl("contact_lag", TORCH_BOX(&contact_lag));
  m.impl("contact_lag_backward", TORCH_BOX(&contact_lag_backward));
  m.impl("contact_rubbing", TORCH_BOX(&contact_rubbing));
  m.impl("contact_rubbing_backward", TORCH_BOX(&contact_rubbing_backward));
  m.impl("contact_lowest", TORCH_BOX(&contact_lowest));
}
