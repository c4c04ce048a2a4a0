// Intersections: edges of surfaces through triangles, points behind planes. No distance shows them, and a start must
// have none. By signs of volumes of positions plus origins, in double precision.
#pragma once

#include "detection.h"

namespace diffvbd::contact {

// The result of a search for intersections. Unused rows are -1.
constexpr int kCrossingRow = 3;
struct Intersections {
  int64_t capacity;
  int32_t* pairs;   // [capacity, 3]  scene, edge, triangle, in this order; complete if all fit
  int64_t* counts;  // [B, 2]  edges through triangles, points behind planes
  int32_t* first;   // [B, 2, 2]  the first edge and its triangle, the first point and its plane
};

// A determinant of differences is off by less than this times the sizes of its terms (Shewchuk 1997).
constexpr double kVolumeError = (7 + 56 * 0x1p-53) * 0x1p-53;
constexpr double kPositionUlps = 8 * 0x1p-53;  // of a position, that rounding may have moved it by

// u x v, and the sizes of its terms.
struct Normal {
  Vec3<double> n, size;
};
DIFFVBD_FN Normal normal_of(const Vec3<double>& u, const Vec3<double>& v) {
  const double yz = u.y * v.z, zy = u.z * v.y, zx = u.z * v.x, xz = u.x * v.z, xy = u.x * v.y, yx = u.y * v.x;
  return {{yz - zy, zx - xz, xy - yx},
          {absolute(yz) + absolute(zy), absolute(zx) + absolute(xz), absolute(xy) + absolute(yx)}};
}
// Sign of (u x v) . w, all three differences of positions, or 0 where rounding could change it, or what is less than
// `off` [m] from the plane.
DIFFVBD_FN int side(const Normal& uv, const Vec3<double>& w, double off = 0.0) {
  const double volume = dot(uv.n, w), area = absolute(uv.n.x) + absolute(uv.n.y) + absolute(uv.n.z);
  const double bound =
      off * area + kVolumeError * dot(uv.size, Vec3<double>{absolute(w.x), absolute(w.y), absolute(w.z)});
  return bound < volume ? 1 : volume < -bound ? -1 : 0;
}

// Whether the edge from p to q meets the triangle, its border included, with ends that lie on both sides of its plane
// for certain. An end that touches is no crossing; an edge through the seam of two triangles crosses both, so that none
// slips through between them.
DIFFVBD_FN bool crosses(const Vec3<double>& p, const Vec3<double>& q, const Vec3<double>& a, const Vec3<double>& b,
                        const Vec3<double>& c) {
  const Normal plane = normal_of(b - a, c - a);
  // Most edges that are tried do not reach the plane, whatever rounding did.
  if ((dot(plane.n, p - a) < 0.0) == (dot(plane.n, q - a) < 0.0)) return false;
  // Corners of a flat face are in one plane but for the rounding of their positions, which says nothing.
  double size = 0.0;
  const Vec3<double> all[] = {p, q, a, b, c};
  for (const Vec3<double>& x : all) {
    const double own = absolute(x.x) + absolute(x.y) + absolute(x.z);
    size = size < own ? own : size;
  }
  const double off = kPositionUlps * size;
  if (side(plane, p - a, off) * side(plane, q - a, off) >= 0) return false;
  // Else what cannot be told of a degenerate triangle would count as a crossing far away.
  const auto apart = [](double p, double q, double a, double b, double c) {
    const double lo = p < q ? p : q, hi = p < q ? q : p;
    return (hi < a && hi < b && hi < c) || (a < lo && b < lo && c < lo);
  };
  if (apart(p.x, q.x, a.x, b.x, c.x) || apart(p.y, q.y, a.y, b.y, c.y) || apart(p.z, q.z, a.z, b.z, c.z)) return false;
  const Vec3<double> pq = q - p, pa = a - p, pb = b - p, pc = c - p;
  const int ab = side(normal_of(pa, pb), pq), bc = side(normal_of(pb, pc), pq), ca = side(normal_of(pc, pa), pq);
  return (ab >= 0 && bc >= 0 && ca >= 0) || (ab <= 0 && bc <= 0 && ca <= 0);
}

template <class T>
DIFFVBD_FN Vec3<double> position(const Surfaces<T>& in, int64_t scene, int32_t i) {
  const Place<T> p = place(in, in.collider, scene, i);
  return {double(p.x.x) + double(p.o.x), double(p.x.y) + double(p.o.y), double(p.x.z) + double(p.o.z)};
}

// Whether detection keeps no two features of an edge and a triangle of one body apart, because they are one place of
// the material: a crack, or doubled vertices. Seldom asked.
template <class T>
DIFFVBD_COLD bool is_one_place(const Surfaces<T>& in, const int32_t* e, const int32_t* t) {
  if (in.body[e[0]] != in.body[t[0]]) return false;
  for (int k = 0; k < 2; ++k) {
    if (!constants_of(in, Candidate{0, kPointTriangle, 0, 0, {e[k], t[0], t[1], t[2]}}).admitted) return true;
  }
  for (int k = 0; k < 3; ++k) {
    if (!constants_of(in, Candidate{0, kEdgeEdge, 0, 0, {e[0], e[1], t[k], t[(k + 1) % 3]}}).admitted) return true;
  }
  return false;
}

template <class T>
DIFFVBD_FN bool shares_vertex(const Surfaces<T>& in, int32_t edge, int32_t triangle) {
  const int32_t *e = in.edges + int64_t{2} * edge, *t = in.triangles + int64_t{3} * triangle;
  return t[0] == e[0] || t[0] == e[1] || t[1] == e[0] || t[1] == e[1] || t[2] == e[0] || t[2] == e[1];
}

// Whether an edge passes through a triangle, with which it shares no vertex, and contact should keep it from that.
template <class T>
DIFFVBD_FN bool is_crossing(const Surfaces<T>& in, int64_t scene, int32_t edge, int32_t triangle) {
  const int32_t *e = in.edges + int64_t{2} * edge, *t = in.triangles + int64_t{3} * triangle;
  // positions first: of what is tried they rule out nearly all
  return crosses(position(in, scene, e[0]), position(in, scene, e[1]), position(in, scene, t[0]),
                 position(in, scene, t[1]), position(in, scene, t[2])) &&
         !(in.pinned[e[0]] && in.pinned[e[1]] && in.pinned[t[0]] && in.pinned[t[1]] && in.pinned[t[2]]) &&
         !in.ignores(in.group(e[0]), in.group(t[0])) && !is_one_place(in, e, t);
}

// Whether a point that may move lies behind a plane; a point of a collider does not count.
template <class T>
DIFFVBD_FN bool is_behind(const Surfaces<T>& in, int64_t scene, int32_t point, int32_t plane) {
  const int32_t i = in.points[point], *t = in.planes + int64_t{3} * plane;
  if (in.pinned[i]) return false;
  const Vec3<double> a = position(in, scene, t[0]);
  return side(normal_of(position(in, scene, t[1]) - a, position(in, scene, t[2]) - a), position(in, scene, i) - a) < 0;
}

// Keys of crossings in the order of the list; those of all scenes are below crossing_keys().
template <class T>
DIFFVBD_FN uint64_t crossing_keys(const Surfaces<T>& in, int64_t scenes) {
  return static_cast<uint64_t>(scenes) * static_cast<uint64_t>(in.num_edges) * static_cast<uint64_t>(in.num_triangles);
}
template <class T>
DIFFVBD_FN uint64_t crossing_key(const Surfaces<T>& in, int64_t scene, int32_t edge, int32_t triangle) {
  return crossing_keys(in, scene) + static_cast<uint64_t>(edge) * in.num_triangles + static_cast<uint64_t>(triangle);
}
// The key of a point and a plane of one scene.
template <class T>
DIFFVBD_FN uint64_t behind_key(const Surfaces<T>& in, int32_t point, int32_t plane) {
  return static_cast<uint64_t>(point) * in.num_planes + static_cast<uint64_t>(plane);
}

template <class T>
DIFFVBD_FN void store_crossing(const Surfaces<T>& in, uint64_t key, int32_t* row) {
  const uint64_t each = crossing_keys(in, 1);
  const bool none = key == kNoKey;
  row[0] = none ? -1 : static_cast<int32_t>(key / each);
  row[1] = none ? -1 : static_cast<int32_t>(key % each / in.num_triangles);
  row[2] = none ? -1 : static_cast<int32_t>(key % in.num_triangles);
}
// The row of a scene in `first`, by the smallest keys of a crossing and of a point behind a plane, or kNoKey.
template <class T>
DIFFVBD_FN void store_first(const Surfaces<T>& in, uint64_t crossing, uint64_t behind, int32_t* row) {
  int32_t pair[kCrossingRow];
  store_crossing(in, crossing, pair);
  row[0] = pair[1], row[1] = pair[2];
  row[2] = behind == kNoKey ? -1 : static_cast<int32_t>(behind / in.num_planes);
  row[3] = behind == kNoKey ? -1 : static_cast<int32_t>(behind % in.num_planes);
}

}  // namespace diffvbd::contact
