// What friction and damping of a step take from its start: normal force, normal and weights of a pair, and the adjoint.
#pragma once

#include "pairs.h"

namespace diffvbd::contact {

template <class R>
struct LagState {
  R force;   // normal force of the barrier [N]
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
  LagState<R> out{-b.first, select(gap < R(a.dhat), R(1), R(0)), at.n, {at.w[0], at.w[1], at.w[2], at.w[3]}};
  if (is_mollified(kind, c, a.threshold)) out.force = mollifier(c, a.threshold).e * out.force;
  return out;
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
