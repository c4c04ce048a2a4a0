// Bounding-volume trees of detection. A tree is implicit: leaves sorted along the Morton curve and padded to a power of
// two, node i over nodes 2i and 2i + 1, leaf k at node leaves + k. Boxes are single precision whatever the scalar of a
// scene, relative to a point of the scene and rounded outward, so that they only ever find too much.
#pragma once

#include <cstdint>
#include <limits>

#include "../core/vec.h"
#include "geometry.h"

namespace diffvbd::contact {

// Whose primitives a node holds: a mesh body, `mesh_bodies` for any collider, several of them, or none.
constexpr int32_t kMixed = -1, kNobody = -2;

struct alignas(16) Box {
  Vec3<float> lo;
  int32_t group;
  Vec3<float> hi;
  int32_t item;  // of a leaf: index of the primitive
};

// Meets nothing; what padding and primitives that are not finite have.
DIFFVBD_FN Box empty_box() {
  const float far = std::numeric_limits<float>::infinity();
  return {{far, far, far}, kNobody, {-far, -far, -far}, -1};
}
DIFFVBD_FN bool is_empty(const Box& a) { return !(a.lo.x <= a.hi.x); }

DIFFVBD_FN float lesser(float a, float b) { return a < b ? a : b; }
DIFFVBD_FN float greater(float a, float b) { return a < b ? b : a; }

DIFFVBD_FN Box hull(const Box& a, const Box& b) {
  const int32_t group = a.group == kNobody || a.group == b.group ? b.group : b.group == kNobody ? a.group : kMixed;
  return {{lesser(a.lo.x, b.lo.x), lesser(a.lo.y, b.lo.y), lesser(a.lo.z, b.lo.z)},
          group,
          {greater(a.hi.x, b.hi.x), greater(a.hi.y, b.hi.y), greater(a.hi.z, b.hi.z)},
          -1};
}

DIFFVBD_FN void grow(Box& a, float r) {
  a.lo = a.lo - Vec3<float>{r, r, r};
  a.hi += Vec3<float>{r, r, r};
}

// Squared distance of two boxes [m^2].
DIFFVBD_FN float distance2(const Box& a, const Box& b) {
#if defined(__CUDACC__)
  const auto apart = [](float a_lo, float a_hi, float b_lo, float b_hi) {
    return greater(greater(a_lo - b_hi, b_lo - a_hi), 0.0F);
  };
  const float x = apart(a.lo.x, a.hi.x, b.lo.x, b.hi.x), y = apart(a.lo.y, a.hi.y, b.lo.y, b.hi.y);
  const float z = apart(a.lo.z, a.hi.z, b.lo.z, b.hi.z);
  return x * x + y * y + z * z;
#else
  // Without branches, which nobody could predict: half of all boxes of a search are hit.
  using Four = float __attribute__((vector_size(16)));
  using Bits = int32_t __attribute__((vector_size(16)));
  const auto four = [](const void* p) {
    Four out;
    __builtin_memcpy(&out, p, sizeof out);
    return out;
  };
  const Four under = four(&a.lo) - four(&b.hi), over = four(&b.lo) - four(&a.hi), most = under > over ? under : over;
  const Bits kept = (most > 0.0F) & Bits{-1, -1, -1, 0};  // the last of each four is an integer
  const Four apart = reinterpret_cast<Four>(reinterpret_cast<Bits>(most) & kept), square = apart * apart;
  return square[0] + square[1] + square[2];
#endif
}

// Whether boxes overlap; empty ones may.
DIFFVBD_FN bool overlap(const Box& a, const Box& b) {
#if defined(__CUDACC__)
  return a.lo.x <= b.hi.x && b.lo.x <= a.hi.x && a.lo.y <= b.hi.y && b.lo.y <= a.hi.y && a.lo.z <= b.hi.z &&
         b.lo.z <= a.hi.z;
#else
  using Four = float __attribute__((vector_size(16)));
  using Bits = int32_t __attribute__((vector_size(16)));
  using Halves = int64_t __attribute__((vector_size(16)));
  const auto four = [](const void* p) {
    Four out;
    __builtin_memcpy(&out, p, sizeof out);
    return out;
  };
  const Bits out = ((four(&a.lo) > four(&b.hi)) | (four(&b.lo) > four(&a.hi))) & Bits{-1, -1, -1, 0};
  const Halves halves = reinterpret_cast<Halves>(out);
  return (halves[0] | halves[1]) == 0;
#endif
}

// Every third bit of the result is one of the lowest 21 of x.
DIFFVBD_FN uint64_t spread_bits(uint64_t x) {
  x = (x | x << 32) & 0x001f00000000ffff;
  x = (x | x << 16) & 0x001f0000ff0000ff;
  x = (x | x << 8) & 0x100f00f00f00f00f;
  x = (x | x << 4) & 0x10c30c30c30c30c3;
  return (x | x << 2) & 0x1249249249249249;
}

constexpr int kMostAxisBits = 16;

// Place of a box's center in the bounds of its scene along the Morton curve, axis_bits <= 21 for each axis.
DIFFVBD_FN uint64_t morton_code(const Box& a, const Box& bounds, int axis_bits) {
  if (is_empty(a)) return 0;
  const float cells = static_cast<float>(1 << axis_bits);
  const auto cell = [&](float lo, float hi, float from, float to) {
    const float at = (0.5F * (lo + hi) - from) / (to - from) * cells;  // not a number where the bounds have no length
    return at > 0.0F ? static_cast<uint64_t>(lesser(at, cells - 1.0F)) : uint64_t{0};
  };
  const uint64_t x = cell(a.lo.x, a.hi.x, bounds.lo.x, bounds.hi.x);
  const uint64_t y = cell(a.lo.y, a.hi.y, bounds.lo.y, bounds.hi.y);
  const uint64_t z = cell(a.lo.z, a.hi.z, bounds.lo.z, bounds.hi.z);
  return spread_bits(x) << 2 | spread_bits(y) << 1 | spread_bits(z);
}

// Power of two that holds n leaves; at least two, so that the root, where a traversal ends, is none of them.
inline int32_t padded_leaves(int64_t n) {
  int32_t leaves = 2;
  while (leaves < n) leaves *= 2;
  return leaves;
}

constexpr int32_t kRoot = 1;  // also where a traversal of the whole tree ends

// The node that a traversal from left to right visits after the subtree of node i.
DIFFVBD_FN int32_t next_node(int32_t i) {
  while (i & 1) i /= 2;
  return i + 1;
}

// The first leaf node in a traversal from node i that the query hits, or `end`. Empty leaves are passed over: an
// infinite query is near them, too, because the distance of infinite boxes is not a number.
template <class Hits>
DIFFVBD_FN int32_t find_leaf(const Box* nodes, int32_t leaves, int32_t i, int32_t end, const Hits& hits) {
  do {
    const Box& node = nodes[i];
    const bool hit = hits(node), leaf = i >= leaves;
    if (hit && leaf && !is_empty(node)) return i;
    i = hit && !leaf ? 2 * i : next_node(i);
  } while (i != end);
  return end;
}

// visit(leaf node) for all leaves with hits(box) in a traversal from node i to `end`, until it returns false.
template <class Hits, class Visit>
DIFFVBD_FN void each_leaf(const Box* nodes, int32_t leaves, int32_t i, int32_t end, const Hits& hits,
                          const Visit& visit) {
  do {
    i = find_leaf(nodes, leaves, i, end, hits);
    if (i == end || !visit(i)) return;
    i = next_node(i);
  } while (i != end);
}

// The pairs of primitives that detection considers: corners, gap, constants, key. Shared by CPU and CUDA, whose
// traversals differ.

// Part of the rest distance that a pair of one body keeps as the reach of its barrier, and the length, relative to the
// pair's longest edge at rest, up to which the two sides count as one place of the material.
constexpr double kRestFraction = 0.9, kSamePlace = 1e-9;
// Squared sine below which edges are mollified (Li et al. 2020), with the lengths at rest.
constexpr double kMollified = 1e-3;
// Of dhat: the reach of two edges of different bodies of which one is not sharp. The surface there is as good as flat
// and its vertices bear what rests on it; the edges bear what comes closer than vertices let it.
constexpr double kBlunt = 0.25;

// Surfaces of all scenes and what is known of their corner points: `vertices` of the mesh, then those of colliders.
template <class T>
struct Surfaces {
  const T *x, *origin;                // [B, V, 3]; origin may be null
  const T *collider, *collider_next;  // [B, Vc, 3]  at detection, and where planes are evaluated
  const T *rest, *radius;             // [N, 3], [N]
  const int32_t *triangles, *edges, *points, *planes, *body;
  const int32_t* counts;  // of triangles, then of edges: how often a face counts, and whether an edge is sharp
  const T* weights;       // [num_points] of the barrier of each point; null: measures do not matter
  const bool* pinned;
  int64_t scenes;
  int32_t vertices, corners, num_triangles, num_edges, num_points, num_planes;
  int32_t mesh_bodies;  // labels from here on are colliders
  bool self_contact, between_bodies;
  T dhat;
  const T*
      trust_radius;  // [B, mesh_bodies + 1]  radius of a body's vertices relative to their island [m], and the largest
  const T* deformation_radius;  // [B, mesh_bodies + 1]  the same relative to the rigid motion of the body

  DIFFVBD_FN int64_t key_base() const {
    const int32_t a = num_triangles < num_edges ? num_edges : num_triangles;
    const int32_t b = num_points < num_planes ? num_planes : num_points;
    return int64_t{a < b ? b : a} + 1;
  }
  // Keys of pairs are below this.
  DIFFVBD_FN uint64_t keys() const { return static_cast<uint64_t>(scenes * 3 * key_base() * key_base()); }
  // All colliders are one group: no two of them make a pair.
  DIFFVBD_FN int32_t group(int32_t corner) const { return body[corner] < mesh_bodies ? body[corner] : mesh_bodies; }
  // Whether no primitive of group a makes a pair with one of group b.
  DIFFVBD_FN bool ignores(int32_t a, int32_t b) const {
    if (a < 0 || b < 0) return false;
    if (a == b) return a == mesh_bodies || !self_contact;
    return a < mesh_bodies && b < mesh_bodies && !between_bodies;
  }
};

// The result of a detection; N corner points a scene. Unused rows of pairs and entries of `entry` are -1.
constexpr int kPairRow = 6, kConstants = 8, kNearRow = 5, kNearValues = 8, kCounts = 3;
template <class T>
struct Detected {
  int64_t capacity;
  int32_t* pairs;         // [capacity, 6]  corner points, kind, scene
  T* constants;           // [capacity, 8]  PairConstants; what limit.h takes as hints, the pair's gap last
  int32_t *ptr, *entry;   // [B N + 1], [4 capacity]  pairs of each corner point: 4 pair + local corner
  int32_t* near_corners;  // [B, N, 5]  of the near pair, and its kind; or itself and -1
  T* near_values;         // [B, N, 8]  weights, normal, gap
  int64_t* counts;        // [3]  pairs that the list needs, pairs that touch, first key of those or -1
  T* smallest;            // [B]  smallest gap [m], at most 0 where something touches
};

// A corner point of a scene, at x + o.
template <class T>
struct Place {
  Vec3<T> x, o;
};

template <class T>
DIFFVBD_FN Place<T> place(const Surfaces<T>& in, const T* collider, int64_t scene, int32_t i) {
  if (i >= in.vertices) {
    return {vector_at(collider + 3 * (scene * (in.corners - in.vertices) + i - in.vertices)), zero3<T>()};
  }
  const int64_t row = scene * in.vertices + i;
  return {vector_at(in.x + 3 * row), in.origin == nullptr ? zero3<T>() : vector_at(in.origin + 3 * row)};
}

// --- boxes

// The point that boxes of a scene are relative to: its first surface point, wherever that is finite.
template <class T>
DIFFVBD_FN Place<T> reference_point(const Surfaces<T>& in, int64_t scene) {
  if (in.num_points == 0) return {zero3<T>(), zero3<T>()};
  const Place<T> p = place(in, in.collider, scene, in.points[0]);
  const T sum = p.x.x + p.x.y + p.x.z + p.o.x + p.o.y + p.o.z;
  return sum - sum == T(0) ? p : Place<T>{zero3<T>(), zero3<T>()};
}

// Box of one corner point, empty where it is not finite; it covers what single precision and the differences round.
template <class T>
DIFFVBD_FN Box corner_box(const Surfaces<T>& in, int64_t scene, int32_t i, const Place<T>& reference) {
  const Place<T> p = place(in, in.collider, scene, i);
  const Vec3<T> a = p.x - reference.x, b = p.o - reference.o;
  const Vec3<float> at{static_cast<float>(a.x + b.x), static_cast<float>(a.y + b.y), static_cast<float>(a.z + b.z)};
  const auto slack = [](T u, T v) { return 0x1p-20F * static_cast<float>(absolute(u) + absolute(v)); };
  const Vec3<float> s{slack(a.x, b.x), slack(a.y, b.y), slack(a.z, b.z)};
  const float sum = s.x + s.y + s.z;
  if (!(sum - sum == 0.0F)) return empty_box();
  return {at - s, in.group(i), at + s, -1};
}

// Box of a primitive with n corners, whose boxes box_of(corner) gives, grown by its radius; empty where a corner is not
// finite.
template <class T, class BoxOf>
DIFFVBD_FN Box primitive_box(const Surfaces<T>& in, const int32_t* v, int n, int32_t item, const BoxOf& box_of) {
  Box out = empty_box();
  bool finite = true;
  for (int k = 0; k < n; ++k) {
    const Box corner = box_of(v[k]);
    finite = finite && !is_empty(corner);
    out = hull(out, corner);
  }
  if (!finite) out = empty_box();
  grow(out, static_cast<float>(in.radius[v[0]]) * (1.0F + 0x1p-20F));
  out.group = in.group(v[0]);  // all corners are of one body
  out.item = item;
  return out;
}

// How far a corner point may go before its pairs must be found again [m], by its body.
template <class T>
DIFFVBD_FN T trust_radius_of(const Surfaces<T>& in, int64_t scene, int32_t body) {
  return body < in.mesh_bodies ? in.trust_radius[scene * (in.mesh_bodies + 1) + body] : T(0);
}
// Up to which gap two sides of one body, with a barrier of this reach, are looked for; of all for body mesh_bodies.
template <class T>
DIFFVBD_FN T own_reach_of(const Surfaces<T>& in, int64_t scene, int32_t body, T dhat) {
  return dhat + T(2) * in.deformation_radius[scene * (in.mesh_bodies + 1) + body];
}
// Largest gap that may be found in a scene.
template <class T>
DIFFVBD_FN T reach_of(const Surfaces<T>& in, int64_t scene) {
  const T other = in.dhat + T(2) * in.trust_radius[scene * (in.mesh_bodies + 1) + in.mesh_bodies];
  const T own = own_reach_of(in, scene, in.mesh_bodies, in.dhat);
  return own < other ? other : own;
}

// Squared distances of boxes up to which a pair of a primitive of some group may be listed. Bodies that move far have
// large radii: others need no long search.
template <class T>
struct Reach {
  const Surfaces<T>& in;
  int64_t scene;
  int32_t group;  // -1: it has several
  float any;      // with a primitive of any group

  DIFFVBD_FN static float squared(T far) {
    const float reach = static_cast<float>(far) * (1.0F + 0x1p-20F);
    return reach * reach * (1.0F + 0x1p-20F);
  }
  DIFFVBD_FN float to(int32_t other) const {
    if (group < 0 || other < 0) return any;
    if (group == other && group < in.mesh_bodies) return squared(own_reach_of(in, scene, group, in.dhat));
    return squared(in.dhat + trust_radius_of(in, scene, group) + trust_radius_of(in, scene, other));
  }
};
template <class T>
DIFFVBD_FN Reach<T> squared_reach(const Surfaces<T>& in, int64_t scene, int32_t group) {
  const T most = in.trust_radius[scene * (in.mesh_bodies + 1) + in.mesh_bodies];
  const T own = own_reach_of(in, scene, group >= 0 && group < in.mesh_bodies ? group : in.mesh_bodies, in.dhat);
  const T other = in.dhat + most + (group >= 0 ? trust_radius_of(in, scene, group) : most);
  return {in, scene, group, Reach<T>::squared(other < own ? own : other)};
}

// --- pairs

struct Candidate {
  int64_t scene;
  int32_t kind, a, b;  // a point and a triangle, two edges a < b, a point and a plane
  int32_t v[4];        // corner points
  DIFFVBD_FN int second() const { return kind == kEdgeEdge ? 2 : 1; }  // first corner of the second side
};

template <class T>
DIFFVBD_FN Candidate candidate(const Surfaces<T>& in, int64_t scene, int kind, int32_t a, int32_t b) {
  if (kind == kEdgeEdge) {
    const int32_t i = a < b ? a : b, j = a < b ? b : a;
    const int32_t *e = in.edges + int64_t{2} * i, *f = in.edges + int64_t{2} * j;
    return {scene, kind, i, j, {e[0], e[1], f[0], f[1]}};
  }
  const int32_t* t = (kind == kPointTriangle ? in.triangles : in.planes) + int64_t{3} * b;
  return {scene, kind, a, b, {in.points[a], t[0], t[1], t[2]}};
}

template <class T>
DIFFVBD_FN uint64_t key_of(const Surfaces<T>& in, const Candidate& c) {
  const auto m = static_cast<uint64_t>(in.key_base());
  return (static_cast<uint64_t>(c.scene * 3 + c.kind) * m + static_cast<uint64_t>(c.a)) * m +
         static_cast<uint64_t>(c.b);
}

template <class T>
DIFFVBD_FN Candidate candidate_of_key(const Surfaces<T>& in, uint64_t key) {
  const auto m = static_cast<uint64_t>(in.key_base());
  const uint64_t rows = key / m, row = rows / m;
  return candidate(in, static_cast<int64_t>(row / 3), static_cast<int>(row % 3), static_cast<int32_t>(rows % m),
                   static_cast<int32_t>(key % m));
}

template <class T>
DIFFVBD_FN bool is_of_one_body(const Surfaces<T>& in, const Candidate& c) {
  return c.kind != kPointPlane && in.body[c.v[0]] == in.body[c.v[c.second()]];
}

// Whether the rules admit the pair, but for the distance at rest of two sides of one body.
template <class T>
DIFFVBD_FN bool is_considered(const Surfaces<T>& in, const Candidate& c) {
  const int second = c.second();
  bool pinned = in.pinned[c.v[0]];
  if (c.kind != kPointPlane) {
    for (int i = 0; i < second; ++i) {
      for (int j = second; j < 4; ++j) {
        if (c.v[i] == c.v[j]) return false;
      }
    }
    for (int k = 1; k < 4; ++k) pinned = pinned && in.pinned[c.v[k]];
    // a body's own faces are its triangles: what a point is part of is missing, and no counts would add up
    if (is_of_one_body(in, c) && !is_limiting(c.v) && c.kind == kPointTriangle) return false;
  }
  return !pinned && !in.ignores(in.group(c.v[0]), in.group(c.v[second]));
}

// Corner positions relative to the first corner, with those of colliders given.
template <class T>
DIFFVBD_FN Corners<T> corners_with(const Surfaces<T>& in, const Candidate& c, const T* collider) {
  const Place<T> first = place(in, in.collider, c.scene, c.v[0]);
  Corners<T> out;
  out.x[0] = zero3<T>();
  for (int k = 1; k < 4; ++k) {
    const Place<T> p = place(in, collider, c.scene, c.v[k]);
    out.x[k] = (p.x - first.x) + (p.o - first.o);
  }
  return out;
}
template <class T>
DIFFVBD_FN Corners<T> corners_at_rest(const Surfaces<T>& in, const Candidate& c) {
  const Vec3<T> first = vector_at(in.rest + 3 * c.v[0]);
  Corners<T> out;
  for (int k = 0; k < 4; ++k) out.x[k] = vector_at(in.rest + 3 * c.v[k]) - first;
  return out;
}

// The distance alone. Not inlined: the searches for near pairs and for the list must get the same bits, and a device
// compiler may round an inlined copy differently in each.
template <class T>
DIFFVBD_APART T separation(int kind, const Corners<T>& c) {
  return distance(kind, c).d;
}

// The same of a point and a plane, in few registers.
template <class T>
DIFFVBD_APART T height(const Corners<T>& c) {
  return point_plane(c).d;
}

template <class T>
struct Constants {
  T dhat, offset, measure;  // PairConstants
  bool admitted;            // false for two sides of one body that are one place of the material
};

template <class T>
DIFFVBD_FN T offset_of(const Surfaces<T>& in, const Candidate& c) {
  return in.radius[c.v[0]] + in.radius[c.v[c.second()]];
}

template <class T>
DIFFVBD_FN Constants<T> constants_of(const Surfaces<T>& in, const Candidate& c) {
  Constants<T> out{in.dhat, offset_of(in, c), T(1), true};
  const bool one_body = is_of_one_body(in, c);
  if (c.kind != kEdgeEdge && in.weights) {
    out.measure = in.weights[c.a] * (c.kind == kPointTriangle ? T(in.counts[c.b]) : T(1));
  }
  if (!one_body && c.kind != kEdgeEdge) return out;
  const Corners<T> rest = corners_at_rest(in, c);
  const auto squared_length = [&](int i, int j) {
    const Vec3<T> edge = rest.x[j] - rest.x[i];
    return dot(edge, edge);
  };
  const T e = c.kind == kEdgeEdge ? squared_length(0, 1) : squared_length(1, 2), f = squared_length(2, 3);
  if (c.kind == kEdgeEdge) out.measure = T(kMollified) * e * f;
  if (c.kind == kEdgeEdge && !one_body && in.weights) {
    const int32_t* sharp = in.counts + in.num_triangles;
    if (!sharp[c.a] || !sharp[c.b]) out.dhat = T(kBlunt) * in.dhat;
  }
  if (!one_body) return out;
  T longest = e < f ? f : e;
  if (c.kind == kPointTriangle && longest < squared_length(1, 3)) longest = squared_length(1, 3);
  const T at_rest = separation(c.kind, rest);
  out.admitted = at_rest > T(kSamePlace) * square_root(longest);
  if (at_rest < in.dhat) out.dhat = T(kRestFraction) * at_rest;
  return out;
}

// The gap of a pair, where its collider begins, and its smallest. A plane counts where it ends, or where it begins if
// it ends behind the point: the start moves both. A plane that moves away has acted where it came from.
template <class T>
struct PairGap {
  T gap, begins, least;
};
template <class T>
DIFFVBD_FN PairGap<T> gap_of_plane(const Surfaces<T>& in, const Candidate& c) {
  const T offset = offset_of(in, c), begins = height(corners_with(in, c, in.collider)) - offset;
  if (in.collider == in.collider_next) return {begins, begins, begins};
  const T ends = height(corners_with(in, c, in.collider_next)) - offset;
  return {ends <= T(0) ? begins : ends, begins, begins < ends ? begins : ends};
}
template <class T>
DIFFVBD_FN T gap_of_surfaces(const Surfaces<T>& in, const Candidate& c) {
  return separation(c.kind, corners_with(in, c, in.collider)) - offset_of(in, c);
}
template <class T>
DIFFVBD_FN PairGap<T> gap_of(const Surfaces<T>& in, const Candidate& c) {
  if (c.kind == kPointPlane) return gap_of_plane(in, c);
  const T gap = gap_of_surfaces(in, c);
  return {gap, gap, gap};
}

// Whether a pair whose smallest gap is this, and whose barrier reaches as far as dhat, may become active before the
// next detection, or was at this one.
template <class T>
DIFFVBD_FN bool is_listed(const Surfaces<T>& in, const Candidate& c, T gap, T dhat) {
  const int32_t first = in.body[c.v[0]], second = in.body[c.v[c.second()]];
  if (first == second && first < in.mesh_bodies) return gap < own_reach_of(in, c.scene, first, dhat);
  return gap - trust_radius_of(in, c.scene, first) - trust_radius_of(in, c.scene, second) < dhat;
}

// --- results

constexpr uint64_t kNoKey = ~uint64_t{0};  // of no pair

// Rows of near_corners and near_values of corner point i.
template <class T>
DIFFVBD_FN void store_near_pair(const Surfaces<T>& in, int64_t scene, int32_t i, uint64_t key, int32_t* corners,
                                T* values) {
  if (key == kNoKey) {
    for (int k = 0; k < kNearRow; ++k) corners[k] = k < 4 ? i : -1;
    for (int k = 0; k < kNearValues; ++k) values[k] = k == kNearValues - 1 ? reach_of(in, scene) : T(0);
    return;
  }
  const Candidate c = candidate_of_key(in, key);
  const bool plane = c.kind == kPointPlane;
  Distance<T> at = distance(c.kind, corners_with(in, c, plane ? in.collider_next : in.collider));
  if (plane && at.d - offset_of(in, c) <= T(0)) at = point_plane(corners_with(in, c, in.collider));
  for (int k = 0; k < 4; ++k) corners[k] = c.v[k], values[k] = at.w[k];
  corners[4] = c.kind;
  put(values + 4, at.n);
  values[7] = at.d - offset_of(in, c);
}

// Rows of pairs and constants of a listed pair, without the hints.
template <class T>
DIFFVBD_FN void store_listed_pair(const Surfaces<T>& in, uint64_t key, int32_t* pair, T* constants) {
  for (int k = 0; k < kConstants; ++k) constants[k] = T(0);
  if (key == kNoKey) {
    for (int k = 0; k < kPairRow; ++k) pair[k] = -1;
    return;
  }
  const Candidate c = candidate_of_key(in, key);
  for (int k = 0; k < 4; ++k) pair[k] = c.v[k];
  pair[4] = c.kind, pair[5] = static_cast<int32_t>(c.scene);
  const Constants<T> a = constants_of(in, c);
  constants[0] = a.dhat, constants[1] = a.offset, constants[2] = a.measure;
}

// The hints of a listed pair: of its corners' nearest gaps the smallest, with its direction from the second side of
// this pair to the first, and the pair's own gap. The rows of near pairs must be there.
template <class T>
DIFFVBD_FN void store_hints(const Surfaces<T>& in, const Detected<T>& out, const int32_t* pair, T* constants) {
  if (pair[4] < 0) return;
  const Candidate c{pair[5], pair[4], 0, 0, {pair[0], pair[1], pair[2], pair[3]}};
  const auto row = [&](int k) { return c.scene * in.corners + c.v[k]; };
  const auto gap = [&](int k) { return out.near_values[kNearValues * row(k) + kNearValues - 1]; };
  int nearest = 0;
  for (int k = 1; k < 4; ++k) nearest = gap(k) < gap(nearest) ? k : nearest;
  const int32_t* near = out.near_corners + kNearRow * row(nearest);
  const T* values = out.near_values + kNearValues * row(nearest);
  const int32_t own = c.v[nearest];
  const bool first = near[0] == own || (near[4] == kEdgeEdge && near[1] == own);
  const T sign = first == (nearest < c.second()) ? T(1) : T(-1);
  for (int i = 0; i < 3; ++i) constants[3 + i] = sign * values[4 + i];
  constants[6] = gap(nearest);
  constants[7] = gap_of(in, c).gap;
}

}  // namespace diffvbd::contact
