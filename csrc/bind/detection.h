// The tensors of contact as the views of csrc/contact: what the registrations of all backends share.
#pragma once

#include <cmath>

#include "../contact/detection.h"
#include "../contact/islands.h"
#include "arguments.h"

namespace diffvbd {

// A tensor of these sizes, contiguous, on the device of `like`.
inline void require_shape(const Tensor& t, const Tensor& like, ScalarType dtype, const std::vector<int64_t>& sizes,
                          const char* message) {
  bool fits = t.dim() == static_cast<int64_t>(sizes.size()) && is_beside(t, like, dtype);
  for (size_t k = 0; fits && k < sizes.size(); ++k) fits = t.size(static_cast<int64_t>(k)) == sizes[k];
  require(fits, message);
}

// Sizes that kernels count in 32 bits.
inline void require_countable(int64_t n, const char* message) {
  require(n <= std::numeric_limits<int32_t>::max(), message);
}

template <class T>
contact::Surfaces<T> surfaces_of(const Tensor& x, const Tensor& origin, const Tensor& collider,
                                 const Tensor& collider_next, const Tensor& rest, const Tensor& radius,
                                 const Tensor& triangles, const Tensor& edges, const Tensor& points,
                                 const Tensor& planes, const Tensor& body, const Tensor& held, int64_t mesh_bodies,
                                 bool self_contact, bool between_bodies) {
  require_positions(x);
  const int64_t b = x.size(0), v = x.size(1), n = body.numel();
  const ScalarType real = x.scalar_type();
  require(v <= n && mesh_bodies >= 0, "contact: expected body of shape [N], N >= vertices, and mesh_bodies >= 0");
  if (origin.numel() > 0) {
    require_shape(origin, x, real, {b, v, 3}, "contact: expected origin like x, or empty");
  }
  require_shape(collider, x, real, {b, n - v, 3}, "contact: expected collider like x, of shape [B, N - V, 3]");
  require_shape(collider_next, x, real, {b, n - v, 3},
                "contact: expected collider_next like x, of shape [B, N - V, 3]");
  require_shape(rest, x, real, {n, 3}, "contact: expected rest like x, of shape [N, 3]");
  require_shape(radius, x, real, {n}, "contact: expected radius like x, of shape [N]");
  const auto indices = [&](const Tensor& t, const std::vector<int64_t>& sizes, const char* message) {
    require_shape(t, x, ScalarType::Int, sizes, message);
    require_countable(b * t.numel(), "contact: too large, expected at most 2^31 corners of primitives");
    return data<const int32_t>(t);
  };
  contact::Surfaces<T> out{};
  out.triangles = indices(triangles, {triangles.size(0), 3}, "contact: expected triangles [F, 3] int32");
  out.edges = indices(edges, {edges.size(0), 2}, "contact: expected edges [E, 2] int32");
  out.points = indices(points, {points.size(0)}, "contact: expected points [P] int32");
  out.planes = indices(planes, {planes.size(0), 3}, "contact: expected planes [L, 3] int32");
  out.body = indices(body, {n}, "contact: expected body [N] int32");
  require_shape(held, x, ScalarType::Bool, {n}, "contact: expected held [N] bool");
  require_countable(b * n + 1, "contact: too large, expected at most 2^31 corner points in all scenes");
  out.x = data<const T>(x), out.origin = origin.numel() > 0 ? data<const T>(origin) : nullptr;
  out.collider = data<const T>(collider), out.collider_next = data<const T>(collider_next);
  out.rest = data<const T>(rest), out.radius = data<const T>(radius), out.pinned = data<const bool>(held);
  out.scenes = b;
  out.vertices = static_cast<int32_t>(v), out.corners = static_cast<int32_t>(n);
  out.num_triangles = static_cast<int32_t>(triangles.size(0)), out.num_edges = static_cast<int32_t>(edges.size(0));
  out.num_points = static_cast<int32_t>(points.size(0)), out.num_planes = static_cast<int32_t>(planes.size(0));
  out.mesh_bodies = count_of(mesh_bodies);
  out.self_contact = self_contact, out.between_bodies = between_bodies;
  const double base = static_cast<double>(out.key_base());
  require(3.0 * static_cast<double>(b) * base * base < 0x1p63, "contact: too many scenes of this size");
  return out;
}

// What a detection reads besides: how far to look.
template <class T>
void set_reach(contact::Surfaces<T>& surfaces, const Tensor& x, const Tensor& room, const Tensor& own_room,
               double dhat) {
  require(std::isfinite(dhat), "contact: expected a finite dhat");
  require_shape(room, x, x.scalar_type(), {surfaces.scenes, int64_t{surfaces.mesh_bodies} + 1},
                "contact: expected room like x, of shape [B, mesh_bodies + 1]");
  require_shape(own_room, x, x.scalar_type(), {surfaces.scenes, int64_t{surfaces.mesh_bodies} + 1},
                "contact: expected own_room like x, of shape [B, mesh_bodies + 1]");
  surfaces.trust_radius = data<const T>(room), surfaces.deformation_radius = data<const T>(own_room),
  surfaces.dhat = static_cast<T>(dhat);
}

inline void require_capacity(int64_t capacity) {
  require(capacity >= 0 && 4 * capacity <= std::numeric_limits<int32_t>::max(),
          "contact: expected 0 <= capacity < 2^29");
}

template <class T>
contact::IslandInputs<T> island_inputs(const Tensor& x, const Tensor& origin, const Tensor& move, const Tensor& mass,
                                       const Tensor& collider, const Tensor& collider_next, const Tensor& planes,
                                       const Tensor& body, const Tensor& body_order, const Tensor& body_ptr,
                                       const Tensor& held, const Tensor& radius, const Tensor& room,
                                       int64_t mesh_bodies, double dhat, bool any_direction) {
  require_positions(x);
  const int64_t b = x.size(0), v = x.size(1), n = body.numel();
  const ScalarType real = x.scalar_type();
  require(v <= n, "contact_islands: expected body of shape [N], N >= vertices");
  if (origin.numel() > 0) {
    require_shape(origin, x, real, {b, v, 3}, "contact_islands: expected origin like x, or empty");
  }
  require_shape(move, x, real, {b, v, 3}, "contact_islands: expected move like x");
  require(mass.dim() == 2, "contact_islands: expected mass of shape [1 | B, V]");
  require_shape(mass, x, real, {mass.size(0) == 1 ? 1 : b, v}, "contact_islands: expected mass like x, [1 | B, V]");
  require_shape(collider, x, real, {b, n - v, 3}, "contact_islands: expected collider like x, of shape [B, N - V, 3]");
  require_shape(collider_next, x, real, {b, n - v, 3},
                "contact_islands: expected collider_next like x, of shape [B, N - V, 3]");
  require_shape(planes, x, ScalarType::Int, {planes.size(0), 3}, "contact_islands: expected planes [L, 3] int32");
  require_shape(body, x, ScalarType::Int, {n}, "contact_islands: expected body [N] int32");
  require_shape(body_order, x, ScalarType::Int, {v}, "contact_islands: expected body_order [V] int32");
  require_shape(body_ptr, x, ScalarType::Int, {mesh_bodies + 1},
                "contact_islands: expected body_ptr [mesh_bodies + 1] int32");
  require_shape(held, x, ScalarType::Bool, {n}, "contact_islands: expected held [N] bool");
  require_shape(radius, x, real, {n}, "contact_islands: expected radius like x, of shape [N]");
  require_countable(b * n, "contact_islands: too large, expected at most 2^31 corner points in all scenes");
  contact::IslandInputs<T> out{};
  out.x = data<const T>(x), out.origin = origin.numel() > 0 ? data<const T>(origin) : nullptr;
  out.move = data<const T>(move), out.mass = data<const T>(mass), out.mass_scene = mass.size(0) == 1 ? 0 : v;
  out.collider = data<const T>(collider), out.collider_next = data<const T>(collider_next);
  out.radius = data<const T>(radius), out.planes = data<const int32_t>(planes), out.body = data<const int32_t>(body);
  out.body_order = data<const int32_t>(body_order), out.body_ptr = data<const int32_t>(body_ptr);
  out.pinned = data<const bool>(held);
  out.scenes = b, out.vertices = static_cast<int32_t>(v), out.corners = static_cast<int32_t>(n);
  out.num_planes = static_cast<int32_t>(planes.size(0)), out.mesh_bodies = static_cast<int32_t>(mesh_bodies);
  require_shape(room, x, real, {b, mesh_bodies + 1}, "contact_islands: expected room like x, of shape [B, NB + 1]");
  out.trust_radius = data<const T>(room), out.half = static_cast<T>(dhat / 2);
  out.any_direction = any_direction;
  return out;
}

inline void check_segments(const Tensor& values, const Tensor& order, const Tensor& ptr) {
  require(values.dim() == 3 && values.is_contiguous(), "segment_sum: expected contiguous values [B, V, C]");
  require_shape(order, values, ScalarType::Int, {order.numel()}, "segment_sum: expected order [V] int32");
  require_shape(ptr, values, ScalarType::Int, {ptr.numel()}, "segment_sum: expected ptr [S + 1] int32");
  require(ptr.numel() > 0, "segment_sum: expected ptr [S + 1] int32");
}

}  // namespace diffvbd
