// Distance of a pair of primitives, its gradient, and the weight of its barrier (docs/method.md, section 12). A pair
// has four corners; by the envelope theorem the gradient of the distance toward corner k is w_k n, with the weights w
// of the closest points (they sum to 0) and the unit vector n between them, whatever features are closest. Scalars may
// be Dual: the features are chosen by values, so that a derivative is that of the executed branch. Or packs of lanes,
// of pairs of one kind: what one pair needs is worked out for all, and chosen.
#pragma once

#include <cstdint>

#include "../core/dual.h"

namespace diffvbd::contact {

// The kind of the corners: point and face, edge and edge, or point and the unbounded plane of a triangle. The faces of
// a surface are its triangles, its edges as (a, b, b), and its vertices as (a, a, a).
enum Kind { kPointTriangle = 0, kEdgeEdge = 1, kPointPlane = 2 };

// Corner positions [m], relative to a point of the pair.
template <class R>
struct Corners {
  Vec3<R> x[4];
};

template <class R>
struct Distance {
  R d;        // [m] > 0; signed for a plane
  R w[4];     // weights of the corners
  Vec3<R> n;  // from the second primitive to the first
};

template <class R>
DIFFVBD_FN R clamped(const R& t) {
  return select(t < R(0), R(0), select(R(1) < t, R(1), t));
}

// Parameter of the point of the segment from a to b that is closest to p. A segment without length gives a.
template <class R>
DIFFVBD_FN R closest_on_segment(const Vec3<R>& p, const Vec3<R>& a, const Vec3<R>& b) {
  const Vec3<R> ab = b - a;
  const R length2 = dot(ab, ab);
  return select(R(0) < length2, clamped(dot(p - a, ab) / length2), R(0));
}

template <class R>
DIFFVBD_FN Vec3<R> weighted(const R* w, const Corners<R>& c) {
  return w[0] * c.x[0] + w[1] * c.x[1] + w[2] * c.x[2] + w[3] * c.x[3];
}

// Unit vector and distance from the weights alone.
template <class R>
DIFFVBD_FN void measure_along(Distance<R>& out, const Corners<R>& c) {
  const Vec3<R> r = weighted(out.w, c);
  out.d = square_root(dot(r, r));
  out.n = (R(1) / out.d) * r;
}

// The same where the closest points lie inside a face or inside both edges: along the common normal, whose direction
// does not lose digits as the gap closes.
template <class R>
DIFFVBD_FN void measure_across(Distance<R>& out, const Corners<R>& c, const Vec3<R>& normal, const R& size2) {
  const R scale = R(1) / square_root(size2);
  const R along = scale * dot(normal, weighted(out.w, c));
  const R sign = select(along < R(0), R(-1), R(1));
  out.d = sign * along;
  out.n = (sign * scale) * normal;
}

// The feature whose points are closest, of one pair at a time: kInside, where they lie inside a face or inside both
// edges, or else an end: a corner of one side, and two of the other, between which the closest point lies.
constexpr int kInside = 0;
struct End {
  int point, from, to;
};
DIFFVBD_FN End end_of(int kind, int feature) {
  if (kind == kPointTriangle) return {0, feature, feature % 3 + 1};
  const int from = feature <= 2 ? 2 : 0;
  return {feature - 1, from, from + 1};
}

// Keeps the closer of a candidate and what was found before. feature: if not null, receives its number.
template <class R>
DIFFVBD_FN void keep_closer(Distance<R>& best, R& best2, int* feature, int number, const Corners<R>& c, const R& w0,
                            const R& w1, const R& w2, const R& w3) {
  const R w[4] = {w0, w1, w2, w3};
  const Vec3<R> r = weighted(w, c);
  const R r2 = dot(r, r);
  const auto closer = r2 < best2;
  best2 = select(closer, r2, best2);
  for (int k = 0; k < 4; ++k) best.w[k] = select(closer, w[k], best.w[k]);
  if constexpr (std::is_same_v<decltype(r2 < best2), bool>) {
    if (feature != nullptr && closer) *feature = number;
  }
}

template <class M, class R>
DIFFVBD_FN Distance<R> chosen(const M& condition, const Distance<R>& a, const Distance<R>& b) {
  Distance<R> out{select(condition, a.d, b.d), {}, select(condition, a.n, b.n)};
  for (int k = 0; k < 4; ++k) out.w[k] = select(condition, a.w[k], b.w[k]);
  return out;
}

// Below this squared sine two directions count as parallel.
DIFFVBD_FN constexpr double parallel() { return 1e-16; }

// The closest points of a point and a triangle, if inside its face.
template <class R>
struct InFace {
  Vec3<R> normal;
  R size2, bound, u, v, w;
  DIFFVBD_FN explicit InFace(const Corners<R>& c) {
    const Vec3<R>&p = c.x[0], &a = c.x[1], &b = c.x[2], &e = c.x[3];
    const Vec3<R> ab = b - a, ac = e - a, ap = p - a;
    normal = cross(ab, ac);
    size2 = dot(normal, normal), bound = dot(ab, ab) * dot(ac, ac);
    const R inverse = R(1) / size2;
    v = inverse * dot(cross(ap, ac), normal), w = inverse * dot(cross(ab, ap), normal), u = R(1) - v - w;
  }
  DIFFVBD_FN auto holds() const {
    return both(R(parallel()) * bound < size2, both(R(0) < u, both(R(0) < v, R(0) < w)));
  }
  DIFFVBD_FN Distance<R> measured(const Corners<R>& c) const {
    Distance<R> out{};
    out.w[0] = R(1), out.w[1] = -u, out.w[2] = -v, out.w[3] = -w;
    measure_across(out, c, normal, size2);
    return out;
  }
};
// The closest points of two edges, if inside both.
template <class R>
struct InEdges {
  Vec3<R> normal;
  R size2, bound, s, t;
  DIFFVBD_FN explicit InEdges(const Corners<R>& c) {
    const Vec3<R> u = c.x[1] - c.x[0], v = c.x[3] - c.x[2], r = c.x[0] - c.x[2];
    normal = cross(u, v);
    size2 = dot(normal, normal), bound = dot(u, u) * dot(v, v);
    const R inverse = R(1) / size2;
    s = inverse * dot(cross(v, r), normal), t = inverse * dot(cross(u, r), normal);
  }
  DIFFVBD_FN auto holds() const {
    return both(R(parallel()) * bound < size2, both(both(R(0) < s, s < R(1)), both(R(0) < t, t < R(1))));
  }
  DIFFVBD_FN Distance<R> measured(const Corners<R>& c) const {
    Distance<R> out{};
    out.w[0] = R(1) - s, out.w[1] = s, out.w[2] = t - R(1), out.w[3] = -t;
    measure_across(out, c, normal, size2);
    return out;
  }
};

// corners: the point, then the triangle
template <class R>
DIFFVBD_FN Distance<R> point_triangle(const Corners<R>& c, int* feature = nullptr) {
  const Vec3<R>&p = c.x[0], &a = c.x[1], &b = c.x[2], &e = c.x[3];
  const InFace<R> in(c);
  const auto inside = in.holds();
  Distance<R> face{}, out{};
  if (any(inside)) {
    face = in.measured(c);
    if (all(inside)) return face;
  }
  R best2 = R(std::numeric_limits<float>::infinity());
  const R s = closest_on_segment(p, a, b), t = closest_on_segment(p, b, e), q = closest_on_segment(p, e, a);
  keep_closer(out, best2, feature, 1, c, R(1), s - R(1), -s, R(0));
  keep_closer(out, best2, feature, 2, c, R(1), R(0), t - R(1), -t);
  keep_closer(out, best2, feature, 3, c, R(1), -q, R(0), q - R(1));
  measure_along(out, c);
  return chosen(inside, face, out);
}

// corners: the ends of the first edge, then of the second
template <class R>
DIFFVBD_FN Distance<R> edge_edge(const Corners<R>& c, int* feature = nullptr) {
  const InEdges<R> in(c);
  const auto inside = in.holds();
  Distance<R> across{}, out{};
  if (any(inside)) {
    across = in.measured(c);
    if (all(inside)) return across;
  }
  R best2 = R(std::numeric_limits<float>::infinity());
  const R a = closest_on_segment(c.x[0], c.x[2], c.x[3]), b = closest_on_segment(c.x[1], c.x[2], c.x[3]);
  const R d = closest_on_segment(c.x[2], c.x[0], c.x[1]), e = closest_on_segment(c.x[3], c.x[0], c.x[1]);
  keep_closer(out, best2, feature, 1, c, R(1), R(0), a - R(1), -a);
  keep_closer(out, best2, feature, 2, c, R(0), R(1), b - R(1), -b);
  keep_closer(out, best2, feature, 3, c, R(1) - d, d, R(-1), R(0));
  keep_closer(out, best2, feature, 4, c, R(1) - e, e, R(0), R(-1));
  measure_along(out, c);
  return chosen(inside, across, out);
}

// corners: the point, then three points of the plane, counterclockwise seen from the side that is free
template <class R>
DIFFVBD_FN Distance<R> point_plane(const Corners<R>& c) {
  const Vec3<R> ab = c.x[2] - c.x[1], ac = c.x[3] - c.x[1], ap = c.x[0] - c.x[1], normal = cross(ab, ac);
  const R size2 = dot(normal, normal), scale = R(1) / square_root(size2), inverse = R(1) / size2;
  const R v = inverse * dot(cross(ap, ac), normal), w = inverse * dot(cross(ab, ap), normal);
  Distance<R> out{};
  out.w[0] = R(1), out.w[1] = v + w - R(1), out.w[2] = -v, out.w[3] = -w;
  out.n = scale * normal;
  out.d = dot(out.n, ap);
  return out;
}

// feature: if not null, receives the feature whose points are closest, of one pair.
template <class R>
DIFFVBD_FN Distance<R> distance(int kind, const Corners<R>& c, int* feature = nullptr) {
  if (feature != nullptr) *feature = kInside;
  return kind == kPointTriangle ? point_triangle(c, feature)
         : kind == kEdgeEdge    ? edge_edge(c, feature)
                                : point_plane(c);
}

// The distance at an end.
template <class R>
DIFFVBD_FN Distance<R> at_end(int kind, const End& end, const Corners<R>& c) {
  const auto corner = [&](int i) {  // chosen by comparison: an index would move the corners from registers to memory
    Vec3<R> out = c.x[0];
    for (int k = 1; k < 4; ++k) {
      out = {select(i == k, c.x[k].x, out.x), select(i == k, c.x[k].y, out.y), select(i == k, c.x[k].z, out.z)};
    }
    return out;
  };
  const R s = closest_on_segment(corner(end.point), corner(end.from), corner(end.to));
  const R sign = R(kind == kPointTriangle || end.point < 2 ? 1 : -1), from = sign * (s - R(1)), to = -sign * s;
  Distance<R> out{};
  for (int k = 0; k < 4; ++k) {
    out.w[k] = select(k == end.point, sign, select(k == end.from, from, select(k == end.to, to, R(0))));
  }
  measure_along(out, c);
  return out;
}

// distance() of a pair whose closest feature is known, to be derived: values have chosen it. Packs of lanes choose
// anew.
template <class R>
DIFFVBD_FN Distance<Dual<R>> distance_by(int kind, int feature, const Corners<Dual<R>>& c) {
  if constexpr (!std::is_arithmetic_v<R>) {
    return distance(kind, c);
  } else {
    if (kind == kPointPlane) return point_plane(c);
    if (feature != kInside) return at_end(kind, end_of(kind, feature), c);
    return kind == kPointTriangle ? InFace<Dual<R>>(c).measured(c) : InEdges<Dual<R>>(c).measured(c);
  }
}

// Constants of a listed pair. measure: of a point and a face, the point's weight times how often the face counts: 1
// less the counts of the faces that contain it, so that a point that is close to several faces of a surface has one
// barrier in all (Li et al. 2023). Of two edges u and v 1e-3 |u|^2 |v|^2 at rest [m^4].
template <class T>
struct PairConstants {
  T dhat, offset, measure;  // the first two [m]: reach of the barrier, and the radii that the gap is less than d
  DIFFVBD_FN explicit PairConstants(const T* a) : dhat(a[0]), offset(a[1]), measure(a[2]) {}
  DIFFVBD_FN PairConstants(const T& dhat, const T& offset, const T& measure)
      : dhat(dhat), offset(offset), measure(measure) {}
};

// The weight of a pair's barrier, and its gradients toward the corners: `varies` where they are not zero.
template <class R>
struct Weight {
  R e;
  Vec3<R> gradient[4];
};

// Up to this length, in dhat, from an end of an edge the weight of two edges fades: there the end has a barrier.
constexpr double kRamp = 0.5;

// A step of q = along / length from 0 to 1, with two continuous derivatives; and its first.
template <class R>
DIFFVBD_FN void ramp(const R& along, const R& length, R& value, R& slope) {
  const R q = clamped(along / length), left = R(1) - q;
  value = q * q * q * (R(10) - q * (R(15) - R(6) * q));
  slope = R(30) * q * q * left * left / length;
}

// Of two edges that are closest inside both, m(s') f(s |u|) f((1 - s) |u|) f(t |v|) f((1 - t) |v|), else 0. m(s') =
// s' (2 - s') of s' = |u x v|^2 / measure below 1, else 1, takes out the kink of edges that become parallel (Li et al.
// 2020); f fades toward the ends, beyond which the edges do not go on.
template <class R, class T>
DIFFVBD_FN Weight<R> weight_of_edges(const Corners<R>& c, const PairConstants<T>& a) {
  const InEdges<R> in(c);
  const Vec3<R> u = c.x[1] - c.x[0], v = c.x[3] - c.x[2], n = in.normal;
  const R uu = dot(u, u), uv = dot(u, v), vv = dot(v, v), reach = R(T(kRamp) * a.dhat);
  const R w[4] = {R(1) - in.s, in.s, in.t - R(1), -in.t};
  const Vec3<R> gap = weighted(w, c);
  // the mollifier, and its derivative by |u x v|^2 times 2
  const R inverse = R(1) / R(a.measure), part = inverse * in.size2;
  const auto parallel = part < R(1);
  const R m = select(parallel, part * (R(2) - part), R(1));
  const R m_rate = select(parallel, R(2) * inverse * (R(2) - R(2) * part), R(0));
  // the ramps from both ends of an edge, and their derivatives by the place and the length of the edge
  const R lengths[2] = {square_root(uu), square_root(vv)}, places[2] = {in.s, in.t};
  R f[2], by_place[2], by_length[2];
  for (int i = 0; i < 2; ++i) {
    R from, to, from_slope, to_slope;
    ramp(places[i] * lengths[i], reach, from, from_slope);
    ramp((R(1) - places[i]) * lengths[i], reach, to, to_slope);
    f[i] = from * to;
    by_place[i] = lengths[i] * (from_slope * to - from * to_slope);
    by_length[i] = (places[i] * from_slope * to + (R(1) - places[i]) * from * to_slope) / lengths[i];
  }
  const R by_s = m * f[1] * by_place[0], by_t = m * f[0] * by_place[1], turned = f[0] * f[1] * m_rate;
  // s and t solve  u . gap = v . gap = 0
  const R size = R(1) / in.size2, on_u = size * (vv * by_s + uv * by_t), on_v = -size * (uv * by_s + uu * by_t);
  const Vec3<R> by_u = (m * f[1] * by_length[0]) * u + turned * cross(v, n) - on_u * gap;
  const Vec3<R> by_v = (m * f[0] * by_length[1]) * v + turned * cross(n, u) - on_v * gap;
  const Vec3<R> by_gap = on_u * u + on_v * v;
  const auto inside = in.holds();
  Weight<R> out{select(inside, m * f[0] * f[1], R(0)), {-by_u, by_u, -by_v, by_v}};
  for (int k = 0; k < 4; ++k) out.gradient[k] = select(inside, out.gradient[k] - w[k] * by_gap, zero3<R>());
  return out;
}

// Whether the weight of an active pair may differ from a constant.
template <class R, class T>
DIFFVBD_FN auto varies(int kind, const Corners<R>& c, const Distance<R>& at, const PairConstants<T>& a) {
  const Vec3<R> u = c.x[1] - c.x[0], v = c.x[3] - c.x[2], n = cross(u, v);
  // the shorter parts of both edges
  const auto near_end = [&](const R& w, const Vec3<R>& edge) {
    const R from = absolute(w), least = select(from < R(0.5), from, R(1) - from);
    return least * least * dot(edge, edge) < R(T(kRamp * kRamp) * a.dhat * a.dhat);
  };
  const auto some = either(dot(n, n) < R(a.measure), either(near_end(at.w[1], u), near_end(at.w[3], v)));
  return kind == kEdgeEdge ? some : R(0) < R(0);
}

// The weight of a pair, without its gradients where it does not vary.
template <class R, class T, class M>
DIFFVBD_FN Weight<R> weight_of(int kind, const Corners<R>& c, const PairConstants<T>& a, const M& varied) {
  Weight<R> out{kind == kEdgeEdge ? R(1) : R(a.measure), {zero3<R>(), zero3<R>(), zero3<R>(), zero3<R>()}};
  if (!any(varied)) return out;
  const Weight<R> own = weight_of_edges(c, a);
  out.e = select(varied, own.e, out.e);
  for (int k = 0; k < 4; ++k) out.gradient[k] = select(varied, own.gradient[k], out.gradient[k]);
  return out;
}

// A record of a pair: four corner points, kind, scene. Whether corner k is one before it, of a face that is an edge or
// a vertex; and whether the pair limits motions: such a face does not, as its triangles do.
DIFFVBD_FN bool is_repeated(const int32_t* record, int k) { return k >= 2 && record[k] == record[k - 1]; }
DIFFVBD_FN bool is_limiting(const int32_t* record) { return !is_repeated(record, 3); }

}  // namespace diffvbd::contact
