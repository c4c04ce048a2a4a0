// Extrapolation of a free body, and its adjoint. On straight lines x + h v a body that turns grows by its angle
// squared, and few sweeps do not undo that. The turn is therefore taken out of the displacements:
//     displacement_i = mean + e_i,    e_i = (r_i - Q (r_i - c (d_i - mean))) / c,    Q = polar(sum m r (r - c (d -
//     mean))^T)
// with d = h v, r from the center of mass, and c the lookback ratio: the state x - c d is taken as an earlier one. c =
// 1 fits the velocities of implicit Euler, chords of the turn: a body that only turns keeps its shape to rounding
// (docs/method.md, section 14). Initial velocities w x r are tangents, c = 0; a body that takes implicit Euler in a
// step of another scheme has c = 1. Displacements that fit one of these better than `lookback` use that.
// A View is a body: size(), mass(i), position(i) and displacement(i) of its i-th vertex.
#pragma once

#include "../core/rotation.h"

namespace diffvbd::rigid {

// Sums of vectors and of products a b^T, by rows.
DIFFVBD_FN void add_outer(double* to, const Vector& a, const Vector& b) {
  add_to(to, a.x * b), add_to(to + 3, a.y * b), add_to(to + 6, a.z * b);
}
DIFFVBD_FN Matrix rows_of(const double* sum) {
  return {{sum[0], sum[1], sum[2]}, {sum[3], sum[4], sum[5]}, {sum[6], sum[7], sum[8]}};
}

struct Extrapolation {
  double mass, lookback;
  Vector center, mean;
  Matrix b, turned;  // sum m r (r - c d)^T, and Q - 1
  bool turns;        // false: b has no rotation; displacements are unchanged

  // unchanged displacements
  DIFFVBD_FN void keep() { turned = 0.0 * identity(), turns = false; }

  template <class View>
  DIFFVBD_FN Vector arm(const View& view, int32_t i) const {
    return view.position(i) - center;
  }
  // c (d - mean)
  template <class View>
  DIFFVBD_FN Vector back(const View& view, int32_t i) const {
    return lookback * (view.displacement(i) - mean);
  }
  // the part of a turn in a displacement: exactly zero where a body does not turn
  template <class View>
  DIFFVBD_FN Vector turning(const View& view, int32_t i) const {
    return 1 / lookback * (turned * (arm(view, i) - back(view, i)));
  }
  template <class View>
  DIFFVBD_FN Vector displacement(const View& view, int32_t i) const {
    return view.displacement(i) - turning(view, i);
  }
};

// turned: polar(b) - 1, or zero where that is rounding. False, and zero, where b has no rotation, or one of more than
// kMostTurn in a step, which the correction might not find.
DIFFVBD_FN bool turn_of(const Matrix& b, double lookback, Matrix& turned) {
  constexpr double kNone = 1e-30, kMostTurn = 0.7;  // squared; [rad]
  Matrix turn = identity();
  bool turns = polar_rotation(b, turn);
  turned = turn + -1.0 * identity();
  const double square = inner(turned, turned);  // twice that of a small angle
  turns = turns && square < 2 * kMostTurn * kMostTurn * lookback * lookback;
  if (!turns || square < kNone) turned = 0.0 * identity();
  return turns;
}

// For a lookback ratio: sum m r^2, sum m |d - mean|^2 and sum m e^2.
struct Squares {
  double size, beside, left;
};
template <class View, class Team>
DIFFVBD_FN Squares with_lookback(const View& view, const Team& team, double lookback, Extrapolation& out) {
  const Vector about = view.position(0);  // squares of distances inside the body
  double sum[18];
  team.template sum<18>(view.size(), sum, [&](int32_t i, double* to) {
    const double m = view.mass(i);
    const Vector displacement = view.displacement(i), at = view.position(i) - about, x = m * at,
                 before = at - lookback * displacement;
    to[0] += m, to[1] += dot(x, at), to[2] += m * dot(displacement, displacement);
    add_to(to + 3, x), add_to(to + 6, m * displacement), add_outer(to + 9, x, before);
  });
  out = {}, out.mass = sum[0], out.lookback = lookback;
  if (!(sum[0] > 0)) return {};
  const Vector at = 1 / sum[0] * vector_at(sum + 3), mean = 1 / sum[0] * vector_at(sum + 6);
  out.mean = mean, out.center = about + at;
  out.b = rows_of(sum + 9) + (-sum[0]) * outer(at, at - lookback * mean);
  out.turns = turn_of(out.b, lookback, out.turned);
  const double beside = sum[2] - sum[0] * dot(mean, mean);
  return {sum[1] - sum[0] * dot(at, at), beside, beside - 2 / (lookback * lookback) * inner(out.turned, out.b)};
}

template <class View, class Team>
DIFFVBD_FN Extrapolation extrapolation_of(const View& view, const Team& team, double lookback) {
  constexpr double kLookback = 1, kTangent = 0.01,  // 0 would measure no turn
      kAfterTangents = -0.74,                       // of BDF2, after a step of SDIRK2 from tangents
      kFits = 0.25,                                 // of the squares that `lookback` leaves: bound of a better fit
      kTurns = 0.15,                                // of all squares: what a wrong ratio may leave of a pure turn
      kStretch = 1e-8;                              // squared stretch of a step below which all ratios are the same
  Extrapolation out{};
  if (view.size() == 0) return out;
  double left = 0;
  const double others[] = {lookback, kTangent, kLookback, lookback < 0 ? kAfterTangents : lookback, lookback};
  for (int k = 0; k < 5; ++k) {  // a loop: one copy of the code saves registers
    const Squares of = with_lookback(view, team, others[k], out);
    const bool fits = out.turns && of.left < kFits * left;
    if (k > 0 && fits) break;
    if (k > 0) continue;
    left = of.left;
    if (!(out.turns && left > kStretch * of.size && left < kTurns * of.beside)) break;
  }
  return out;
}

// Calls write(i, x_bar, displacement_bar, mass_bar) for each vertex; mean_bar and bend_bar(i) are the adjoints of the
// mean and of e_i.
template <class View, class Team, class BendBar, class Write>
DIFFVBD_FN void reverse_extrapolation(const View& view, const Team& team, const Extrapolation& c,
                                      const Vector& mean_bar, const BendBar& bend_bar, const Write& write) {
  double sum[12];
  team.template sum<12>(view.size(), sum, [&](int32_t i, double* to) {
    const Vector bar = bend_bar(i), before = c.arm(view, i) - c.back(view, i);
    add_to(to, bar), add_outer(to + 3, bar, before);
  });
  const Vector total{sum[0], sum[1], sum[2]};
  const double per_mass = c.mass > 0 ? 1 / c.mass : 0;
  Matrix b_bar = 0.0 * identity();
  Vector common{};  // adjoint of the center of mass times the ratio: r appears in Q r alone
  if (c.turns) {
    const Matrix turn_bar = (-1 / c.lookback) * rows_of(sum + 3);
    b_bar = polar_vjp(c.b, c.turned + identity(), turn_bar);
    common = transposed_times(c.turned, total);
  }
  const Vector to_mean = mean_bar - total - common, to_center = 1 / c.lookback * common;
  team.each(view.size(), [&](int32_t i) {
    const double m = view.mass(i);
    const Vector bar = bend_bar(i), arm = c.arm(view, i), d = c.back(view, i), before = arm - d;
    const Vector turned = c.turns ? transposed_times(c.turned, bar) : Vector{}, pulled = b_bar * before,
                 pushed = transposed_times(b_bar, arm);
    const Vector x_bar = (-1 / c.lookback) * turned + m * (pulled + pushed) + m * per_mass * to_center;
    const Vector displacement_bar = bar + turned - c.lookback * m * pushed + m * per_mass * to_mean;
    write(i, x_bar, displacement_bar,
          dot(arm, pulled) + per_mass * (1 / c.lookback * dot(d, to_mean) + dot(arm, to_center)));
  });
}

}  // namespace diffvbd::rigid
