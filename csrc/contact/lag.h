// What friction and damping of a step take from its start: normal force, normal and weights of a pair, and the adjoint.
#pragma once

#include "../core/views.h"
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

// What share of its damping a pair has by its normal force (diffvbd/energies.py, damped_share), and its derivatives.
template <class T>
struct DampedShare {
  T value = T(0), by_force = T(0), by_kappa = T(0);
  DIFFVBD_FN DampedShare(T force, T kappa, T dhat) {
    const T half = T(fade()) * dhat, whole = force + half * kappa;
    if (!(T(0) < whole)) return;  // without a barrier there is no damping
    value = force / whole;        // squares of `whole` would vanish in single precision
    by_force = half * kappa / whole / whole, by_kappa = -value * (half / whole);
  }
};

// Coefficients of friction and damping of each scene; null without.
template <class T>
struct LagCoefficients {
  Batched<const T> friction, damping;  // [B]
  DIFFVBD_FN T friction_of(int64_t scene) const { return friction.data ? friction.data[scene * friction.scene] : T(0); }
  DIFFVBD_FN T damping_of(int64_t scene) const { return damping.data ? damping.data[scene * damping.scene] : T(0); }
};

// What Lag reads of a pair: friction and damping by their coefficients, its normal and weights.
template <class T>
DIFFVBD_FN void store_rubbing(const LagState<T>& a, T friction, T damping, T kappa, T dhat, T* to) {
  const LagState<T> rubs{
      friction * a.force, damping * DampedShare<T>(a.force, kappa, dhat).value, a.n, {a.w[0], a.w[1], a.w[2], a.w[3]}};
  store_lag(rubs, to);
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

// By what a pair's scene has as coefficients, too.
template <class T>
struct RubbingAdjoint {
  PairAdjoint<T> pair;
  T friction = T(0), damping = T(0);
};

// bar: adjoint of what store_rubbing() wrote. push: of the pair's force on each corner.
template <class T>
DIFFVBD_FN void reverse_rubbing(int kind, const Corners<T>& c, const PairConstants<T>& a, T kappa, T friction,
                                T damping, const T* bar, const Vec3<T> (&push)[4], RubbingAdjoint<T>& out) {
  const LagState<T> now = lag_state(kind, c, a, kappa);
  const DampedShare<T> share(now.force, kappa, a.dhat);
  T own[kLagScalars] = {friction * bar[0] + damping * bar[1] * share.by_force, T(0)};
  for (int i = 2; i < kLagScalars; ++i) own[i] = bar[i];
  for (int k = 0; k < 4; ++k) {
    const T along = dot(now.n, push[k]);
    const Vec3<T> by_n = now.force * now.w[k] * push[k];
    own[0] += now.w[k] * along, own[5 + k] += now.force * along;
    own[2] += by_n.x, own[3] += by_n.y, own[4] += by_n.z;
  }
  reverse_lag(kind, c, a, kappa, own, out.pair);
  if (!(now.active > T(0))) return;
  out.pair.kappa += damping * bar[1] * share.by_kappa;
  out.friction = bar[0] * now.force, out.damping = bar[1] * share.value;
}

// Those adjoints of all pairs; null where there are none.
template <class T>
struct RubbingBars {
  const T *lag, *push;  // [pairs, 9], [B, corners, 3]
  int64_t corners;
  DIFFVBD_FN void reverse(const LagCoefficients<T>& by, int64_t pair, const int32_t* record, const Corners<T>& c,
                          const PairConstants<T>& a, T kappa, RubbingAdjoint<T>& out) const {
    const int64_t scene = record[5];
    T bar[kLagScalars] = {};
    Vec3<T> push_bar[4] = {};
    for (int i = 0; i < kLagScalars && lag; ++i) bar[i] = lag[kLagScalars * pair + i];
    for (int k = 0; k < 4 && push; ++k) {
      const T* own = push + 3 * (scene * corners + record[k]);
      push_bar[k] = {own[0], own[1], own[2]};
    }
    reverse_rubbing(record[4], c, a, kappa, by.friction_of(scene), by.damping_of(scene), bar, push_bar, out);
  }
};

}  // namespace diffvbd::contact
