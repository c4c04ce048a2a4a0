// Islands of bodies, as the operators of detection and of trust regions take them.
#pragma once

#include <cmath>

#include "../contact/detection.h"
#include "../contact/islands.h"
#include "backend.h"

namespace diffvbd {

template <class T>
contact::IslandInputs<T> island_inputs(const Tensor& x, const Tensor& origin, const Tensor& move, const Tensor& mass,
                                       const Tensor& collider, const Tensor& collider_next, const Tensor& planes,
                                       const Tensor& body, const Tensor& body_order, const Tensor& body_ptr,
                                       const Tensor& pinned, const Tensor& radius, const Tensor& trust_radius,
                                       int64_t mesh_bodies, double dhat, bool any_direction) {
  const Reader<T> read(x);
  const int64_t b = read.b, v = read.v, n = body.numel();
  require(v <= n, "contact_islands: expected body of shape [N], N >= vertices");
  require(b * n <= std::numeric_limits<int32_t>::max(),
          "contact_islands: too large, expected at most 2^31 corner points in all scenes");
  contact::IslandInputs<T> out{};
  out.x = read.positions(), out.origin = read.vectors_or_null("origin", origin);
  out.move = read.vectors("move", move);
  const Batched<const T> masses = read.batch("mass", mass, v);
  out.mass = masses.data, out.mass_scene = masses.scene;
  out.collider = read.like("collider", collider, 3 * b * (n - v));
  out.collider_next = read.like("collider_next", collider_next, 3 * b * (n - v));
  out.planes = read.index("planes", planes, 3 * planes.size(0)), out.body = read.index("body", body, n);
  out.body_order = read.index("body_order", body_order, v);
  out.body_ptr = read.index("body_ptr", body_ptr, mesh_bodies + 1);
  out.pinned = read.flags("pinned", pinned, n), out.radius = read.like("radius", radius, n);
  out.scenes = b, out.vertices = static_cast<int32_t>(v), out.corners = static_cast<int32_t>(n);
  out.num_planes = static_cast<int32_t>(planes.size(0)), out.mesh_bodies = static_cast<int32_t>(mesh_bodies);
  out.trust_radius = read.like("trust_radius", trust_radius, b * (mesh_bodies + 1)),
  out.half = static_cast<T>(dhat / 2);
  out.any_direction = any_direction;
  return out;
}

}  // namespace diffvbd
