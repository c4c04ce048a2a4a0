// The tensors of contact, as the operators of all backends take them.
#pragma once

#include "../contact/friction.h"
#include "../contact/islands.h"
#include "../contact/passes.h"
#include "arguments.h"
#include "fields.h"

namespace diffvbd {

inline contact::PairList pair_list(const Tensor& pairs, const Tensor& ptr, const Tensor& entry, const Tensor& x,
                                   int64_t corners) {
  require(is_index(pairs, x) && is_index(ptr, x) && is_index(entry, x) && ptr.numel() == x.size(0) * corners + 1 &&
              pairs.dim() == 2 && pairs.size(1) == contact::kPairRow && 4 * pairs.size(0) == entry.numel(),
          "diffvbd: expected pairs made by contact_detect for this batch");
  return {data<const int32_t>(pairs), data<const int32_t>(ptr), data<const int32_t>(entry)};
}

// x: where the sweeps start or end. Empty: collider where there is none, lag and the lists after it where nothing is
// lagged, floor_lag without friction on a floor.
template <class T>
contact::ContactInputs<T> contact_inputs(const SweepFields& t, const Tensor& x, const Batched<const T>& x_prev,
                                         const Batched<const T>& origin, double friction_eps) {
  const int64_t b = x.size(0), v = x.size(1), colliders = t.collider.dim() == 3 ? t.collider.size(1) : 0;
  contact::ContactInputs<T> in{};
  in.num_vertices = static_cast<int32_t>(v);
  in.corners = v + colliders;
  in.listed = pair_list(t.pairs, t.ptr, t.entry, x, in.corners);
  require_like("constants", t.constants, x, t.pairs.size(0) * contact::kConstants);
  in.constants = data<const T>(t.constants);
  if (t.lag.numel() > 0) {
    in.lagged = pair_list(t.lag_pairs, t.lag_ptr, t.lag_entry, x, in.corners);
    require_like("lag", t.lag, x, t.lag_pairs.size(0) * contact::kLagScalars);
    in.lag = data<const T>(t.lag);
  }
  in.kappa = batched<T>("kappa", t.kappa, x, b, 1);
  in.collider = batched<T>("collider", t.collider, x, b, 3 * colliders);
  in.collider_prev = batched<T>("collider_prev", t.collider_prev, x, b, 3 * colliders);
  if (t.floor_lag.numel() > 0) {
    require(v > 0, "diffvbd: expected no floor_lag without vertices");
    in.planes = static_cast<int>(t.floor_lag.numel() / t.floor_lag.size(0) / (v * contact::kFloorLag));
    in.floor_lag = batched<T>("floor_lag", t.floor_lag, x, b, v * in.planes * contact::kFloorLag);
  }
  require_like("center", t.center, x, 3 * b * v);
  require_like("room", t.room, x, b * v);
  in.center = data<const T>(t.center), in.trust_radius = data<const T>(t.room);
  in.x_prev = x_prev;
  in.origin = origin;
  in.friction_eps = static_cast<T>(friction_eps);
  return in;
}

// Of contact_lag: corner points and the pairs that repel.
template <class T>
contact::ContactInputs<T> lag_inputs(const Tensor& x, const Tensor& origin, const Tensor& collider, const Tensor& kappa,
                                     const Tensor& pairs, const Tensor& constants, const Tensor& ptr,
                                     const Tensor& entry) {
  require_positions(x);
  contact::ContactInputs<T> in{};
  const int64_t b = x.size(0), v = x.size(1), colliders = collider.dim() == 3 ? collider.size(1) : 0;
  in.num_vertices = static_cast<int32_t>(v);
  in.corners = v + colliders;
  in.collider = batched<T>("collider", collider, x, b, 3 * colliders);
  in.origin = batched_or_null<T>("origin", origin, x, b, 3 * v);
  in.kappa = batched<T>("kappa", kappa, x, b, 1);
  in.listed = pair_list(pairs, ptr, entry, x, in.corners);
  require_like("constants", constants, x, pairs.size(0) * contact::kConstants);
  in.constants = data<const T>(constants);
  return in;
}

// friction, damping [1 | B], or empty.
template <class T>
contact::LagCoefficients<T> lag_coefficients(const Tensor& friction, const Tensor& damping, const Tensor& x) {
  return {batched_or_null<T>("friction", friction, x, x.size(0), 1),
          batched_or_null<T>("damping", damping, x, x.size(0), 1)};
}

template <class T>
contact::LaggedFrictionBars<T> rubbing_bars(const Tensor& lag, const Tensor& push, const Tensor& x, int64_t corners,
                                     int64_t pairs) {
  if (lag.numel()) require_like("lag_bar", lag, x, pairs * contact::kLagScalars);
  if (push.numel()) require_like("push_bar", push, x, x.size(0) * corners * 3);
  return {lag.numel() ? data<const T>(lag) : nullptr, push.numel() ? data<const T>(push) : nullptr, corners};
}

template <class T>
contact::SupportVertexInputs<T> lowest_inputs(const Tensor& x, const Tensor& origin, const Tensor& planes,
                                       const Tensor& body_order, const Tensor& body_ptr, const Tensor& island) {
  require_positions(x);
  const int64_t b = x.size(0), v = x.size(1), bodies = body_ptr.numel() - 1;
  require(bodies >= 0 && is_index(body_order, x) && is_index(body_ptr, x) && is_index(island, x) &&
              body_order.numel() == v && island.numel() == b * bodies,
          "diffvbd::contact_lowest: expected bodies of x and their islands");
  contact::SupportVertexInputs<T> in{};
  const int64_t scalars = planes.dim() > 0 && planes.size(0) > 0 ? planes.numel() / planes.size(0) : 0;
  require(scalars > 0 && scalars % contact::kPlaneScalars == 0,
          "diffvbd::contact_lowest: expected planes [scenes, 7 planes]");
  if (origin.numel() > 0) require_like("origin", origin, x, x.numel());
  in.x = data<const T>(x);
  in.origin = batched_or_null<T>("origin", origin, x, b, 3 * v).data;
  in.planes = data<const T>(planes);
  in.plane_scene = batched<T>("planes", planes, x, b, scalars).scene;
  in.body_order = data<const int32_t>(body_order);
  in.body_ptr = data<const int32_t>(body_ptr);
  in.island = data<const int32_t>(island);
  in.scenes = b;
  in.vertices = static_cast<int32_t>(v);
  in.bodies = static_cast<int32_t>(bodies);
  in.num_planes = static_cast<int32_t>(scalars / contact::kPlaneScalars);
  return in;
}

}  // namespace diffvbd
