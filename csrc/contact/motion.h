// How the vertices of each body want to move: as one rigid motion that has the body's linear and angular momentum, and
// how far beside it; with the derivative of the former. A rigid motion brings no two points of a body closer, nor does
// a share of it (docs/method.md, section 12).
#pragma once

#include "../core/rotation.h"
#include "../core/views.h"
#include "../sweep/extrapolation.h"

namespace diffvbd::contact {

using rigid::Vector;

constexpr double kInertiaFloor = 1e-9;  // over its trace, added: a body collapsed to a line has none across it

template <class T>
struct MotionInputs {
  using Scalar = T;
  const T *x, *move, *fall;        // [B, V, 3]; fall may be null
  Batched<const T> origin, mass;   // [B, V, 3] or null, [1 | B, V]
  const bool *held, *held_bodies;  // [V], [bodies]: what something else moves; what has such a vertex
  const int32_t *order, *ptr;      // vertices by body [V], [bodies + 1]
  int64_t scenes;
  int32_t vertices, bodies;
};

// The longest ways of the vertices of a body [m], as columns of a table [kWays, B, bodies].
enum Way : int8_t {
  kBends,      // of a free one beside their mean
  kDriven,     // of a held one
  kApart,      // of a free one beside the rigid motion
  kStretched,  // from the end of the straight way of a turn to the turned body
  kFalls,      // of a free one by `fall`
  kWays,
};

// A body of one scene; item i is its i-th vertex.
template <class T>
struct MovingBody {
  const MotionInputs<T>& in;
  int64_t scene;
  int32_t body;

  DIFFVBD_FN int64_t place() const { return scene * in.bodies + body; }
  DIFFVBD_FN int32_t size() const { return in.ptr[body + 1] - in.ptr[body]; }
  DIFFVBD_FN int32_t vertex(int32_t i) const { return in.order[in.ptr[body] + i]; }
  DIFFVBD_FN int64_t row(int32_t i) const { return scene * in.vertices + vertex(i); }
  DIFFVBD_FN bool is_free(int32_t i) const { return !in.held[vertex(i)]; }
  DIFFVBD_FN double mass(int32_t i) const {
    return is_free(i) ? double(in.mass.data[scene * in.mass.scene + vertex(i)]) : 0.0;
  }
  DIFFVBD_FN static Vector vector(const T* p) { return {double(p[0]), double(p[1]), double(p[2])}; }
  DIFFVBD_FN Vector of(const T* rows, int32_t i) const { return vector(rows + 3 * row(i)); }
  DIFFVBD_FN Vector position(int32_t i) const {
    const Vector x = of(in.x, i);
    return in.origin.data ? x + vector(in.origin.data + scene * in.origin.scene + 3 * int64_t{vertex(i)}) : x;
  }
  DIFFVBD_FN Vector way(int32_t i) const { return of(in.move, i); }
};

// The rigid motion of a body: of its free vertices the mass, the mean way and the center; the turn [rad].
struct RigidWay {
  double mass;
  Vector mean, center, turn;
  Sym3<double> inverse;  // of the inertia
  bool moves;            // false: a vertex is held, or the body is not finite
};

DIFFVBD_FN double square(const Vector& a) { return dot(a, a); }
DIFFVBD_FN double length(const Vector& a) { return square_root(square(a)); }

template <class T>
DIFFVBD_FN constexpr double least_inertia() {
  constexpr double eps = std::numeric_limits<T>::epsilon();
  return eps < kInertiaFloor ? kInertiaFloor : eps;
}

template <class T, class Team>
DIFFVBD_FN RigidWay rigid_way(const MovingBody<T>& b, const Team& team) {
  RigidWay out{};
  double sum[9];
  const Vector about = b.size() > 0 ? b.position(0) : Vector{};  // squares of distances inside the body
  team.template sum<7>(b.size(), sum, [&](int32_t i, double* to) {
    const double m = b.mass(i);
    const Vector way = m * b.way(i), at = m * (b.position(i) - about);
    to[0] += m, to[1] += way.x, to[2] += way.y, to[3] += way.z, to[4] += at.x, to[5] += at.y, to[6] += at.z;
  });
  constexpr double tiny = std::numeric_limits<T>::min();
  out.mass = larger(sum[0], tiny);
  out.mean = (1 / out.mass) * Vector{sum[1], sum[2], sum[3]};
  out.center = about + (1 / out.mass) * Vector{sum[4], sum[5], sum[6]};
  if (b.in.held_bodies[b.body]) return out;
  team.template sum<9>(b.size(), sum, [&](int32_t i, double* to) {
    const double m = b.mass(i);
    const Vector arm = b.position(i) - out.center, spin = m * cross(arm, b.way(i)), r = m * arm;
    to[0] += spin.x, to[1] += spin.y, to[2] += spin.z;
    to[3] += r.x * arm.x, to[4] += r.x * arm.y, to[5] += r.x * arm.z;
    to[6] += r.y * arm.y, to[7] += r.y * arm.z, to[8] += r.z * arm.z;
  });
  const double size = sum[3] + sum[6] + sum[8], scale = 0 < size ? 1 / size : 1.0, whole = 1 + least_inertia<T>();
  const Vector a{whole - scale * sum[3], -scale * sum[4], -scale * sum[5]};  // of the inertia over its size, symmetric
  const Vector c{-scale * sum[4], whole - scale * sum[6], -scale * sum[7]};
  const Vector d{-scale * sum[5], -scale * sum[7], whole - scale * sum[8]};
  const Vector first = cross(c, d), second = cross(d, a), third = cross(a, c);
  const double determinant = dot(a, first);
  out.moves = size == size;
  if (!(0 < determinant && 0 < size)) return out;  // of a point there is no turn
  const double inverse = scale / determinant;
  out.inverse.xx = inverse * first.x, out.inverse.xy = inverse * first.y, out.inverse.xz = inverse * first.z;
  out.inverse.yy = inverse * second.y, out.inverse.yz = inverse * second.z, out.inverse.zz = inverse * third.z;
  out.turn = out.inverse * Vector{sum[0], sum[1], sum[2]};
  return out;
}

// rigid [B, V, 3]; ways [kWays, B, bodies]; sums [B, bodies, 4]: momentum over the time [kg m] and mass.
template <class T, class Team>
DIFFVBD_FN void find_motion(const MovingBody<T>& b, const Team& team, T* rigid, T* ways, T* sums) {
  const RigidWay body = rigid_way(b, team);
  double most[6];
  team.template most<6>(b.size(), most, [&](int32_t i, double* of) {
    const Vector arm = b.position(i) - body.center, way = b.way(i), turn = cross(body.turn, arm);
    const Vector whole = body.moves ? body.mean + turn : Vector{};
    T* to = rigid + 3 * b.row(i);
    to[0] = T(whole.x), to[1] = T(whole.y), to[2] = T(whole.z);
    const bool free = b.is_free(i);
    const double turned = length(turn);
    of[kBends] = free ? length(way - body.mean) : 0.0;
    of[kDriven] = free ? 0.0 : length(way);
    of[kApart] = free ? length(way - whole) : 0.0;
    of[kStretched] = turned;
    of[kFalls] = free && b.in.fall ? length(b.of(b.in.fall, i)) : 0.0;
    of[kWays] = turned / larger(length(arm), double(std::numeric_limits<T>::min()));
  });
  if (!team.leads()) return;
  // a point at a distance r of the axis ends its way r (sqrt(1 + angle^2) - 1) outside the turned body
  const double angle = most[kWays];
  most[kStretched] *= angle / (1 + square_root(1 + angle * angle));
  for (int k = 0; k < kWays; ++k) ways[k * b.in.scenes * b.in.bodies + b.place()] = T(most[k]);
  T* to = sums + 4 * b.place();
  const Vector momentum = body.mass * body.mean;
  to[0] = T(momentum.x), to[1] = T(momentum.y), to[2] = T(momentum.z), to[3] = T(body.mass);
}

// The adjoints of `rigid`: of x and move [B, V, 3], and of mass [B, V].
template <class T>
struct MotionAdjoints {
  const T* rigid;
  T *x, *move, *mass;
};

// With G the adjoint of a vertex's way t + w x r, that of t is sum G, of w sum r x G, and of w = I^-1 L those of L and
// I are l = I^-1 (sum r x G) and -l w^T.
template <class T, class Team>
DIFFVBD_FN void reverse_motion(const MovingBody<T>& b, const Team& team, const MotionAdjoints<T>& a) {
  const RigidWay body = rigid_way(b, team);
  const double whole = 1 + least_inertia<T>();
  double sum[6];
  team.template sum<6>(b.size(), sum, [&](int32_t i, double* to) {
    if (!body.moves) return;
    const Vector g = b.of(a.rigid, i), torque = cross(b.position(i) - body.center, g);
    to[0] += g.x, to[1] += g.y, to[2] += g.z, to[3] += torque.x, to[4] += torque.y, to[5] += torque.z;
  });
  const Vector mean{sum[0], sum[1], sum[2]}, l = body.inverse * Vector{sum[3], sum[4], sum[5]}, w = body.turn;
  const auto arm_adjoint = [&](int32_t i, const Vector& arm) {
    const Vector inertial = (2 * whole * dot(l, w)) * arm - dot(w, arm) * l - dot(l, arm) * w;
    return cross(b.of(a.rigid, i), w) + b.mass(i) * (cross(b.way(i), l) - inertial);
  };
  double arms[3];
  team.template sum<3>(b.size(), arms, [&](int32_t i, double* to) {
    if (!body.moves) return;
    const Vector bar = arm_adjoint(i, b.position(i) - body.center);
    to[0] += bar.x, to[1] += bar.y, to[2] += bar.z;
  });
  const Vector center{-arms[0], -arms[1], -arms[2]};
  team.each(b.size(), [&](int32_t i) {
    Vector x{}, move{};
    double mass = 0;
    if (body.moves) {
      const Vector arm = b.position(i) - body.center, way = b.way(i);
      const double m = b.mass(i), share = m / body.mass;
      x = arm_adjoint(i, arm) + share * center;
      move = share * mean + m * cross(l, arm);
      mass = (dot(mean, way - body.mean) + dot(center, arm)) / body.mass + dot(l, cross(arm, way)) -
             whole * dot(l, w) * square(arm) + dot(l, arm) * dot(w, arm);
    }
    T *x_to = a.x + 3 * b.row(i), *move_to = a.move + 3 * b.row(i);
    x_to[0] = T(x.x), x_to[1] = T(x.y), x_to[2] = T(x.z);
    move_to[0] = T(move.x), move_to[1] = T(move.y), move_to[2] = T(move.z);
    a.mass[b.row(i)] = T(mass);
  });
}

// Where the bodies of a scene with contact coast to: each free one as rigid/coast.h has it, and turned as a whole to
// where its ways point (docs/method.md, section 12). With the adjoint.

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
