// Islands: bodies that touch, or may soon, and translate together until the next detection. Shared by CPU and CUDA:
// bounds of bodies, what a translation sweeps, what blocks an island.
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
  const bool* pinned;                          // [N]
  int64_t scenes, mass_scene;                  // stride of scenes in mass
  int32_t vertices, corners, num_planes, mesh_bodies;
  const T*
      trust_radius;    // [B, mesh_bodies + 1]  radius of a body's vertices relative to the translation [m], the largest
  T half;              // the reach of the barrier [m]
  bool any_direction;  // a floor may turn the translation, but not lengthen it

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

// Whether a swept box comes closer to plane l than half the reach.
template <class T>
DIFFVBD_FN bool reaches_plane(const IslandInputs<T>& in, int64_t scene, int32_t l, const Bounds<T>& box) {
  const auto at = [&](int k) {
    const T* p = in.collider_next + 3 * (scene * in.colliders() + in.planes[3 * l + k] - in.vertices);
    return vector_at(p);
  };
  const Vec3<T> a = at(0), n = cross(at(1) - a, at(2) - a);
  const Vec3<T> support{n.x < T(0) ? box.hi.x : box.lo.x, n.y < T(0) ? box.hi.y : box.lo.y,
                        n.z < T(0) ? box.hi.z : box.lo.z};
  return dot(n, support - a) < in.half * square_root(dot(n, n));
}

// The support vertex of an island above each plane of a floor: the vertex of minimum gap.

constexpr int kPlaneScalars = 7;  // of a plane in the data of FloorBarrier: normal, height, ...

template <class T>
struct SupportVertexInputs {
  const T *x, *origin;                   // [B, V, 3]; origin may be null
  const T* planes;                       // [1 | B, planes, kPlaneScalars]
  const int32_t *body_order, *body_ptr;  // [V], [bodies + 1]
  const int32_t* island;                 // [B, bodies]
  int64_t scenes, plane_scene;           // stride of scenes in planes
  int32_t vertices, bodies, num_planes;

  DIFFVBD_FN T gap(int64_t scene, int32_t v, int32_t plane) const {
    const T *p = planes + scene * plane_scene + plane * kPlaneScalars, *at = x + 3 * (scene * vertices + v);
    const Vec3<T> n{p[0], p[1], p[2]};
    T height = p[3];
    if (origin) height = height - dot(n, vector_at(origin + 3 * (scene * vertices + v)));
    return dot(n, vector_at(at)) - height;
  }
};

// A vertex and its gap; keep() takes the smaller gap, of equal ones the smaller vertex.
template <class T>
struct SupportVertex {
  T gap;
  int32_t vertex;
  DIFFVBD_FN void keep(const SupportVertex& other) {
    if (other.vertex < 0) return;
    if (vertex < 0 || other.gap < gap || (!(gap < other.gap) && other.vertex < vertex)) *this = other;
  }
};

// The support vertex among every `stride`-th vertex of a body from `first` on.
template <class T>
DIFFVBD_FN SupportVertex<T> support_vertex_of_body(const SupportVertexInputs<T>& in, int64_t scene, int32_t body,
                                                   int32_t plane, int32_t first, int32_t stride) {
  SupportVertex<T> out{T(0), -1};
  for (int32_t k = in.body_ptr[body] + first; k < in.body_ptr[body + 1]; k += stride) {
    const int32_t v = in.body_order[k];
    out.keep({in.gap(scene, v, plane), v});
  }
  return out;
}

// The support vertex of an island; `own` [B, bodies, planes]: those of its bodies.
template <class T>
DIFFVBD_FN int32_t support_vertex_of_island(const SupportVertexInputs<T>& in, const int32_t* own, int64_t scene,
                                            int32_t body, int32_t plane) {
  const int32_t island = in.island[scene * in.bodies + body];
  SupportVertex<T> out{T(0), -1};
  for (int32_t b = 0; b < in.bodies; ++b) {
    if (b != body && (island < 0 || in.island[scene * in.bodies + b] != island)) continue;
    const int32_t v = own[(scene * in.bodies + b) * in.num_planes + plane];
    if (v >= 0) out.keep({in.gap(scene, v, plane), v});
  }
  return out.vertex < 0 ? 0 : out.vertex;
}

// The common translation of an island until the next detection, and its adjoint: the mass-weighted mean of the wanted
// displacements, kept above the planes of a floor (docs/method.md, section 12).

template <class T>
struct TranslationInputs {
  const T *move, *mass;                    // [B, V, 3], [1 | B, V]
  const bool* pinned;                      // [V] and more
  const int32_t *body_order, *body_ptr;    // [V], [bodies + 1]
  const int32_t *island, *support_vertex;  // [B, bodies], [B, bodies, planes]
  SupportVertexInputs<T> floor;            // positions and planes; num_planes 0 without a floor
  const int32_t* body;                     // [V]
  int64_t scenes, mass_scene;
  int32_t vertices, bodies;

  DIFFVBD_FN T weight(int64_t scene, int32_t v) const { return pinned[v] ? T(0) : mass[scene * mass_scene + v]; }
  DIFFVBD_FN Vec3<T> motion(int64_t scene, int32_t v) const { return vector_at(move + 3 * (scene * vertices + v)); }
};

// Sums of mass times motion, and of mass.
template <class T>
struct Mean {
  Vec3<T> sum;
  T mass;
  DIFFVBD_FN void add(const Mean& b) {
    sum += b.sum;
    mass = mass + b.mass;
  }
  DIFFVBD_FN Vec3<T> value() const { return T(0) < mass ? (T(1) / mass) * sum : zero3<T>(); }
};

template <class T>
DIFFVBD_FN Mean<T> mean_of_body(const TranslationInputs<T>& in, int64_t scene, int32_t body, int32_t first,
                                int32_t stride) {
  Mean<T> out{zero3<T>(), T(0)};
  for (int32_t k = in.body_ptr[body] + first; k < in.body_ptr[body + 1]; k += stride) {
    const int32_t v = in.body_order[k];
    const T m = in.weight(scene, v);
    out.add({m * in.motion(scene, v), m});
  }
  return out;
}

// Adds up f(body) over the bodies of the island that `body` is in.
template <class T, class Sum, class F>
DIFFVBD_FN void over_island(const TranslationInputs<T>& in, int64_t scene, int32_t body, Sum& sum, F&& f) {
  const int32_t* island = in.island + scene * in.bodies;
  for (int32_t b = 0; b < in.bodies; ++b) {
    if (island[b] == island[body]) f(sum, b);
  }
}
template <class T>
DIFFVBD_FN Mean<T> mean_of_island(const TranslationInputs<T>& in, const T* sums, int64_t scene, int32_t body) {
  Mean<T> out{zero3<T>(), T(0)};
  over_island(in, scene, body, out, [&](Mean<T>& sum, int32_t b) {
    const T* p = sums + 4 * (scene * in.bodies + b);
    sum.add({vector_at(p), p[3]});
  });
  return out;
}

constexpr int kMostPlanes = 8;

// One plane of the floor for one island.
template <class T>
struct FloorClearance {
  Vec3<T> n;
  T gap, value;  // of the support vertex; largest translation toward the plane [m]
  DIFFVBD_FN FloorClearance(const TranslationInputs<T>& in, int64_t scene, int32_t body, int32_t plane) {
    const T* p = in.floor.planes + scene * in.floor.plane_scene + plane * kPlaneScalars;
    const int32_t v = in.support_vertex[(scene * in.bodies + body) * in.floor.num_planes + plane];
    n = {p[0], p[1], p[2]};
    gap = in.floor.gap(scene, v, plane) - p[5];
    value = T(0) < gap ? gap : T(0);
  }
};

// Keeps u above the planes; `before` receives u before each plane. False, with u = 0, where the planes leave no
// direction.
template <class T>
DIFFVBD_FN bool hold_above(const TranslationInputs<T>& in, int64_t scene, int32_t body, Vec3<T>& u, Vec3<T>* before) {
  const T slack = T(8) * std::numeric_limits<T>::epsilon() * square_root(dot(u, u));
  const int32_t planes = in.floor.num_planes;
  for (int32_t k = 0; k < planes; ++k) {
    const FloorClearance<T> clearance(in, scene, body, k);
    before[k] = u;
    const T excess = -dot(clearance.n, u) - clearance.value;
    if (T(0) < excess) u += excess * clearance.n;
  }
  for (int32_t k = 0; k < planes; ++k) {
    const FloorClearance<T> clearance(in, scene, body, k);
    if (clearance.value * (T(1) + T(1e-6)) + slack < -dot(clearance.n, u)) {
      u = zero3<T>();
      return false;
    }
  }
  return true;
}

// Translation of the island that a body is in.
template <class T>
DIFFVBD_FN Vec3<T> translation_of(const TranslationInputs<T>& in, const T* sums, int64_t scene, int32_t body) {
  if (in.island[scene * in.bodies + body] < 0) return zero3<T>();
  Vec3<T> u = mean_of_island(in, sums, scene, body).value(), before[kMostPlanes];
  hold_above(in, scene, body, u, before);
  return u;
}

// Adjoint for an island, by its first body: u_bar of its bodies -> rate = adjoint of the mean over its mass, and the
// adjoints of the support vertices (x_bar [B, V, 3]) and planes (data_bar, of the body).
template <class T>
DIFFVBD_FN void reverse_island(const TranslationInputs<T>& in, const T* sums, const T* u_bar, int64_t scene,
                               int32_t body, T* rate, T* mean, T* x_bar, T* data_bar) {
  const int64_t row = scene * in.bodies + body;
  const int32_t planes = in.floor.num_planes;
  if (in.island[row] != body) return;  // not the first body, or a blocked island
  Vec3<T> bar = zero3<T>();
  over_island(in, scene, body, bar,
              [&](Vec3<T>& sum, int32_t b) { sum += vector_at(u_bar + 3 * (scene * in.bodies + b)); });
  const Mean<T> island = mean_of_island(in, sums, scene, body);
  const Vec3<T> start = island.value();
  Vec3<T> u = start, before[kMostPlanes];
  if (!hold_above(in, scene, body, u, before)) bar = zero3<T>();
  for (int32_t k = planes - 1; k >= 0; --k) {
    const FloorClearance<T> clearance(in, scene, body, k);
    const T excess = -dot(clearance.n, before[k]) - clearance.value;
    if (!(T(0) < excess)) continue;
    const T along = dot(clearance.n, bar), clearance_bar = T(0) < clearance.gap ? -along : T(0);
    const int32_t v = in.support_vertex[row * planes + k];
    const int64_t at = 3 * (scene * in.vertices + v);
    Vec3<T> position = vector_at(in.floor.x + at);
    if (in.floor.origin) position += vector_at(in.floor.origin + at);
    T* to = data_bar + kPlaneScalars * k;
    add_to(to, excess * bar - along * before[k] + clearance_bar * position);
    to[3] -= clearance_bar, to[5] -= clearance_bar;
    add_to(x_bar + at, clearance_bar * clearance.n);
    bar -= along * clearance.n;
  }
  const T inverse = T(0) < island.mass ? T(1) / island.mass : T(0);
  put(rate + 3 * row, inverse * bar);
  put(mean + 3 * row, start);
}

// The adjoint of one vertex; rate and mean are those of its island's first body.
template <class T>
DIFFVBD_FN void reverse_vertex_mean(const TranslationInputs<T>& in, const T* rate, const T* mean, int64_t scene,
                                    int32_t v, T* move_bar, T* mass_bar) {
  const int32_t island = in.island[scene * in.bodies + in.body[v]];
  const int64_t row = scene * in.vertices + v, first = scene * in.bodies + (island < 0 ? 0 : island);
  const bool counts = island >= 0 && !in.pinned[v];
  const Vec3<T> bar = counts ? vector_at(rate + 3 * first) : zero3<T>(), center = vector_at(mean + 3 * first);
  put(move_bar + 3 * row, in.weight(scene, v) * bar);
  mass_bar[row] = counts ? dot(in.motion(scene, v) - center, bar) : T(0);
}

}  // namespace diffvbd::contact
