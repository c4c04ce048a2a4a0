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
  T dhat, offset, threshold;  // [m], radii that the gap is less than the distance [m], of the mollifier [m^4]
  DIFFVBD_FN explicit PairConstants(const T* a) : dhat(a[0]), offset(a[1]), threshold(a[2]) {}
  DIFFVBD_FN PairConstants(const T& dhat, const T& offset, const T& threshold)
      : dhat(dhat), offset(offset), threshold(threshold) {}
};

// The item of corner i; in a pack of lanes each has an i of its own.
template <class A>
DIFFVBD_FN const A& of_corner(const A (&a)[4], int i) {
  return a[i];
}
DIFFVBD_FN bool is_corner(int i, int k) { return i == k; }

// Adds the barrier's part of the block of corner i of a pair whose distance is `at`; returns whether it is active.
template <class R, class Index>
DIFFVBD_FN auto add_barrier(int kind, const Corners<R>& c, const Distance<R>& at, const Index& i, const R& together,
                            const PairConstants<R>& a, const R& kappa, const R& h2, Vec3<R>& g, Sym3<R>& H) {
  const R gap = at.d - a.offset;
  const auto active = gap < a.dhat;
  if (!any(active)) return active;
  const LogBarrier<R> b(gap, a.dhat, h2 * kappa);
  R e = R(1);
  Vec3<R> own = zero3<R>();
  const auto mollified = is_mollified(kind, c, a.threshold);
  if (any(mollified)) {
    const Mollifier<R> m = mollifier(c, a.threshold);
    e = select(mollified, m.e, e);
    own = select(mollified, b.value * of_corner(m.gradient, i), own);
  }
  const R w = of_corner(at.w, i);
  g += own + (e * b.first * w) * at.n;
  add_outer(H, together * e * b.second * w * w, at.n);
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
  int feature = kInside;
  const Distance<R> at = distance(kind, c, &feature);
  const R gap = at.d - a.offset;
  const auto active = gap < a.dhat;
  if (!any(active)) return active;
  const LogBarrier<R> b(gap, a.dhat, h2);  // kappa scales everything: it comes last
  const R w = of_corner(at.w, i), s = w * dot(at.n, p), t = w * dot(at.n, d_raw);
  R e = R(1), phi = R(0), by_gap = R(0);
  const auto mollified = is_mollified(kind, c, a.threshold);
  Mollifier<R> m{};
  if (any(mollified)) {
    m = mollifier(c, a.threshold);
    e = select(mollified, m.e, e);
    const R toward = dot(of_corner(m.gradient, i), p);
    phi = select(mollified, b.value * toward, phi);
    by_gap = select(mollified, b.first * toward, by_gap);
  }
  const R by_e = b.first * s + b.second * s * t;
  phi = phi + e * by_e;
  by_gap = by_gap + e * (b.second * s + b.third * s * t);
  const Vec3<R> z = (e * (b.first + b.second * t)) * p + (e * b.second * s) * d_raw;
  const Distance<Dual<R>> turned = distance_by(kind, feature, moved_along(c, i, z));
  for (int k = 0; k < 4; ++k) {
    const Vec3<Dual<R>> row = turned.w[k] * turned.n;
    out.x[k] = (-kappa) * ((by_gap * at.w[k]) * at.n + derivative(row));
  }
  if (any(mollified)) {
    const Mollifier<Dual<R>> curved = mollifier(moved_along(c, i, b.value * p), a.threshold);
    for (int k = 0; k < 4; ++k) {
      const Vec3<R> own = kappa * (by_e * m.gradient[k] + derivative(curved.gradient[k]));
      out.x[k] -= select(mollified, own, zero3<R>());
    }
  }
  out.kappa = -phi;
  return active;
}

}  // namespace diffvbd::contact
