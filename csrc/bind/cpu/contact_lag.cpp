// CPU implementations of the operators that sweeps with contact start from: lagged pairs, lowest vertices.
#include <torch/csrc/stable/library.h>

#include <tuple>
#include <vector>

#include "sweep.h"

namespace {

using diffvbd::data, diffvbd::dispatch_float, diffvbd::zeros;
using torch::headeronly::ScalarType;
using torch::stable::Tensor;
namespace contact = diffvbd::contact;

// Positions in the user's numbering.
template <class T>
struct UserPositions {
  const T* x;
  diffvbd::Vec3<T> operator()(int v) const { return diffvbd::vector_at(x + int64_t{3} * v); }
};

// Calls f(pair, kind, corners, constants, kappa) for each listed pair.
template <class T, class F>
void each_pair(const contact::ContactInputs<T>& in, const Tensor& x, const F& f) {
  const int64_t count = in.listed.ptr[x.size(0) * in.corners] / 4;
  for (int64_t pair = 0; pair < count; ++pair) {
    const int32_t* record = in.listed.pairs + contact::kPairRow * pair;
    const UserPositions<T> positions{data<const T>(x) + int64_t{record[5]} * 3 * in.num_vertices};
    const contact::Source<T, UserPositions<T>> source{in, record[5], positions};
    const contact::PairConstants<T> a(in.constants + contact::kConstants * pair);
    f(pair, record, source.corners(record), a, in.kappa.data[record[5] * in.kappa.scene]);
  }
}

// Adds what the corners of a pair receive to points [B, N, 3].
template <class T>
void add_at_corners(const contact::ContactInputs<T>& in, const int32_t* record, const diffvbd::Vec3<T> (&values)[4],
                    Tensor& points) {
  for (int k = 0; k < 4; ++k) {
    diffvbd::add_to(data<T>(points) + 3 * (record[5] * in.corners + record[k]), values[k]);
  }
}

Tensor contact_lag(const Tensor& x, const Tensor& origin, const Tensor& collider, const Tensor& kappa,
                   const Tensor& pairs, const Tensor& constants, const Tensor& ptr, const Tensor& entry) {
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::lag_inputs<T>(x, origin, collider, kappa, pairs, constants, ptr, entry);
    Tensor out = zeros(x, {pairs.size(0), contact::kLagScalars});
    each_pair(in, x, [&](int64_t pair, const int32_t* record, const auto& corners, const auto& a, T stiffness) {
      contact::store_lag(contact::lag_state(record[4], corners, a, stiffness),
                         data<T>(out) + contact::kLagScalars * pair);
    });
    return out;
  });
}

std::tuple<Tensor, Tensor> contact_lag_backward(const Tensor& bar, const Tensor& x, const Tensor& origin,
                                                const Tensor& collider, const Tensor& kappa, const Tensor& pairs,
                                                const Tensor& constants, const Tensor& ptr, const Tensor& entry) {
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::lag_inputs<T>(x, origin, collider, kappa, pairs, constants, ptr, entry);
    diffvbd::require_like("bar", bar, x, pairs.size(0) * contact::kLagScalars);
    const int64_t b = x.size(0);
    Tensor points = zeros(x, {b, in.corners, 3}), kappa_bar = zeros(x, {b});
    each_pair(in, x, [&](int64_t pair, const int32_t* record, const auto& corners, const auto& a, T stiffness) {
      contact::PairAdjoint<T> out;
      contact::reverse_lag(record[4], corners, a, stiffness, data<const T>(bar) + contact::kLagScalars * pair, out);
      add_at_corners(in, record, out.x, points);
      data<T>(kappa_bar)[record[5]] += out.kappa;
    });
    return std::make_tuple(points, kappa_bar);
  });
}

std::tuple<Tensor, Tensor> contact_rubbing(const Tensor& x, const Tensor& origin, const Tensor& collider,
                                           const Tensor& kappa, const Tensor& friction, const Tensor& damping,
                                           const Tensor& pairs, const Tensor& constants, const Tensor& ptr,
                                           const Tensor& entry) {
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::lag_inputs<T>(x, origin, collider, kappa, pairs, constants, ptr, entry);
    const auto by = diffvbd::lag_coefficients<T>(friction, damping, x);
    Tensor lag = zeros(x, {pairs.size(0), contact::kLagScalars}), push = zeros(x, {x.size(0), in.corners, 3});
    each_pair(in, x, [&](int64_t pair, const int32_t* record, const auto& corners, const auto& a, T stiffness) {
      const auto state = contact::lag_state(record[4], corners, a, stiffness);
      contact::store_lagged_friction(state, by.friction_of(record[5]), by.damping_of(record[5]), stiffness, a.dhat,
                             data<T>(lag) + contact::kLagScalars * pair);
      diffvbd::Vec3<T> force[4];
      for (int k = 0; k < 4; ++k) force[k] = state.force * state.w[k] * state.n;
      add_at_corners(in, record, force, push);
    });
    return std::make_tuple(lag, push);
  });
}

std::tuple<Tensor, Tensor, Tensor, Tensor> contact_rubbing_backward(const Tensor& lag_bar, const Tensor& push_bar,
                                                                    const Tensor& x, const Tensor& origin,
                                                                    const Tensor& collider, const Tensor& kappa,
                                                                    const Tensor& friction, const Tensor& damping,
                                                                    const Tensor& pairs, const Tensor& constants,
                                                                    const Tensor& ptr, const Tensor& entry) {
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::lag_inputs<T>(x, origin, collider, kappa, pairs, constants, ptr, entry);
    const auto by = diffvbd::lag_coefficients<T>(friction, damping, x);
    const auto given = diffvbd::rubbing_bars<T>(lag_bar, push_bar, x, in.corners, pairs.size(0));
    const int64_t b = x.size(0);
    Tensor points = zeros(x, {b, in.corners, 3}), kappa_bar = zeros(x, {b});
    Tensor friction_bar = zeros(x, {friction.numel() ? b : 0}), damping_bar = zeros(x, {damping.numel() ? b : 0});
    each_pair(in, x, [&](int64_t pair, const int32_t* record, const auto& corners, const auto& a, T stiffness) {
      const int64_t scene = record[5];
      contact::LaggedFrictionAdjoint<T> out;
      given.reverse(by, pair, record, corners, a, stiffness, out);
      add_at_corners(in, record, out.pair.x, points);
      data<T>(kappa_bar)[scene] += out.pair.kappa;
      if (friction.numel()) data<T>(friction_bar)[scene] += out.friction;
      if (damping.numel()) data<T>(damping_bar)[scene] += out.damping;
    });
    return std::make_tuple(points, kappa_bar, friction_bar, damping_bar);
  });
}

Tensor contact_lowest(const Tensor& x, const Tensor& origin, const Tensor& planes, const Tensor& body_order,
                      const Tensor& body_ptr, const Tensor& island) {
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::lowest_inputs<T>(x, origin, planes, body_order, body_ptr, island);
    Tensor out = torch::stable::empty({in.scenes, in.bodies, in.num_planes}, ScalarType::Int);
    std::vector<int32_t> own(out.numel());
    const auto each = [&](auto&& f) {
      int64_t i = 0;
      for (int64_t b = 0; b < in.scenes; ++b) {
        for (int32_t body = 0; body < in.bodies; ++body) {
          for (int32_t plane = 0; plane < in.num_planes; ++plane) f(i++, b, body, plane);
        }
      }
    };
    each([&](int64_t i, int64_t b, int32_t body, int32_t plane) {
      own[i] = contact::support_vertex_of_body(in, b, body, plane, 0, 1).vertex;
    });
    each([&](int64_t i, int64_t b, int32_t body, int32_t plane) {
      const int32_t first = in.island[b * in.bodies + body];
      int32_t* to = data<int32_t>(out);
      to[i] = first >= 0 && first < body ? to[i - int64_t{body - first} * in.num_planes]  // that of its first body
                                         : contact::support_vertex_of_island(in, own.data(), b, body, plane);
    });
    return out;
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CPU, m) {
  m.impl("contact_lag", TORCH_BOX(&contact_lag));
  m.impl("contact_lag_backward", TORCH_BOX(&contact_lag_backward));
  m.impl("contact_rubbing", TORCH_BOX(&contact_rubbing));
  m.impl("contact_rubbing_backward", TORCH_BOX(&contact_rubbing_backward));
  m.impl("contact_lowest", TORCH_BOX(&contact_lowest));
}
