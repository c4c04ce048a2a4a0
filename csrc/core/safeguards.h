// The safeguards of an update: regularisation tau [kg], saturation c [m], relaxation omega [-]. Each stands with its
// derivative, because the reverse sweep differentiates what was executed, safeguards included (paper, section 4).
#pragma once

#include "vec.h"

namespace diffvbd {

template <class T>
struct StepParameters {
  T time_step;        // h [s]
  T regularization;   // tau [kg], 0 when absent
  T relaxation;       // omega [-], 1 when absent
  T saturation;       // c [m]
  T saturation_eps;   // added to |d_raw| + c
  T filter_eta;       // largest fraction of a gap that one move may close
  T last_relaxation;  // omega of the last sweep of a step
  bool saturates;     // whether c is given: asked once for a vertex, never inside its star
};

// The parameters of one sweep.
template <class T>
DIFFVBD_FN StepParameters<T> of_sweep(StepParameters<T> q, bool last) {
  if (last) q.relaxation = q.last_relaxation;
  return q;
}

// d = s d_raw with s = c / (|d_raw| + c + eps): |d| < c, and d = d_raw to first order near 0.
template <class R, class T>
DIFFVBD_FN Vec3<R> saturate(const Vec3<R>& d_raw, const StepParameters<T>& q) {
  const R r = square_root(dot(d_raw, d_raw));
  return (R(q.saturation) / (r + R(q.saturation) + R(q.saturation_eps))) * d_raw;
}

// d_bar -> d_raw_bar:  s d_bar - (d . d_bar) d / (c |d_raw|), the second term 0 at d_raw = 0.
template <class R, class T>
DIFFVBD_FN Vec3<R> saturate_vjp(const Vec3<R>& d_raw, const Vec3<R>& d_bar, const StepParameters<T>& q) {
  const R r = square_root(dot(d_raw, d_raw));
  const R s = R(q.saturation) / (r + R(q.saturation) + R(q.saturation_eps));
  const R safe = select(R(0) < r, r, R(1));
  // (d . d_bar) d / (c r) = s^2 (u . d_bar) d_raw / c with the unit vector u: no square of a huge step is formed.
  const R along = dot((R(1) / safe) * d_raw, d_bar);
  return s * d_bar - (s * s * along / R(q.saturation)) * d_raw;
}

// Trial fractions of a motion until the potential does not increase: 1, 1/2, ... 1/128; then 0. Decided, recorded
// and constant to the reverse.
constexpr int kFractions = 8;
constexpr double kRounding = 8;  // ulps of the terms that a sum of them may lose
DIFFVBD_FN constexpr double fraction_of(int trial) { return 1.0 / (1 << trial); }

// Step filter against a plane: the largest alpha <= 1 that closes at most eta of the gap d > 0 when the move changes
// the gap by `change`.
template <class R, class T>
DIFFVBD_FN R filter_fraction(const R& gap, const R& change, const StepParameters<T>& q) {
  const R most = R(q.filter_eta) * gap;
  if (!any(most < -change)) return R(1);  // nearly always; a division is slow
  const auto closing = change < R(0);
  const R alpha = most / select(closing, -change, R(1));
  return select(closing, select(alpha < R(1), alpha, R(1)), R(1));
}

}  // namespace diffvbd
