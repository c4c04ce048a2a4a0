// Lagged friction and damping of pairs, about the normal, the weights and the normal force at the start of the step:
// their part of the block of a corner, what they take from that start, and the adjoints (docs/method.md, section 12).
#pragma once

#include "../core/views.h"
#include "pairs.h"

namespace diffvbd::contact {

// A pair as it was at the start of the step, in the order in which tensors keep it.
constexpr int kLagScalars = 9;
template <class T>
struct Lag {
  T friction;  // coefficient times normal force [N]
  T damping;   // [N s/m], 0 where the pair was not active
  Vec3<T> n;
  T w[4];
  Lag() = default;
  DIFFVBD_FN explicit Lag(const T* a) : friction(a[0]), damping(a[1]), n{a[2], a[3], a[4]}, w{a[5], a[6], a[7], a[8]} {}
  DIFFVBD_FN bool active() const { return friction != T(0) || damping != T(0); }
};

// f1(|u|) / |u| of the friction potential of Li et al. (2020), smooth below eps [m], and its derivative over |u|
constexpr double kRestingMotion = 1e-6;  // of eps
template <class T>
struct FrictionRate {
  T value, curvature;
  DIFFVBD_FN FrictionRate(T length, T eps) {
    const bool sticks = length < eps;
    value = sticks ? (T(2) - length / eps) / eps : T(1) / length;
    const T slope = sticks ? -T(1) / (eps * eps) : -value * value;
    // At rest value has a kink; below what rounding makes of zero its slope is taken as that of both sides together.
    const double resting = kRestingMotion;  // a device has no namespace's constant that a Dual could refer to
    curvature = T(resting) * eps < length ? slope / length : T(0);
  }
};

// Adds the lagged part of the block of corner i; m [m] is the relative motion since the start of the step.
template <class T>
DIFFVBD_FN void add_lagged(const Lag<T>& a, int i, T together, const Vec3<T>& m, T h, T eps, Vec3<T>& g, Sym3<T>& H) {
  const T w = a.w[i], along = dot(a.n, m);
  if (a.damping != T(0)) {
    // the block damps both directions, the force approach alone: a vertex at rest must not depend on the sign of a
    // rounding
    const T c = h * a.damping * w;
    if (along < T(0)) g += (c * along) * a.n;
    add_outer(H, together * c * w, a.n);
  }
  if (a.friction != T(0)) {
    const Vec3<T> u = m - along * a.n;
    const FrictionRate<T> f(square_root(dot(u, u)), eps);
    const T size = h * h * a.friction * f.value * w;
    g += size * u;
    add_diagonal(H, size * w);
    add_outer(H, -size * w, a.n);
  }
}

// Adjoint of phi = p . (g + H d_raw) of corner i, negated: toward m, and toward the lag at fixed m (a.w[k] also moves
// m).
template <class T>
DIFFVBD_FN Vec3<T> reverse_lagged(const Lag<T>& a, int i, T together, const Vec3<T>& m, T h, T eps, const Vec3<T>& p,
                                  const Vec3<T>& d_raw, Lag<T>& bar) {
  const T w = a.w[i], along = dot(a.n, m), n_p = dot(a.n, p), n_d = dot(a.n, d_raw), stiff = together * w * n_d;
  Vec3<T> m_bar = zero3<T>();
  bar.n = zero3<T>();
  for (int k = 0; k < 4; ++k) bar.w[k] = T(0);
  if (!a.active()) {  // only its two coefficients have adjoints; most floors are untouched
    const Vec3<T> u = m - along * a.n;
    const FrictionRate<T> f(square_root(dot(u, u)), eps);
    bar.friction = -h * h * w * f.value * (dot(u, p) + w * dot(p - n_p * a.n, d_raw));
    bar.damping = -h * w * ((along < T(0) ? along : T(0)) + stiff) * n_p;
    return m_bar;
  }
  const Vec3<T> crossed = n_d * p + n_p * d_raw;
  const T c = h * a.damping, approach = along < T(0) ? along : T(0);
  bar.n -= (together * c * w * w) * crossed;
  if (along < T(0)) {
    m_bar -= (c * w * n_p) * a.n;
    bar.n -= (c * w) * (n_p * m + along * p);
  }
  bar.w[i] = bar.w[i] - c * (approach + T(2) * stiff) * n_p;
  bar.damping = -h * w * (approach + stiff) * n_p;
  const Vec3<T> u = m - along * a.n, p_t = p - n_p * a.n;
  const FrictionRate<T> f(square_root(dot(u, u)), eps);
  const T size = h * h * a.friction * w, motions = dot(u, p), pushed = dot(p_t, d_raw), both = motions + w * pushed;
  m_bar -= size * ((both * f.curvature) * u + f.value * p_t);
  bar.n += size * ((both * f.curvature * along) * u + f.value * (along * p + n_p * m + w * crossed));
  bar.w[i] = bar.w[i] - h * h * a.friction * f.value * (motions + T(2) * w * pushed);
  bar.friction = -h * h * w * f.value * both;
  return m_bar;
}

template <class R>
struct LagState {
  R force;   // normal force of the barrier, negative where the pair counts so [N]
  R active;  // 1 where the pair is closer than dhat, else 0
  Vec3<R> n;
  R w[4];
};

// at: the distance of the pair
template <class R, class T>
DIFFVBD_FN LagState<R> lag_state(int kind, const Corners<R>& c, const Distance<R>& at, const PairConstants<T>& a,
                                 const R& kappa) {
  const R gap = at.d - R(a.offset);
  const LogBarrier<R> b(gap, R(a.dhat), kappa);
  const R e = weight_of(kind, c, a, varies(kind, c, at, a)).e;
  return {-e * b.first, select(gap < R(a.dhat), R(1), R(0)), at.n, {at.w[0], at.w[1], at.w[2], at.w[3]}};
}

template <class R, class T>
DIFFVBD_FN LagState<R> lag_state(int kind, const Corners<R>& c, const PairConstants<T>& a, const R& kappa) {
  return lag_state(kind, c, distance(kind, c), a, kappa);
}

template <class T>
DIFFVBD_FN void store_lag(const LagState<T>& a, T* to) {
  const T values[kLagScalars] = {a.force, a.active, a.n.x, a.n.y, a.n.z, a.w[0], a.w[1], a.w[2], a.w[3]};
  for (int i = 0; i < kLagScalars; ++i) to[i] = values[i];
}

// bar: adjoint of what store_lag wrote. Twelve Dual evaluations, once a step.
template <class T>
DIFFVBD_FN void reverse_lag(int kind, const Corners<T>& c, const PairConstants<T>& a, T kappa, const T* bar,
                            PairAdjoint<T>& out) {
  bool any_bar = false;
  for (int i = 0; i < kLagScalars; ++i) any_bar = any_bar || bar[i] != T(0);
  int feature = kInside;
  const LagState<T> now = lag_state(kind, c, distance(kind, c, &feature), a, T(1));
  for (int k = 0; k < 4; ++k) out.x[k] = zero3<T>();
  out.kappa = any_bar && now.active > T(0) ? bar[0] * now.force : T(0);
  if (!any_bar || !(now.active > T(0))) return;
  for (int k = 0; k < 4; ++k) {
    T* to[3] = {&out.x[k].x, &out.x[k].y, &out.x[k].z};
    for (int i = 0; i < 3; ++i) {
      const Vec3<T> z = {T(i == 0), T(i == 1), T(i == 2)};
      const Corners<Dual<T>> moved = moved_along(c, k, z);
      const LagState<Dual<T>> turned = lag_state(kind, moved, distance_by(kind, feature, moved), a, Dual<T>(kappa));
      T sum = bar[0] * turned.force.derivative + dot(Vec3<T>{bar[2], bar[3], bar[4]}, derivative(turned.n));
      for (int j = 0; j < 4; ++j) sum = sum + bar[5 + j] * turned.w[j].derivative;
      *to[i] = sum;
    }
  }
}

}  // namespace diffvbd::contact
