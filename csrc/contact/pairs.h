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

// The barrier of a pair: e (b(gap) - b(gap of the ends)) of two edges that are closest inside both, 0 where an end is
// closest, whose faces push; else b(gap).
template <class R>
struct PairTerms {
  R e, inside;                // mollifier; 0 where two edges are closest at an end, else 1
  LogBarrier<R> inner, ends;  // b at the closest points, and at the closest end, 0 but of two edges
  Distance<R> at_ends;
  Mollifier<R> m;

  // The stiffness in the block of a vertex does not know what is inside, lest it jump there: along n that of what
  // counts positive; across n that of what counts negative, as Hess d <= w w (1 - n n') / d.
  DIFFVBD_FN R along() const { return select(R(0) < inner.second, e * inner.second, R(0)); }
  DIFFVBD_FN R along_rate() const { return select(R(0) < inner.second, e * inner.third, R(0)); }
  DIFFVBD_FN R first() const { return inside * e * inner.first; }
  DIFFVBD_FN R height() const { return inside * (inner.value - ends.value); }
  DIFFVBD_FN R value() const { return e * height(); }
  // what corner k gets beside its share of the force along n: of the mollifier and of the ends
  DIFFVBD_FN Vec3<R> pull(int k) const {
    return height() * m.gradient[k] - (inside * e * ends.first * at_ends.w[k]) * at_ends.n;
  }
};
// at: the distance of the pair; size: kappa, times h^2 in a block. feature: if not null, receives that of the ends.
template <class R, class T>
DIFFVBD_FN PairTerms<R> pair_terms(int kind, const Corners<R>& c, const Distance<R>& at, const PairConstants<T>& a,
                                   const R& size, int* feature = nullptr) {
  PairTerms<R> out{R(1), R(1), a.barrier(kind, at.d - R(a.offset), size), LogBarrier<R>(R(1), R(1), R(0)), {}, {}};
  for (int k = 0; k < 4; ++k) out.m.gradient[k] = zero3<R>(), out.at_ends.w[k] = R(0);
  out.at_ends.n = zero3<R>(), out.at_ends.d = R(1);
  if (kind != kEdgeEdge) return out;
  out.at_ends = edge_ends(c, feature);
  out.inside = select(at.d < out.at_ends.d, R(1), R(0));
  out.ends = a.barrier(kind, out.at_ends.d - R(a.offset), size);
  const auto mollified = is_mollified(kind, c, a.threshold);
  if (any(mollified)) {
    const Mollifier<R> m = mollifier(c, a.threshold);
    out.e = select(mollified, m.e, out.e);
    for (int k = 0; k < 4; ++k) out.m.gradient[k] = select(mollified, m.gradient[k], zero3<R>());
  }
  return out;
}
// The curvature across the normal of a part of the potential with the slope b over a distance d, where it is positive.
template <class R>
DIFFVBD_FN R curvature_across(const R& slope, const R& d) {
  return select(R(0) < slope, slope / d, R(0));
}

// Adds the barrier's part of the block of corner i of a pair whose distance is `at`; returns whether it is active.
template <class R, class Index>
DIFFVBD_FN auto add_barrier(int kind, const Corners<R>& c, const Distance<R>& at, const Index& i, const R& together,
                            const PairConstants<R>& a, const R& kappa, const R& h2, Vec3<R>& g, Sym3<R>& H) {
  const auto active = at.d - a.offset < a.dhat;
  if (!any(active)) return active;
  const PairTerms<R> t = pair_terms(kind, c, at, a, h2 * kappa);
  const auto add_across = [&](const R& slope, const Distance<R>& of) {
    const R w = of_corner(of.w, i), across = together * curvature_across(slope, of.d) * w * w;
    add_diagonal(H, across);
    add_outer(H, -across, of.n);
  };
  const R w = of_corner(at.w, i);
  g += (t.first() * w) * at.n;
  add_outer(H, together * t.along() * w * w, at.n);
  if (kind == kEdgeEdge) {
    const Vec3<R> pull[4] = {t.pull(0), t.pull(1), t.pull(2), t.pull(3)};
    g += of_corner(pull, i);
    add_across(-(t.e * t.ends.first), t.at_ends);
  } else {
    add_across(t.inner.first, at);
  }
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

// What one part of phi, f = slope w (n.p) + along w^2 (n.p) (n.d) + across w^2 (p.d - (n.p) (n.d)) of corner i, gives:
// the derivative by the distance d whose gradient is w n, and the vector that d's Hessian multiplies.
template <class R>
struct PartAdjoint {
  R f, by_distance;
  Vec3<R> z;
};
template <class R>
DIFFVBD_FN PartAdjoint<R> part_adjoint(const Distance<R>& at, const R& w, const Vec3<R>& p, const Vec3<R>& d,
                                       const R (&slope)[2], const R (&along)[2], const R (&across)[2]) {
  const R s = w * dot(at.n, p), t = w * dot(at.n, d), pd = dot(p, d), spread = w * w * pd - s * t;
  const R both = along[0] - across[0];
  return {slope[0] * s + along[0] * s * t + across[0] * spread, slope[1] * s + along[1] * s * t + across[1] * spread,
          (slope[0] + both * t) * p + (both * s) * d + (R(2) * across[0] * w * pd) * at.n};
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
  // the slope of a curvature across n, slope / d, by d
  const auto rate = [](const R& across, const R& second, const R& d) {
    return select(R(0) < across, (second - across) / d, R(0));
  };
  const R toward = x.inside * dot(of_corner(x.m.gradient, i), p), zero = R(0);
  const R over = kind == kEdgeEdge ? zero : curvature_across(b.first, at.d);
  const auto own = part_adjoint(at, of_corner(at.w, i), p, d_raw, {x.first(), x.inside * x.e * b.second},
                                {x.along(), x.along_rate()}, {over, rate(over, b.second, at.d)});
  const Distance<Dual<R>> turned = distance_by(kind, feature, moved_along(c, i, own.z));
  for (int k = 0; k < 4; ++k) {
    const Vec3<Dual<R>> row = turned.w[k] * turned.n;
    out.x[k] = ((own.by_distance + b.first * toward) * at.w[k]) * at.n + derivative(row);
  }
  R phi = own.f + (b.value - x.ends.value) * toward;
  if (kind == kEdgeEdge) {
    const R under = curvature_across(-x.ends.first, x.at_ends.d);
    const auto ends = part_adjoint(x.at_ends, of_corner(x.at_ends.w, i), p, d_raw,
                                   {-(x.inside * x.e * x.ends.first), -(x.inside * x.e * x.ends.second)}, {zero, zero},
                                   {x.e * under, x.e * rate(under, -x.ends.second, x.at_ends.d)});
    const Distance<Dual<R>> beside = ends_by(end, moved_along(c, i, ends.z));
    const auto mollified = is_mollified(kind, c, a.threshold);
    Mollifier<Dual<R>> curved{};
    if (any(mollified)) curved = mollifier(moved_along(c, i, x.height() * p), a.threshold);
    const R by_e = select(R(0) < x.e, (own.f + ends.f) / x.e, R(0));
    for (int k = 0; k < 4; ++k) {
      const Vec3<Dual<R>> row = beside.w[k] * beside.n;
      out.x[k] += ((ends.by_distance - x.ends.first * toward) * x.at_ends.w[k]) * x.at_ends.n + derivative(row);
      if (any(mollified)) {
        out.x[k] += select(mollified, by_e * x.m.gradient[k] + derivative(curved.gradient[k]), zero3<R>());
      }
    }
    phi = phi + ends.f;
  }
  for (int k = 0; k < 4; ++k) out.x[k] = select(active, (-kappa) * out.x[k], zero3<R>());
  out.kappa = -select(active, phi, R(0));
  return active;
}

}  // namespace diffvbd::contact
