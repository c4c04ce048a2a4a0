// Where a free body coasts to. On straight lines x + h v a body that turns grows by its angle squared, and few sweeps
// leave it so. What of its ways is a turn is therefore taken off, and the shape goes on by the rest alone:
//     way_i = mean + e_i,    e_i = (r_i - Q (r_i - c (d_i - mean))) / c,    Q = polar(sum m r (r - c (d - mean))^T)
// with d the ways h v, r from the center of mass, and c the chord: how far back along its way a vertex is taken to have
// been. With c = 1 that is the state before an implicit Euler step, whose velocities are chords of the turn: a body
// that only turns keeps its shape to rounding (docs/method.md, section 14). Velocities that a scene begins with are
// rather those of a rigid body, w x r, tangents of its turn, where c is 0; those of a body that takes implicit Euler in
// a step of another scheme have c = 1. Ways that fit one of these better than `chord` have that. With the adjoint.
//
// A View is a body: size(), mass(i), position(i) and way(i) of its i-th vertex.
#pragma once

#include "../core/rotation.h"

namespace diffvbd::rigid {

// Sums of vectors and of products a b^T, by rows.
DIFFVBD_FN void add(double* to, const Vector& a) { to[0] += a.x, to[1] += a.y, to[2] += a.z; }
DIFFVBD_FN void add_outer(double* to, const Vector& a, const Vector& b) {
  add(to, a.x * b), add(to + 3, a.y * b), add(to + 6, a.z * b);
}
DIFFVBD_FN Matrix rows_of(const double* sum) {
  return {{sum[0], sum[1], sum[2]}, {sum[3], sum[4], sum[5]}, {sum[6], sum[7], sum[8]}};
}

struct Coasting {
  double mass, chord;
  Vector center, mean;
  Matrix b, turned;  // sum m r (r - c d)^T, and Q - 1
  bool turns;        // false: b has no rotation; ways are as they were

  // ways as they were
  DIFFVBD_FN void keep() { turned = 0.0 * identity(), turns = false; }

  template <class View>
  DIFFVBD_FN Vector arm(const View& view, int32_t i) const {
    return view.position(i) - center;
  }
  // c (d - mean)
  template <class View>
  DIFFVBD_FN Vector back(const View& view, int32_t i) const {
    return chord * (view.way(i) - mean);
  }
  // what a turn has of a way: none to the bit where a body does not turn
  template <class View>
  DIFFVBD_FN Vector turning(const View& view, int32_t i) const {
    return 1 / chord * (turned * (arm(view, i) - back(view, i)));
  }
  template <class View>
  DIFFVBD_FN Vector way(const View& view, int32_t i) const {
    return view.way(i) - turning(view, i);
  }
};

// turned: polar(b) - 1, or zero where that is rounding. False, and zero, where b has no rotation, or one over a share
// `chord` of a step that comes to more than kMostTurn in the step: the correction might not find it.
DIFFVBD_FN bool turn_of(const Matrix& b, double chord, Matrix& turned) {
  constexpr double kNone = 1e-30, kMostTurn = 0.7;  // squared; [rad]
  Matrix turn = identity();
  bool turns = polar_rotation(b, turn);
  turned = turn + -1.0 * identity();
  const double square = inner(turned, turned);  // twice that of a small angle
  turns = turns && square < 2 * kMostTurn * kMostTurn * chord * chord;
  if (!turns || square < kNone) turned = 0.0 * identity();
  return turns;
}

// Of a chord: sum m r^2, sum m |d - mean|^2 and sum m e^2.
struct Squares {
  double size, beside, left;
};
template <class View, class Team>
DIFFVBD_FN Squares take_chord(const View& view, const Team& team, double chord, Coasting& out) {
  const Vector about = view.position(0);  // squares of distances inside the body
  double sum[18];
  team.template sum<18>(view.size(), sum, [&](int32_t i, double* to) {
    const double m = view.mass(i);
    const Vector way = view.way(i), at = view.position(i) - about, x = m * at, before = at - chord * way;
    to[0] += m, to[1] += dot(x, at), to[2] += m * dot(way, way);
    add(to + 3, x), add(to + 6, m * way), add_outer(to + 9, x, before);
  });
  out = {}, out.mass = sum[0], out.chord = chord;
  if (!(sum[0] > 0)) return {};
  const Vector at = 1 / sum[0] * Vector{sum[3], sum[4], sum[5]}, mean = 1 / sum[0] * Vector{sum[6], sum[7], sum[8]};
  out.mean = mean, out.center = about + at;
  out.b = rows_of(sum + 9) + (-sum[0]) * outer(at, at - chord * mean);
  out.turns = turn_of(out.b, chord, out.turned);
  const double beside = sum[2] - sum[0] * dot(mean, mean);
  return {sum[1] - sum[0] * dot(at, at), beside, beside - 2 / (chord * chord) * inner(out.turned, out.b)};
}

template <class View, class Team>
DIFFVBD_FN Coasting coasting_of(const View& view, const Team& team, double chord) {
  constexpr double kChord = 1, kTangent = 0.01,  // by one of 0 no turn could be measured
      kAfterTangents = -0.74,                    // of BDF2, after a step of SDIRK2 from tangents
      kFits = 0.25,     // of the squares that `chord` leaves: what one that fits better leaves at most
      kTurns = 0.15,    // of the squares of all ways: what a wrong chord may leave of a turn alone
      kStretch = 1e-8;  // squared stretch of a step below which all chords are the same
  Coasting out{};
  if (view.size() == 0) return out;
  double left = 0;
  const double others[] = {chord, kTangent, kChord, chord < 0 ? kAfterTangents : chord, chord};
  for (int k = 0; k < 5; ++k) {  // a loop, so that the code is there once: registers bound what calls this
    const Squares of = take_chord(view, team, others[k], out);
    const bool fits = out.turns && of.left < kFits * left;
    if (k > 0 && fits) break;
    if (k > 0) continue;
    left = of.left;
    if (!(out.turns && left > kStretch * of.size && left < kTurns * of.beside)) break;
  }
  return out;
}

// Calls write(i, x_bar, way_bar, mass_bar) for each vertex, of ways whose means have the adjoint mean_bar and whose
// bends have bend_bar(i).
template <class View, class Team, class BendBar, class Write>
DIFFVBD_FN void reverse_coasting(const View& view, const Team& team, const Coasting& c, const Vector& mean_bar,
                                 const BendBar& bend_bar, const Write& write) {
  double sum[12];
  team.template sum<12>(view.size(), sum, [&](int32_t i, double* to) {
    const Vector bar = bend_bar(i), before = c.arm(view, i) - c.back(view, i);
    add(to, bar), add_outer(to + 3, bar, before);
  });
  const Vector total{sum[0], sum[1], sum[2]};
  const double per_mass = c.mass > 0 ? 1 / c.mass : 0;
  Matrix b_bar = 0.0 * identity();
  Vector held{};  // what vertices send to the center of mass, times the chord: r appears in Q r alone
  if (c.turns) {
    const Matrix turn_bar = (-1 / c.chord) * rows_of(sum + 3);
    b_bar = polar_vjp(c.b, c.turned + identity(), turn_bar);
    held = transposed_times(c.turned, total);
  }
  const Vector to_mean = mean_bar - total - held, to_center = 1 / c.chord * held;
  team.each(view.size(), [&](int32_t i) {
    const double m = view.mass(i);
    const Vector bar = bend_bar(i), arm = c.arm(view, i), d = c.back(view, i), before = arm - d;
    const Vector turned = c.turns ? transposed_times(c.turned, bar) : Vector{}, pulled = b_bar * before,
                 pushed = transposed_times(b_bar, arm);
    const Vector x_bar = (-1 / c.chord) * turned + m * (pulled + pushed) + m * per_mass * to_center;
    const Vector way_bar = bar + turned - c.chord * m * pushed + m * per_mass * to_mean;
    write(i, x_bar, way_bar, dot(arm, pulled) + per_mass * (1 / c.chord * dot(d, to_mean) + dot(arm, to_center)));
  });
}

}  // namespace diffvbd::rigid
