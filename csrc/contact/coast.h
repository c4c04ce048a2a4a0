// Where the bodies of a scene with contact coast to: each free one as rigid/coast.h has it, and turned as a whole to
// where its ways point (docs/method.md, section 12). With the adjoint.
#pragma once

#include "../rigid/coast.h"
#include "motion.h"

namespace diffvbd::contact {

// The coasting of a body, and the turn P of its new shape s_i = r_i + e_i to the ends of its ways t_i = r_i + d_i -
// mean:
//     way_i = mean + P s_i - r_i,    P = polar(sum m t s^T)
struct TurnedCoasting {
  rigid::Coasting shape;
  rigid::Matrix b, turned;  // sum m t s^T, and P - 1
  bool turns;               // false: a vertex is held, or there is no rotation; ways are as they were

  template <class T>
  DIFFVBD_FN Vector end(const MovingBody<T>& b_, int32_t i) const {
    return shape.arm(b_, i) + 1 / shape.chord * shape.back(b_, i);
  }
  template <class T>
  DIFFVBD_FN Vector placed(const MovingBody<T>& b_, int32_t i) const {
    return end(b_, i) - shape.turning(b_, i);
  }
};

template <class T, class Team>
DIFFVBD_FN TurnedCoasting turned_coasting(const MovingBody<T>& b, const Team& team, double chord) {
  TurnedCoasting out{};
  if (b.in.held_bodies[b.body]) return out;
  out.shape = rigid::coasting_of(b, team, chord);
  if (!out.shape.turns) return out;
  double sum[9];
  team.template sum<9>(
      b.size(), sum, [&](int32_t i, double* to) { rigid::add_outer(to, b.mass(i) * out.end(b, i), out.placed(b, i)); });
  out.b = rigid::rows_of(sum);
  out.turns = rigid::turn_of(out.b, 1.0, out.turned);
  return out;
}

// coasted [B, V, 3]: the ways of `move`, of free bodies without what stretches them.
template <class T, class Team>
DIFFVBD_FN void coast(const MovingBody<T>& b, const Team& team, double chord, T* coasted) {
  const TurnedCoasting c = turned_coasting(b, team, chord);
  team.each(b.size(), [&](int32_t i) {
    T* to = coasted + 3 * b.row(i);
    const T* from = b.in.move + 3 * b.row(i);
    if (!c.turns) {
      for (int k = 0; k < 3; ++k) to[k] = from[k];
      return;
    }
    const Vector way = c.shape.way(b, i) + c.turned * c.placed(b, i);
    to[0] = T(way.x), to[1] = T(way.y), to[2] = T(way.z);
  });
}

// `a.rigid` is the adjoint of `coasted`.
template <class T, class Team>
DIFFVBD_FN void reverse_coast(const MovingBody<T>& b, const Team& team, double chord, const MotionAdjoints<T>& a) {
  const TurnedCoasting c = turned_coasting(b, team, chord);
  const auto put = [&](int32_t i, const Vector& x, const Vector& move, double mass) {
    T *x_to = a.x + 3 * b.row(i), *move_to = a.move + 3 * b.row(i);
    x_to[0] = T(x.x), x_to[1] = T(x.y), x_to[2] = T(x.z);
    move_to[0] = T(move.x), move_to[1] = T(move.y), move_to[2] = T(move.z);
    a.mass[b.row(i)] = T(mass);
  };
  if (!c.turns) {
    team.each(b.size(), [&](int32_t i) { put(i, {}, b.of(a.rigid, i), 0); });
    return;
  }
  double sum[12];
  team.template sum<12>(b.size(), sum, [&](int32_t i, double* to) {
    const Vector g = b.of(a.rigid, i);
    rigid::add(to, g), rigid::add_outer(to + 3, g, c.placed(b, i));
  });
  const Vector total{sum[0], sum[1], sum[2]};
  const rigid::Matrix turn_bar = rigid::rows_of(sum + 3);
  const rigid::Matrix b_bar = rigid::polar_vjp(c.b, c.turned + rigid::identity(), turn_bar);
  const double per_mass = 1 / c.shape.mass;
  const Vector to_center = transposed_times(c.turned, total);
  const auto shape_bar = [&](int32_t i) {  // of s, where it is not in mean + e
    return transposed_times(c.turned, b.of(a.rigid, i)) + b.mass(i) * transposed_times(b_bar, c.end(b, i));
  };
  rigid::reverse_coasting(
      b, team, c.shape, total, [&](int32_t i) { return b.of(a.rigid, i) + shape_bar(i); },
      [&](int32_t i, const Vector& x, const Vector& move, double mass) {
        const double m = b.mass(i);
        const Vector end_bar = b_bar * c.placed(b, i), arm = c.shape.arm(b, i);
        put(i, x + shape_bar(i) + m * end_bar - m * per_mass * to_center, move + m * end_bar,
            mass + dot(c.end(b, i), end_bar) - per_mass * dot(arm, to_center));
      });
}

}  // namespace diffvbd::contact
