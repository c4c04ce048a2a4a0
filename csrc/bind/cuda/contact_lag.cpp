// CUDA implementations of the operators that sweeps with contact start from: lagged pairs, lowest vertices.
#include <torch/csrc/stable/library.h>

#include <tuple>
#include <vector>

#include "../../cuda/contact.h"
#include "../../cuda/lowest.h"
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

std::tuple<Tensor, Tensor, Tensor> contact_lag_backward(const Tensor& bar, const Tensor& x, const Tensor& origin,
                                                        const Tensor& collider, const Tensor& kappa,
                                                        const Tensor& pairs, const Tensor& constants, const Tensor& ptr,
                                                        const Tensor& entry) {
  const DeviceGuard guard(x.get_device_index());
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::lag_inputs<T>(x, origin, collider, kappa, pairs, constants, ptr, entry);
    diffvbd::require_like("bar", bar, x, pairs.size(0) * contact::kLagScalars);
    const int64_t b = x.size(0), v = x.size(1);
    Tensor x_bar = empty(x, {b, v, 3}), collider_bar = empty(x, {b, in.corners - v, 3}), kappa_bar = empty(x, {b});
    const Tensor slots = empty(x, {pairs.size(0), 16});
    check(cuda::pair_lag_backward<T>(in, data<const T>(x), b, pairs.size(0), data<const T>(bar), data<T>(slots),
                                     data<T>(x_bar), data<T>(collider_bar), data<T>(kappa_bar), current_stream(x)),
          "the lag of pairs");
    return std::make_tuple(x_bar, collider_bar, kappa_bar);
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
    check(cuda::lowest_vertices<T>(in, data<int32_t>(own), data<int32_t>(out), current_stream(x)),
          "the search for the lowest vertices");
    return out;
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CUDA, m) {
  m.impl("contact_lag", TORCH_BOX(&contact_lag));
  m.impl("contact_lag_backward", TORCH_BOX(&contact_lag_backward));
  m.impl("contact_lowest", TORCH_BOX(&contact_lowest));
}
