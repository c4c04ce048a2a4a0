// The tensors of contact, as the operators of all backends take them.
#pragma once

#include "../contact/lowest.h"
#include "../contact/passes.h"
#include "arguments.h"
#include "fields.h"

namespace diffvbd {

inline contact::PairList pair_list(const Tensor& pairs, const Tensor& ptr, const Tensor& entry, int64_t scenes,
                                   int64_t corners) {
  const auto good = [](const Tensor& t) { return t.scalar_type() == ScalarType::Int && t.is_contiguous(); };
  require(good(pairs) && good(ptr) && good(entry) && ptr.numel() == scenes * corners + 1 &&
              pairs.numel() % contact::kPairRow == 0 && 4 * (pairs.numel() / contact::kPairRow) == entry.numel(),
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
  in.listed = pair_list(t.pairs, t.ptr, t.entry, b, in.corners);
  require(t.constants.is_contiguous() && t.constants.scalar_type() == x.scalar_type() &&
              2 * t.constants.numel() == t.pairs.numel(),
          "diffvbd: expected the constants of the pairs");
  in.constants = data<const T>(t.constants);
  if (t.lag.numel() > 0) {
    in.lagged = pair_list(t.lag_pairs, t.lag_ptr, t.lag_entry, b, in.corners);
    require(t.lag.is_contiguous() && t.lag.scalar_type() == x.scalar_type() &&
                t.lag.numel() * contact::kPairRow == t.lag_pairs.numel() * contact::kLagScalars,
            "diffvbd: expected the lag of the pairs");
    in.lag = data<const T>(t.lag);
  }
  in.kappa = batched<T>(t.kappa, x, b, 1);
  in.bounds = batched<T>(t.bounds, x, b, 4 * v);
  in.collider = batched<T>(t.collider, x, b, 3 * colliders);
  in.collider_prev = batched<T>(t.collider_prev, x, b, 3 * colliders);
  if (t.floor_lag.numel() > 0) {
    in.planes = static_cast<int>(t.floor_lag.numel() / t.floor_lag.size(0) / (v * contact::kFloorLag));
    in.floor_lag = batched<T>(t.floor_lag, x, b, v * in.planes * contact::kFloorLag);
  }
  in.x_prev = x_prev;
  in.origin = origin;
  in.friction_eps = static_cast<T>(friction_eps);
  return in;
}

template <class T>
contact::LowestInputs<T> lowest_inputs(const Tensor& x, const Tensor& origin, const Tensor& planes,
                                       const Tensor& body_order, const Tensor& body_ptr, const Tensor& island) {
  const int64_t b = x.size(0), v = x.size(1), bodies = body_ptr.numel() - 1;
  const auto good = [](const Tensor& t) { return t.scalar_type() == ScalarType::Int && t.is_contiguous(); };
  require(good(body_order) && good(body_ptr) && good(island) && body_order.numel() == v &&
              island.numel() == b * bodies && x.is_contiguous() && planes.numel() > 0,
          "diffvbd::contact_lowest: bad arguments");
  contact::LowestInputs<T> in{};
  const int64_t scalars = planes.numel() / planes.size(0);
  in.x = data<const T>(x);
  in.origin = batched<T>(origin, x, b, 3 * v).data;
  in.planes = data<const T>(planes);
  in.plane_scene = batched<T>(planes, x, b, scalars).scene;
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
