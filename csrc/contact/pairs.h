// The barrier of a pair in the block of one of its corners, and the exact adjoint (docs/method.md, section 12): the
// gradient of e b(gap), and of its Hessian e b'' grad_gap grad_gap^T. `together`: the number of corners that move at
// once, this one included; the block takes so many times the stiffness along the normal, so that together they do not
// overshoot.
#pragma once

#include "../energies/log_barrier.h"
#include "geometry.h"

namespace diffvbd::contact {

// Constants of a listed pair.
template <class T>
struct PairConstants {
  T dhat, offset;  // [m], radii that the gap is less than the distance [m]
  T threshold;     // of two edges: of the mollifier [m^4]; else: what the pair counts
  DIFFVBD_FN explicit PairConstants(const T* a) : dhat(a[0]), offset(a[1]), threshold(a[2]) {}
  DIFFVBD_FN PairConstants(const T& dhat, const T& offset, const T& threshold)
      : dhat(dhat), offset(offset), threshold(threshold) {}
  // b of a gap, times a size and what the pair counts
  template <class R>
  DIFFVBD_FN LogBarrier<R> barrier(int kind, const R& gap, const R& size) const {
    return LogBarrier<R>(gap, R(dhat), kind == kEdgeEdge ? size : R(threshold) * size);
  }
};

// The item of corner i; in a pack of lanes each has an i of its own.
template <class A>
DIFFVBD_FN const A& of_corner(const A (&a)[4], int i) {
  return a[i];
}
DIFFVBD_FN bool is_corner(int i, int k) { return i == k; }

// The barrier of a pair: e (b(gap) - b(gap of the ends)) of two edges that are closest inside both, else b(gap).
template <class R>
struct PairTerms {
  R e;                        // mollifier; 0 where an end is closest, whose faces push
  LogBarrier<R> inner, ends;  // b at the closest points, and at the closest end, 0 but of two edges
  Distance<R> at_ends;
  Mollifier<R> m;

  // The stiffness along n in the block of a vertex, which must be positive semidefinite, and its derivative by the gap:
  // what counts negative has none there.
  DIFFVBD_FN R along() const { return select(R(0) < inner.second, inner.second, R(0)); }
  DIFFVBD_FN R along_rate() const { return select(R(0) < inner.second, inner.third, R(0)); }
  // Curvature of -b(ends) across the normal of the ends, over w w: Hess d <= w w (1 - n n') / d.
  DIFFVBD_FN R across() const { return select(R(0) < e, -(e * ends.first) / at_ends.d, R(0)); }
  DIFFVBD_FN R height() const { return inner.value - ends.value; }
  DIFFVBD_FN R value() const { return e * height(); }
  // what corner k gets beside its share of the force e b' n: of the mollifier and of the ends
  DIFFVBD_FN Vec3<R> pull(int k) const {
    return height() * m.gradient[k] - (e * ends.first * at_ends.w[k]) * at_ends.n;
  }
};
// at: the distance of the pair; size: kappa, times h^2 in a block. feature: if not null, receives that of the ends.
template <class R, class T>
DIFFVBD_FN PairTerms<R> pair_terms(int kind, const Corners<R>& c, const Distance<R>& at, const PairConstants<T>& a,
                                   const R& size, int* feature = nullptr) {
  PairTerms<R> out{R(1), a.barrier(kind, at.d - R(a.offset), size), LogBarrier<R>(R(1), R(1), R(0)), {}, {}};
  for (int k = 0; k < 4; ++k) out.m.gradient[k] = zero3<R>(), out.at_ends.w[k] = R(0);
  out.at_ends.n = zero3<R>();
  if (kind != kEdgeEdge) return out;
  out.at_ends = edge_ends(c, feature);
  const auto inside = at.d < out.at_ends.d;
  out.ends = a.barrier(kind, out.at_ends.d - R(a.offset), size);
  const auto mollified = both(inside, is_mollified(kind, c, a.threshold));
  if (any(mollified)) {
    const Mollifier<R> m = mollifier(c, a.threshold);
    out.e = select(mollified, m.e, out.e);
    for (int k = 0; k < 4; ++k) out.m.gradient[k] = select(mollified, m.gradient[k], zero3<R>());
  }
  out.e = select(inside, out.e, R(0));
  return out;
}

// Adds the barrier's part of the block of corner i of a pair whose distance is `at`; returns whether it is active. H
// has what counts positive, and stays positive semidefinite.
template <class R, class Index>
DIFFVBD_FN auto add_barrier(int kind, const Corners<R>& c, const Distance<R>& at, const Index& i, const R& together,
                            const PairConstants<R>& a, const R& kappa, const R& h2, Vec3<R>& g, Sym3<R>& H) {
  const auto active = at.d - a.offset < a.dhat;
  if (!any(active)) return active;
  const PairTerms<R> t = pair_terms(kind, c, at, a, h2 * kappa);
  const R w = of_corner(at.w, i);
  if (kind == kEdgeEdge) {
    const Vec3<R> pull[4] = {t.pull(0), t.pull(1), t.pull(2), t.pull(3)};
    g += of_corner(pull, i);
    const R w_end = of_corner(t.at_ends.w, i), across = together * t.across() * w_end * w_end;
    add_diagonal(H, across);
    add_outer(H, -across, t.at_ends.n);
  }
  g += (t.e * t.inner.first * w) * at.n;
  const R bend = select(R(0) < t.inner.first, t.inner.first / at.d, R(0)), over = together * bend * w * w;
  add_diagonal(H, over);
  add_outer(H, together * t.e * t.along() * w * w - over, at.n);
  return active;
}

// Adjoint of phi = p . (g + H d_raw) of corner i, negated: what the corners and kappa receive. H is linear in
// `together`, so it multiplies d_raw.
template <class T>
struct PairAdjoint {
  Vec3<T> x[4];
  T kappa;
};

// The Hessians of gap and mollifier are needed only times vectors that sit at corner i: one Dual evaluation each.
template <class T, class Index>
DIFFVBD_FN Corners<Dual<T>> moved_along(const Corners<T>& c, const Index& i, const Vec3<T>& z) {
  Corners<Dual<T>> out;
  for (int k = 0; k < 4; ++k) {
    const T on = select(is_corner(i, k), T(1), T(0));
    out.x[k] = {Dual<T>(c.x[k].x, on * z.x), Dual<T>(c.x[k].y, on * z.y), Dual<T>(c.x[k].z, on * z.z)};
  }
  return out;
}
template <class T>
DIFFVBD_FN Vec3<T> derivative(const Vec3<Dual<T>>& a) {
  return {a.x.derivative, a.y.derivative, a.z.derivative};
}

// Returns whether the pair is active; if not, it receives nothing.
template <class R, class Index>
DIFFVBD_FN auto reverse_barrier(int kind, const Corners<R>& c, const Index& i, const R& together,
                                const PairConstants<R>& a, const R& kappa, const R& h2, const Vec3<R>& p,
                                const Vec3<R>& d, PairAdjoint<R>& out) {
  const Vec3<R> d_raw = together * d;
  int feature = kInside, end = kInside;
  const Distance<R> at = distance(kind, c, &feature);
  const auto active = at.d - a.offset < a.dhat;
  if (!any(active)) return active;
  const PairTerms<R> x = pair_terms(kind, c, at, a, h2, &end);  // kappa scales everything: it comes last
  const LogBarrier<R>& b = x.inner;
  const R& e = x.e;
  const R w = of_corner(at.w, i), s = w * dot(at.n, p), t = w * dot(at.n, d_raw);
  const R toward = dot(of_corner(x.m.gradient, i), p), along = x.along(), by_e = b.first * s + along * s * t;
  const auto negative = both(active, R(0) < b.first);
  const R over = select(negative, b.first / at.d, R(0)), over_rate = select(negative, (b.second - over) / at.d, R(0));
  const R spread_in = w * w * dot(p, d_raw) - s * t;
  const R by_gap = b.first * toward + e * (b.second * s + x.along_rate() * s * t) + over_rate * spread_in;
  const Vec3<R> z = (e * (b.first + along * t)) * p + (e * along * s) * d_raw +
                    over * ((R(2) * dot(p, d_raw) * w) * at.n - t * p - s * d_raw);
  const Distance<Dual<R>> turned = distance_by(kind, feature, moved_along(c, i, z));
  for (int k = 0; k < 4; ++k) {
    const Vec3<Dual<R>> row = turned.w[k] * turned.n;
    out.x[k] = by_gap * at.w[k] * at.n + derivative(row);
  }
  R phi = e * by_e + x.height() * toward + over * spread_in;
  const auto ended = both(active, R(0) < e);
  if (kind == kEdgeEdge && any(ended)) {
    const R w_end = of_corner(x.at_ends.w, i), s_end = w_end * dot(x.at_ends.n, p);
    const R t_end = w_end * dot(x.at_ends.n, d_raw), spread = w_end * w_end * dot(p, d_raw) - s_end * t_end;
    const R slack = select(ended, x.at_ends.d, R(1)), bend = x.ends.first / slack;
    const R of_ends = x.ends.first * s_end + bend * spread;
    const R by_end = x.ends.first * toward + e * (x.ends.second * s_end + (x.ends.second - bend) / slack * spread);
    const Vec3<R> across = (R(2) * dot(p, d_raw) * w_end) * x.at_ends.n - t_end * p - s_end * d_raw;
    const Distance<Dual<R>> beside = ends_by(end, moved_along(c, i, (e * x.ends.first) * p + (e * bend) * across));
    const auto mollified = is_mollified(kind, c, a.threshold);
    Mollifier<Dual<R>> curved{};
    if (any(mollified)) curved = mollifier(moved_along(c, i, x.height() * p), a.threshold);
    for (int k = 0; k < 4; ++k) {
      const Vec3<Dual<R>> row = beside.w[k] * beside.n;
      Vec3<R> more = (by_e - of_ends) * x.m.gradient[k] - by_end * x.at_ends.w[k] * x.at_ends.n - derivative(row);
      if (any(mollified)) more += select(mollified, derivative(curved.gradient[k]), zero3<R>());
      out.x[k] += select(ended, more, zero3<R>());
    }
    phi = phi - select(ended, e * of_ends, R(0));
  }
  for (int k = 0; k < 4; ++k) out.x[k] = (-kappa) * out.x[k];
  out.kappa = -phi;
  return active;
}

}  // namespace diffvbd::contact
