// Islands: bodies that touch, or may soon, and move together until the next detection. What CPU and CUDA share: boxes
// of bodies, what a translation sweeps, and what keeps an island where it is.
#pragma once

#include <cstdint>

#include "../core/vec.h"

namespace diffvbd::contact {

constexpr int kJoins = 4;  // rounds of joining before all bodies of a scene become one island

// `vertices` of the mesh, sorted by body in body_order; corner points from there on are those of colliders.
template <class T>
struct IslandInputs {
  const T *x, *origin, *move;                  // [B, V, 3]; origin may be null
  const T* mass;                               // [1 | B, V]
  const T *collider, *collider_next, *radius;  // [B, Vc, 3] twice, [N]
  const int32_t *planes, *body;                // [L, 3], [N]
  const int32_t *body_order, *body_ptr;        // [V], [mesh_bodies + 1]
  const bool* held;                            // [N]
  int64_t scenes, mass_scene;                  // stride of scenes in mass
  int32_t vertices, corners, num_planes, mesh_bodies;
  const T* room;  // [B, mesh_bodies + 1]  how far a body's vertices may move beside the translation [m], the largest
  T half;         // the reach of the barrier [m]
  bool any_direction;  // a floor may turn the translation, which does not become longer by it

  DIFFVBD_FN T margin(int64_t scene, int32_t body) const { return room[scene * (mesh_bodies + 1) + body] + half; }
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

// Bounds of the position a + b, with room for what the sum rounds and for r all around.
template <class T>
DIFFVBD_FN Bounds<T> around(const Vec3<T>& a, const Vec3<T>& b, T r) {
  const T ulps = T(4) * std::numeric_limits<T>::epsilon();
  const Vec3<T> at = a + b;
  const Vec3<T> s{r + ulps * (absolute(a.x) + absolute(b.x)), r + ulps * (absolute(a.y) + absolute(b.y)),
                  r + ulps * (absolute(a.z) + absolute(b.z))};
  return {at - s, at + s};
}

// What a body is made of, summed over its vertices; held ones have bounds but no share in the motion.
template <class T>
struct BodySum {
  Bounds<T> bounds;
  Vec3<T> momentum;  // sum of mass times wanted motion [kg m]
  T mass;
  bool blocked;  // held somewhere, or not finite

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
DIFFVBD_FN BodySum<T> vertex_share(const IslandInputs<T>& in, int64_t scene, int32_t v) {
  const int64_t row = scene * in.vertices + v;
  const auto at = [&](const T* p) { return Vec3<T>{p[3 * row], p[3 * row + 1], p[3 * row + 2]}; };
  const Vec3<T> x = at(in.x), o = in.origin == nullptr ? zero3<T>() : at(in.origin), m = at(in.move);
  BodySum<T> out{around(x, o, T(0)), zero3<T>(), T(0), in.held[v]};
  if (!in.held[v]) {
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

// What a body may reach while its island moves by u and its vertices by `margin` from there.
template <class T>
DIFFVBD_FN Bounds<T> swept(const IslandInputs<T>& in, const Bounds<T>& body, const Vec3<T>& u, T margin) {
  const T r = in.any_direction ? margin + square_root(dot(u, u)) : margin;
  Bounds<T> out = body, end{body.lo + u, body.hi + u};
  if (!in.any_direction) include(out, end);
  const Vec3<T> m{r, r, r};
  return {out.lo - m, out.hi + m};
}

template <class T>
DIFFVBD_FN bool overlap(const Bounds<T>& a, const Bounds<T>& b) {
  return a.lo.x <= b.hi.x && b.lo.x <= a.hi.x && a.lo.y <= b.hi.y && b.lo.y <= a.hi.y && a.lo.z <= b.hi.z &&
         b.lo.z <= a.hi.z;
}

// Where collider point j = 0, 1, ... is during the sweeps that follow, grown by its radius and half the reach.
template <class T>
DIFFVBD_FN Bounds<T> collider_bounds(const IslandInputs<T>& in, int64_t scene, int32_t j) {
  const int64_t row = scene * in.colliders() + j;
  const auto at = [&](const T* p) { return Vec3<T>{p[3 * row], p[3 * row + 1], p[3 * row + 2]}; };
  const T r = in.radius[in.vertices + j] + in.half;
  Bounds<T> out = around(at(in.collider), zero3<T>(), r);
  include(out, around(at(in.collider_next), zero3<T>(), r));
  return out;
}

// Whether a swept box comes closer to plane l than half the reach.
template <class T>
DIFFVBD_FN bool reaches_plane(const IslandInputs<T>& in, int64_t scene, int32_t l, const Bounds<T>& box) {
  const auto at = [&](int k) {
    const T* p = in.collider_next + 3 * (scene * in.colliders() + in.planes[3 * l + k] - in.vertices);
    return Vec3<T>{p[0], p[1], p[2]};
  };
  const Vec3<T> a = at(0), n = cross(at(1) - a, at(2) - a);
  const Vec3<T> lowest{n.x < T(0) ? box.hi.x : box.lo.x, n.y < T(0) ? box.hi.y : box.lo.y,
                       n.z < T(0) ? box.hi.z : box.lo.z};
  return dot(n, lowest - a) < in.half * square_root(dot(n, n));
}

}  // namespace diffvbd::contact
