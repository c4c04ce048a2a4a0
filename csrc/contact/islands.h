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

// The lowest vertex of an island above each plane of a floor: how far a common translation may go down.

constexpr int kPlaneScalars = 7;  // of a plane in the data of FloorBarrier: normal, height, ...

template <class T>
struct LowestInputs {
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
    if (origin) {
      const T* o = origin + 3 * (scene * vertices + v);
      height = height - dot(n, Vec3<T>{o[0], o[1], o[2]});
    }
    return dot(n, Vec3<T>{at[0], at[1], at[2]}) - height;
  }
};

// A vertex and its gap; the lower one is kept, of equal ones that with the smaller number.
template <class T>
struct Lowest {
  T gap;
  int32_t vertex;
  DIFFVBD_FN void keep(const Lowest& other) {
    if (other.vertex < 0) return;
    if (vertex < 0 || other.gap < gap || (!(gap < other.gap) && other.vertex < vertex)) *this = other;
  }
};

// Of every `stride`-th vertex of a body from `first` on.
template <class T>
DIFFVBD_FN Lowest<T> lowest_of_body(const LowestInputs<T>& in, int64_t scene, int32_t body, int32_t plane,
                                    int32_t first, int32_t stride) {
  Lowest<T> out{T(0), -1};
  for (int32_t k = in.body_ptr[body] + first; k < in.body_ptr[body + 1]; k += stride) {
    const int32_t v = in.body_order[k];
    out.keep({in.gap(scene, v, plane), v});
  }
  return out;
}

// Of the bodies of an island; `own` [B, bodies, planes] holds theirs.
template <class T>
DIFFVBD_FN int32_t lowest_of_island(const LowestInputs<T>& in, const int32_t* own, int64_t scene, int32_t body,
                                    int32_t plane) {
  const int32_t island = in.island[scene * in.bodies + body];
  Lowest<T> out{T(0), -1};
  for (int32_t b = 0; b < in.bodies; ++b) {
    if (b != body && (island < 0 || in.island[scene * in.bodies + b] != island)) continue;
    const int32_t v = own[(scene * in.bodies + b) * in.num_planes + plane];
    if (v >= 0) out.keep({in.gap(scene, v, plane), v});
  }
  return out.vertex < 0 ? 0 : out.vertex;
}

// The common translation of an island until the next detection, and its adjoint: the mass-weighted mean of where its
// vertices want to go, held above the planes of a floor (docs/method.md, section 12).

template <class T>
struct TranslationInputs {
  const T *move, *mass;                  // [B, V, 3], [1 | B, V]
  const bool* held;                      // [V] and more
  const int32_t *body_order, *body_ptr;  // [V], [bodies + 1]
  const int32_t *island, *lowest;        // [B, bodies], [B, bodies, planes]
  LowestInputs<T> floor;                 // positions and planes; num_planes 0 without a floor
  const int32_t* body;                   // [V]
  int64_t scenes, mass_scene;
  int32_t vertices, bodies;

  DIFFVBD_FN T weight(int64_t scene, int32_t v) const { return held[v] ? T(0) : mass[scene * mass_scene + v]; }
  DIFFVBD_FN Vec3<T> motion(int64_t scene, int32_t v) const {
    const T* p = move + 3 * (scene * vertices + v);
    return {p[0], p[1], p[2]};
  }
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
    sum.add({{p[0], p[1], p[2]}, p[3]});
  });
  return out;
}

constexpr int kMostPlanes = 8;

// One plane of the floor for one island.
template <class T>
struct Room {
  Vec3<T> n;
  T gap, value;  // of the lowest vertex; how far down the island may go [m]
  DIFFVBD_FN Room(const TranslationInputs<T>& in, int64_t scene, int32_t body, int32_t plane) {
    const T* p = in.floor.planes + scene * in.floor.plane_scene + plane * kPlaneScalars;
    const int32_t v = in.lowest[(scene * in.bodies + body) * in.floor.num_planes + plane];
    n = {p[0], p[1], p[2]};
    gap = in.floor.gap(scene, v, plane) - p[5];
    value = T(0) < gap ? gap : T(0);
  }
};

// u held above the planes; `before` receives u before each plane. Where planes at an angle leave no way, u is 0: false.
template <class T>
DIFFVBD_FN bool hold_above(const TranslationInputs<T>& in, int64_t scene, int32_t body, Vec3<T>& u, Vec3<T>* before) {
  const T slack = T(8) * std::numeric_limits<T>::epsilon() * square_root(dot(u, u));
  const int32_t planes = in.floor.num_planes;
  for (int32_t k = 0; k < planes; ++k) {
    const Room<T> room(in, scene, body, k);
    before[k] = u;
    const T excess = -dot(room.n, u) - room.value;
    if (T(0) < excess) u += excess * room.n;
  }
  for (int32_t k = 0; k < planes; ++k) {
    const Room<T> room(in, scene, body, k);
    if (room.value * (T(1) + T(1e-6)) + slack < -dot(room.n, u)) {
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

// Adjoint for an island, worked out by its first body: u_bar of its bodies -> rate = adjoint of the mean over its mass,
// and what the lowest vertices (x_bar [B, V, 3]) and the planes (data_bar, of the body) receive.
template <class T>
DIFFVBD_FN void reverse_island(const TranslationInputs<T>& in, const T* sums, const T* u_bar, int64_t scene,
                               int32_t body, T* rate, T* mean, T* x_bar, T* data_bar) {
  const int64_t row = scene * in.bodies + body;
  const int32_t planes = in.floor.num_planes;
  if (in.island[row] != body) return;  // its first body does it, and an untranslatable island has none
  Vec3<T> bar = zero3<T>();
  over_island(in, scene, body, bar, [&](Vec3<T>& sum, int32_t b) {
    const T* p = u_bar + 3 * (scene * in.bodies + b);
    sum += Vec3<T>{p[0], p[1], p[2]};
  });
  const Mean<T> island = mean_of_island(in, sums, scene, body);
  const Vec3<T> start = island.value();
  Vec3<T> u = start, before[kMostPlanes];
  if (!hold_above(in, scene, body, u, before)) bar = zero3<T>();
  for (int32_t k = planes - 1; k >= 0; --k) {
    const Room<T> room(in, scene, body, k);
    const T excess = -dot(room.n, before[k]) - room.value;
    if (!(T(0) < excess)) continue;
    const T along = dot(room.n, bar), room_bar = T(0) < room.gap ? -along : T(0);
    const int32_t v = in.lowest[row * planes + k];
    const T* at = in.floor.x + 3 * (scene * in.vertices + v);
    Vec3<T> position{at[0], at[1], at[2]};
    if (in.floor.origin) {
      const T* o = in.floor.origin + 3 * (scene * in.vertices + v);
      position += Vec3<T>{o[0], o[1], o[2]};
    }
    const Vec3<T> n_bar = excess * bar - along * before[k] + room_bar * position, lowest_bar = room_bar * room.n;
    T *to = data_bar + kPlaneScalars * k, *lowest = x_bar + 3 * (scene * in.vertices + v);
    to[0] += n_bar.x, to[1] += n_bar.y, to[2] += n_bar.z;
    to[3] -= room_bar;
    to[5] -= room_bar;
    lowest[0] += lowest_bar.x, lowest[1] += lowest_bar.y, lowest[2] += lowest_bar.z;
    bar -= along * room.n;
  }
  const T inverse = T(0) < island.mass ? T(1) / island.mass : T(0);
  const Vec3<T> out = inverse * bar;
  T *r = rate + 3 * row, *m = mean + 3 * row;
  r[0] = out.x, r[1] = out.y, r[2] = out.z;
  m[0] = start.x, m[1] = start.y, m[2] = start.z;
}

// Of one vertex; rate and mean are those of its island's first body.
template <class T>
DIFFVBD_FN void reverse_vertex_share(const TranslationInputs<T>& in, const T* rate, const T* mean, int64_t scene,
                                     int32_t v, T* move_bar, T* mass_bar) {
  const int32_t island = in.island[scene * in.bodies + in.body[v]];
  const int64_t row = scene * in.vertices + v, first = scene * in.bodies + (island < 0 ? 0 : island);
  const bool counts = island >= 0 && !in.held[v];
  const T *r = rate + 3 * first, *m = mean + 3 * first;
  const Vec3<T> bar = counts ? Vec3<T>{r[0], r[1], r[2]} : zero3<T>(), center{m[0], m[1], m[2]};
  const Vec3<T> to = in.weight(scene, v) * bar;
  move_bar[3 * row] = to.x, move_bar[3 * row + 1] = to.y, move_bar[3 * row + 2] = to.z;
  mass_bar[row] = counts ? dot(in.motion(scene, v) - center, bar) : T(0);
}

}  // namespace diffvbd::contact
