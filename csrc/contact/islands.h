// Islands: bodies that touch, or may soon, and translate together until the next detection. Shared by CPU and CUDA:
// bounds of bodies, what a translation sweeps, what blocks an island.
#pragma once

#include <cstdint>

#include "../core/views.h"

namespace diffvbd::contact {

constexpr int kPlaneScalars = 7;  // of a plane in the data of FloorBarrier: normal, height, ...
constexpr int kPlaneDhat = 5;     // which of them is its dhat
constexpr int kJoins = 4;         // rounds of joining before all bodies of a scene become one island

// `vertices` of the mesh, sorted by body in body_order; corner points from there on are those of colliders.
template <class T>
struct IslandInputs {
  const T *x, *origin, *move;                  // [B, V, 3]; origin may be null
  const T* mass;                               // [1 | B, V]
  const T *collider, *collider_next, *radius;  // [B, Vc, 3] twice, [N]
  const int32_t *planes, *body;                // [L, 3], [N]
  const int32_t *body_order, *body_ptr;        // [V], [mesh_bodies + 1]
  const bool* pinned;                          // [N]
  int64_t scenes, mass_scene;                  // stride of scenes in mass
  int32_t vertices, corners, num_planes, mesh_bodies;
  const T*
      trust_radius;  // [B, mesh_bodies + 1]  radius of a body's vertices relative to the translation [m], the largest
  T half;            // the reach of the barrier [m]
  Batched<const T> floor;  // [1 | B, floor_planes, kPlaneScalars]
  int32_t floor_planes;

  DIFFVBD_FN T margin(int64_t scene, int32_t body) const {
    return trust_radius[scene * (mesh_bodies + 1) + body] + half;
  }
  DIFFVBD_FN int32_t colliders() const { return corners - vertices; }  // points, and so at most as many objects
};

template <class T>
struct Bounds {
  Vec3<T> lo, hi;
};

template <class T>
DIFFVBD_FN Bounds<T> no_bounds() {
  const T far = std::numeric_limits<T>::infinity();
  return {{far, far, far}, {-far, -far, -far}};
}

template <class T>
DIFFVBD_FN void include(Bounds<T>& a, const Bounds<T>& b) {
  const auto lesser = [](T u, T v) { return u < v ? u : v; };
  const auto greater = [](T u, T v) { return u < v ? v : u; };
  a.lo = {lesser(a.lo.x, b.lo.x), lesser(a.lo.y, b.lo.y), lesser(a.lo.z, b.lo.z)};
  a.hi = {greater(a.hi.x, b.hi.x), greater(a.hi.y, b.hi.y), greater(a.hi.z, b.hi.z)};
}

// Bounds of the position a + b, grown by the rounding of the sum and by r.
template <class T>
DIFFVBD_FN Bounds<T> around(const Vec3<T>& a, const Vec3<T>& b, T r) {
  const T ulps = T(4) * std::numeric_limits<T>::epsilon();
  const Vec3<T> at = a + b;
  const Vec3<T> s{r + ulps * (absolute(a.x) + absolute(b.x)), r + ulps * (absolute(a.y) + absolute(b.y)),
                  r + ulps * (absolute(a.z) + absolute(b.z))};
  return {at - s, at + s};
}

// Sums over the vertices of a body; pinned ones have bounds but no mass.
template <class T>
struct BodySum {
  Bounds<T> bounds;
  Vec3<T> momentum;  // sum of mass times wanted motion [kg m]
  T mass;
  bool blocked;  // pinned somewhere, or not finite

  DIFFVBD_FN void add(const BodySum& other) {
    include(bounds, other.bounds);
    momentum += other.momentum;
    mass = mass + other.mass;
    blocked = blocked || other.blocked;
  }
};

template <class T>
DIFFVBD_FN BodySum<T> nothing() {
  return {no_bounds<T>(), zero3<T>(), T(0), false};
}

template <class T>
DIFFVBD_FN BodySum<T> vertex_sum(const IslandInputs<T>& in, int64_t scene, int32_t v) {
  const int64_t row = scene * in.vertices + v;
  const auto at = [&](const T* p) { return Vec3<T>{p[3 * row], p[3 * row + 1], p[3 * row + 2]}; };
  const Vec3<T> x = at(in.x), o = in.origin == nullptr ? zero3<T>() : at(in.origin), m = at(in.move);
  BodySum<T> out{around(x, o, T(0)), zero3<T>(), T(0), in.pinned[v]};
  if (!in.pinned[v]) {
    out.mass = in.mass[scene * in.mass_scene + v];
    out.momentum = out.mass * m;
  }
  const T sum = x.x + x.y + x.z + o.x + o.y + o.z + out.momentum.x + out.momentum.y + out.momentum.z;
  out.blocked = out.blocked || !(sum - sum == T(0));
  return out;
}

// Translation of an island.
template <class T>
DIFFVBD_FN Vec3<T> translation(const BodySum<T>& island) {
  return island.blocked || !(T(0) < island.mass) ? zero3<T>() : (T(1) / island.mass) * island.momentum;
}

// Bounds of a body while its island translates by u and its vertices move by `margin` from there.
template <class T>
DIFFVBD_FN Bounds<T> swept(const Bounds<T>& body, const Vec3<T>& u, T margin) {
  Bounds<T> out = body;
  include(out, Bounds<T>{body.lo + u, body.hi + u});
  const Vec3<T> m{margin, margin, margin};
  return {out.lo - m, out.hi + m};
}

template <class T>
DIFFVBD_FN bool overlap(const Bounds<T>& a, const Bounds<T>& b) {
  return a.lo.x <= b.hi.x && b.lo.x <= a.hi.x && a.lo.y <= b.hi.y && b.lo.y <= a.hi.y && a.lo.z <= b.hi.z &&
         b.lo.z <= a.hi.z;
}

// Bounds of collider point j = 0, 1, ... during the sweeps, grown by its radius and half the reach.
template <class T>
DIFFVBD_FN Bounds<T> collider_bounds(const IslandInputs<T>& in, int64_t scene, int32_t j) {
  const int64_t row = scene * in.colliders() + j;
  const auto at = [&](const T* p) { return Vec3<T>{p[3 * row], p[3 * row + 1], p[3 * row + 2]}; };
  const T r = in.radius[in.vertices + j] + in.half;
  Bounds<T> out = around(at(in.collider), zero3<T>(), r);
  include(out, around(at(in.collider_next), zero3<T>(), r));
  return out;
}

// The corner of a box that is the lowest along n.
template <class T>
DIFFVBD_FN Vec3<T> support_of(const Bounds<T>& box, const Vec3<T>& n) {
  return {n.x < T(0) ? box.hi.x : box.lo.x, n.y < T(0) ? box.hi.y : box.lo.y, n.z < T(0) ? box.hi.z : box.lo.z};
}

// Whether a swept box comes closer to plane l than half the reach.
template <class T>
DIFFVBD_FN bool reaches_plane(const IslandInputs<T>& in, int64_t scene, int32_t l, const Bounds<T>& box) {
  const auto at = [&](int k) {
    const T* p = in.collider_next + 3 * (scene * in.colliders() + in.planes[3 * l + k] - in.vertices);
    return vector_at(p);
  };
  const Vec3<T> a = at(0), n = cross(at(1) - a, at(2) - a);
  return dot(n, support_of(box, n) - a) < in.half * square_root(dot(n, n));
}

// Whether a swept box comes closer to plane k of a floor than half its reach.
template <class T>
DIFFVBD_FN bool reaches_floor(const IslandInputs<T>& in, int64_t scene, int32_t k, const Bounds<T>& box) {
  const T* plane = in.floor.data + scene * in.floor.scene + kPlaneScalars * k;
  const Vec3<T> n = vector_at(plane);
  return dot(n, support_of(box, n)) - plane[3] < T(0.5) * plane[kPlaneDhat];
}

template <class T>
DIFFVBD_FN bool reaches_any_plane(const IslandInputs<T>& in, int64_t scene, const Bounds<T>& box) {
  bool out = false;
  for (int32_t k = 0; k < in.num_planes && !out; ++k) out = reaches_plane(in, scene, k, box);
  for (int32_t k = 0; k < in.floor_planes && !out; ++k) out = reaches_floor(in, scene, k, box);
  return out;
}

}  // namespace diffvbd::contact
