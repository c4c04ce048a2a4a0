// The barrier of a pair in the block of one of its corners, and the exact adjoint (docs/method.md, section 12): the
// gradient F of E = e b(gap), and a matrix for the positive part of its Hessian. `together`: the number of corners that
// move at once, this one included; the block takes so many times the stiffness, so that together they do not overshoot.
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

// The matrix of corner i. Of two edges F F^T / E, which holds the mixed terms of the Hessian exactly, and what
// c w_i^2 n n^T with c = e b'' has more than that: b'^2 <= 1.5 b b''. Of a point and a face the latter alone, with c
// whole; where it counts negative, a bound of e b' Hess d as well, by Hess d <= w w^T (I - n n^T) / d.
template <class R>
struct PairStiffness {
  R e, inverse, along, along_rate, across, across_rate;  // inverse: 1 / E or 0; rates: by the gap, along's over e
  DIFFVBD_FN PairStiffness(int kind, const R& weight, const LogBarrier<R>& b, const R& d)
      : e(weight), inverse(R(0)), along(b.second), along_rate(b.third), across(R(0)), across_rate(R(0)) {
    if (kind == kEdgeEdge) {
      const auto pushes = R(std::numeric_limits<float>::min()) < e * b.value;  // has an inverse in any precision
      inverse = select(pushes, R(1) / (e * b.value), R(0));
      const R ratio = select(pushes, b.first / b.value, R(0)), part = R(2.0 / 3) * ratio;
      along = along - part * b.first;
      along_rate = along_rate - part * (R(2) * b.second - ratio * b.first);
    } else {
      const auto negative = e < R(0);
      across = select(negative, e * b.first / d, R(0));
      across_rate = select(negative, e * b.second / d, R(0)) - across / d;
    }
  }
};

// Adds the barrier's part of the block of corner i of a pair whose distance is `at`; returns whether it is active.
template <class R, class Index>
DIFFVBD_FN auto add_barrier(int kind, const Corners<R>& c, const Distance<R>& at, const Index& i, const R& together,
                            const PairConstants<R>& a, const R& kappa, const R& h2, Vec3<R>& g, Sym3<R>& H) {
  const R gap = at.d - a.offset;
  const auto active = gap < a.dhat;
  if (!any(active)) return active;
  const LogBarrier<R> b(gap, a.dhat, h2 * kappa);
  const auto varied = both(active, varies(kind, c, at, a));
  const Weight<R> e = weight_of(kind, c, a, varied);
  const PairStiffness<R> matrix(kind, e.e, b, at.d);
  const R w = of_corner(at.w, i);
  Vec3<R> force = (e.e * b.first * w) * at.n;
  if (any(varied)) force += b.value * of_corner(e.gradient, i);
  g += force;
  add_outer(H, together * matrix.inverse, force);
  add_diagonal(H, together * matrix.across * w * w);
  add_outer(H, together * (matrix.e * matrix.along - matrix.across) * w * w, at.n);
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
  const auto active = gap < a.dhat;
  if (!any(active)) return active;
  const LogBarrier<R> b(gap, a.dhat, h2);  // kappa scales everything: it comes last
  const auto varied = both(active, varies(kind, c, at, a));
  const Weight<R> weight = weight_of(kind, c, a, varied);
  const PairStiffness<R> matrix(kind, weight.e, b, at.d);
  const R e = weight.e, w = of_corner(at.w, i), s = w * dot(at.n, p), t = w * dot(at.n, d_raw), pd = dot(p, d_raw);
  const Vec3<R> own = of_corner(weight.gradient, i), force = (e * b.first * w) * at.n + b.value * own;
  // the Hessian of E times z at corner i is the gradient of p . F + (p . F) (F . d_raw) / E at fixed E
  const R pushed = dot(force, p), pushes = matrix.inverse * dot(force, d_raw), sideways = w * w * pd - s * t;
  const Vec3<R> z = (R(1) + pushes) * p + (matrix.inverse * pushed) * d_raw;
  const R normal = w * dot(at.n, z), by_value = -matrix.inverse * pushed * pushes;
  const R by_e = b.first * normal + matrix.along * s * t + b.value * by_value;
  const R by_gap = e * (b.second * normal + matrix.along_rate * s * t + b.first * by_value) +
                   matrix.across_rate * sideways + b.first * dot(own, z);
  const R phi = pushed * (R(1) + pushes) + e * matrix.along * s * t + matrix.across * sideways;
  // the Hessian of d times n at corner i is the gradient of w_i
  const Vec3<R> by_turn = (e * b.first) * z + (e * matrix.along - matrix.across) * (t * p + s * d_raw) +
                          (R(2) * matrix.across * w * pd) * at.n;
  const Distance<Dual<R>> turned = distance_by(kind, feature, moved_along(c, i, by_turn));
  for (int k = 0; k < 4; ++k) {
    const Vec3<Dual<R>> row = turned.w[k] * turned.n;
    out.x[k] = (-kappa) * ((by_gap * at.w[k]) * at.n + derivative(row));
  }
  if (any(varied)) {
    const Weight<Dual<R>> curved = weight_of_edges(moved_along(c, i, b.value * z), a);
    for (int k = 0; k < 4; ++k) {
      const Vec3<R> part = kappa * (by_e * weight.gradient[k] + derivative(curved.gradient[k]));
      out.x[k] -= select(varied, part, zero3<R>());
    }
  }
  out.kappa = -phi;
  return active;
}

}  // namespace diffvbd::contact
