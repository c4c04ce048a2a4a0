// The barrier of a pair in the block of one of its corners, and the exact adjoint (docs/method.md, section 12): the
// gradient of e b(gap), and of its Hessian e b'' grad_gap grad_gap^T and, where e < 0, a bound of e b' Hess gap, which
// is positive there. `together`: the number of corners that move at once, this one included; the block takes so many
// times the stiffness, so that together they do not overshoot.
#pragma once

#include "../energies/log_barrier.h"
#include "geometry.h"

namespace diffvbd::contact {

// The item of corner i; in a pack of lanes each has an i of its own.
template <class A>
DIFFVBD_FN const A& of_corner(const A (&a)[4], int i) {
  return a[i];
}
DIFFVBD_FN bool is_corner(int i, int k) { return i == k; }

// Hess d <= w w^T (I - n n^T) / d bounds the curvature across n where a pair counts negative.
template <class R>
DIFFVBD_FN R curvature_across(const R& e, const R& first, const R& d) {
  return select(e < R(0), e * first / d, R(0));
}

// Adds the barrier's part of the block of corner i of a pair whose distance is `at`; returns whether it is active.
template <class R, class Index>
DIFFVBD_FN auto add_barrier(int kind, const Corners<R>& c, const Distance<R>& at, const Index& i, const R& together,
                            const PairConstants<R>& a, const R& kappa, const R& h2, Vec3<R>& g, Sym3<R>& H) {
  const R gap = at.d - a.offset;
  const auto active = both(gap < a.dhat, is_weighted<R>(kind, a));
  if (!any(active)) return active;
  const LogBarrier<R> b(gap, a.dhat, h2 * kappa);
  const auto varied = both(active, varies(kind, c, at, a));
  const Weight<R> e = weight_of(kind, c, a, varied);
  const R w = of_corner(at.w, i), across = curvature_across(e.e, b.first, at.d);
  const R own = select(active, e.e, R(0));
  g += (own * b.first * w) * at.n;
  if (any(varied)) g += b.value * of_corner(e.gradient, i);
  add_diagonal(H, together * across * w * w);
  add_outer(H, together * (own * b.second - across) * w * w, at.n);
  return active;
}

// Adjoint of phi = p . (g + H d_raw) of corner i, negated: what the corners and kappa receive. H is linear in
// `together`, so it multiplies d_raw.
template <class T>
struct PairAdjoint {
  Vec3<T> x[4];
  T kappa;
};

// The Hessians of gap and weight are needed only times vectors that sit at corner i: one Dual evaluation each.
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
  int feature = kInside;
  const Distance<R> at = distance(kind, c, &feature);
  const R gap = at.d - a.offset;
  const auto active = both(gap < a.dhat, is_weighted<R>(kind, a));
  if (!any(active)) return active;
  const LogBarrier<R> b(gap, a.dhat, h2);  // kappa scales everything: it comes last
  const auto varied = both(active, varies(kind, c, at, a));
  const Weight<R> weight = weight_of(kind, c, a, varied);
  const R e = weight.e, w = of_corner(at.w, i), s = w * dot(at.n, p), t = w * dot(at.n, d_raw), pd = dot(p, d_raw);
  const R by_e = b.first * s + b.second * s * t;
  const R across = curvature_across(e, b.first, at.d), stiff = w * w * pd - s * t;
  R phi = e * by_e + across * stiff;
  R by_gap = e * (b.second * s + b.third * s * t) + (curvature_across(e, b.second, at.d) - across / at.d) * stiff;
  // the Hessian of d times n at corner i is the gradient of w_i
  const Vec3<R> z = (e * (b.first + b.second * t) - across * t) * p + ((e * b.second - across) * s) * d_raw +
                    (R(2) * across * w * pd) * at.n;
  if (any(varied)) {
    const R toward = dot(of_corner(weight.gradient, i), p);
    phi = phi + b.value * toward;
    by_gap = by_gap + b.first * toward;
  }
  const Distance<Dual<R>> turned = distance_by(kind, feature, moved_along(c, i, z));
  for (int k = 0; k < 4; ++k) {
    const Vec3<Dual<R>> row = turned.w[k] * turned.n;
    out.x[k] = (-kappa) * ((by_gap * at.w[k]) * at.n + derivative(row));
  }
  if (any(varied)) {
    const Weight<Dual<R>> curved = weight_of_edges(moved_along(c, i, b.value * p), a);
    for (int k = 0; k < 4; ++k) {
      const Vec3<R> own = kappa * (by_e * weight.gradient[k] + derivative(curved.gradient[k]));
      out.x[k] -= select(varied, own, zero3<R>());
    }
  }
  out.kappa = -phi;
  return active;
}

}  // namespace diffvbd::contact
