// The rigid motion of each body with the linear and angular momentum of the wanted displacements, and the deviations
// from it; with the derivative of the former. No fraction of a rigid motion brings two points of a body closer
// (docs/method.md, section 12).
#pragma once

#include "../core/rotation.h"
#include "../core/views.h"
#include "../sweep/extrapolation.h"

namespace diffvbd::contact {

using rigid::Vector;

constexpr double kInertiaFloor = 1e-9;  // over its trace, added: a collapsed body has a singular inertia

template <class T>
struct MotionInputs {
  using Scalar = T;
  const T *x, *move, *gravity_move;    // [B, V, 3]; gravity_move may be null
  Batched<const T> origin, mass;       // [B, V, 3] or null, [1 | B, V]
  const bool *pinned, *pinned_bodies;  // [V], [bodies]: pinned or prescribed vertices; bodies with one
  const int32_t *order, *ptr;          // vertices by body [V], [bodies + 1]
  int64_t scenes;
  int32_t vertices, bodies;
};

// The longest displacements of the vertices of a body [m], columns of a table [kDisplacements, B, bodies].
enum DisplacementKind : int8_t {
  kBends,      // of a free vertex relative to their mean
  kDriven,     // of a pinned one
  kApart,      // of a free one relative to the rigid motion
  kStretched,  // from the end of a straight path to the turned body
  kGravity,    // of a free one by gravity_move
  kDisplacements,
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
  DIFFVBD_FN bool is_free(int32_t i) const { return !in.pinned[vertex(i)]; }
  DIFFVBD_FN double mass(int32_t i) const {
    return is_free(i) ? double(in.mass.data[scene * in.mass.scene + vertex(i)]) : 0.0;
  }
  DIFFVBD_FN Vector of(const T* rows, int32_t i) const { return wide_at(rows + 3 * row(i)); }
  DIFFVBD_FN Vector position(int32_t i) const {
    const Vector x = of(in.x, i);
    return in.origin.data ? x + wide_at(in.origin.data + scene * in.origin.scene + 3 * int64_t{vertex(i)}) : x;
  }
  DIFFVBD_FN Vector displacement(int32_t i) const { return of(in.move, i); }
};

// The rigid motion of a body: mass, mean displacement and center of its free vertices; the turn [rad].
struct RigidDisplacement {
  double mass;
  Vector mean, center, turn;
  Sym3<double> inverse;  // of the inertia
  bool moves;            // false: a vertex is pinned, or the body is not finite
};

DIFFVBD_FN double square(const Vector& a) { return dot(a, a); }
DIFFVBD_FN double length(const Vector& a) { return square_root(square(a)); }

template <class T>
DIFFVBD_FN constexpr double least_inertia() {
  constexpr double eps = std::numeric_limits<T>::epsilon();
  return eps < kInertiaFloor ? kInertiaFloor : eps;
}

template <class T, class Team>
DIFFVBD_FN RigidDisplacement rigid_displacement(const MovingBody<T>& b, const Team& team) {
  RigidDisplacement out{};
  double sum[9];
  const Vector about = b.size() > 0 ? b.position(0) : Vector{};  // squares of distances inside the body
  team.template sum<7>(b.size(), sum, [&](int32_t i, double* to) {
    const double m = b.mass(i);
    const Vector displacement = m * b.displacement(i), at = m * (b.position(i) - about);
    to[0] += m, add_to(to + 1, displacement), add_to(to + 4, at);
  });
  constexpr double tiny = std::numeric_limits<T>::min();
  out.mass = larger(sum[0], tiny);
  out.mean = (1 / out.mass) * vector_at(sum + 1);
  out.center = about + (1 / out.mass) * vector_at(sum + 4);
  if (b.in.pinned_bodies[b.body]) return out;
  team.template sum<9>(b.size(), sum, [&](int32_t i, double* to) {
    const double m = b.mass(i);
    const Vector arm = b.position(i) - out.center, spin = m * cross(arm, b.displacement(i)), r = m * arm;
    add_to(to, spin);
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
  out.turn = out.inverse * vector_at(sum);
  return out;
}

// rigid [B, V, 3]; displacements [kDisplacements, B, bodies]; sums [B, bodies, 4]: momentum times h [kg m] and mass.
template <class T, class Team>
DIFFVBD_FN void find_motion(const MovingBody<T>& b, const Team& team, T* rigid, T* displacements, T* sums) {
  const RigidDisplacement body = rigid_displacement(b, team);
  double most[6];
  team.template most<6>(b.size(), most, [&](int32_t i, double* of) {
    const Vector arm = b.position(i) - body.center, displacement = b.displacement(i), turn = cross(body.turn, arm);
    const Vector whole = body.moves ? body.mean + turn : Vector{};
    put(rigid + 3 * b.row(i), whole);
    const bool free = b.is_free(i);
    const double turned = length(turn);
    of[kBends] = free ? length(displacement - body.mean) : 0.0;
    of[kDriven] = free ? 0.0 : length(displacement);
    of[kApart] = free ? length(displacement - whole) : 0.0;
    of[kStretched] = turned;
    of[kGravity] = free && b.in.gravity_move ? length(b.of(b.in.gravity_move, i)) : 0.0;
    of[kDisplacements] = turned / larger(length(arm), double(std::numeric_limits<T>::min()));
  });
  if (!team.leads()) return;
  // a point at distance r of the axis ends r (sqrt(1 + angle^2) - 1) outside the turned body
  const double angle = most[kDisplacements];
  most[kStretched] *= angle / (1 + square_root(1 + angle * angle));
  for (int k = 0; k < kDisplacements; ++k) displacements[k * b.in.scenes * b.in.bodies + b.place()] = T(most[k]);
  T* to = sums + 4 * b.place();
  put(to, body.mass * body.mean), to[3] = T(body.mass);
}

// The adjoints of `rigid`: of x and move [B, V, 3], and of mass [B, V].
template <class T>
struct MotionAdjoints {
  const T* rigid;
  T *x, *move, *mass;
};

// With G the adjoint of a vertex's displacement t + w x r: t_bar = sum G, w_bar = sum r x G, and by w = I^-1 L, L_bar =
// l = I^-1 (sum r x G) and I_bar = -l w^T.
template <class T, class Team>
DIFFVBD_FN void reverse_motion(const MovingBody<T>& b, const Team& team, const MotionAdjoints<T>& a) {
  const RigidDisplacement body = rigid_displacement(b, team);
  const double whole = 1 + least_inertia<T>();
  double sum[6];
  team.template sum<6>(b.size(), sum, [&](int32_t i, double* to) {
    if (!body.moves) return;
    const Vector g = b.of(a.rigid, i), torque = cross(b.position(i) - body.center, g);
    add_to(to, g), add_to(to + 3, torque);
  });
  const Vector mean{sum[0], sum[1], sum[2]}, l = body.inverse * vector_at(sum + 3), w = body.turn;
  const auto arm_adjoint = [&](int32_t i, const Vector& arm) {
    const Vector inertial = (2 * whole * dot(l, w)) * arm - dot(w, arm) * l - dot(l, arm) * w;
    return cross(b.of(a.rigid, i), w) + b.mass(i) * (cross(b.displacement(i), l) - inertial);
  };
  double arms[3];
  team.template sum<3>(b.size(), arms, [&](int32_t i, double* to) {
    if (!body.moves) return;
    const Vector bar = arm_adjoint(i, b.position(i) - body.center);
    add_to(to, bar);
  });
  const Vector center{-arms[0], -arms[1], -arms[2]};
  team.each(b.size(), [&](int32_t i) {
    Vector x{}, move{};
    double mass = 0;
    if (body.moves) {
      const Vector arm = b.position(i) - body.center, displacement = b.displacement(i);
      const double m = b.mass(i), fraction = m / body.mass;
      x = arm_adjoint(i, arm) + fraction * center;
      move = fraction * mean + m * cross(l, arm);
      mass = (dot(mean, displacement - body.mean) + dot(center, arm)) / body.mass + dot(l, cross(arm, displacement)) -
             whole * dot(l, w) * square(arm) + dot(l, arm) * dot(w, arm);
    }
    put(a.x + 3 * b.row(i), x), put(a.move + 3 * b.row(i), move);
    a.mass[b.row(i)] = T(mass);
  });
}

// The extrapolation of bodies in a scene with contact (sweep/extrapolation.h), turned as a whole toward the ends of the
// displacements, and its adjoint (docs/method.md, section 12). With the new shape s_i = r_i + e_i and t_i = r_i + d_i -
// mean:
//     displacement_i = mean + P s_i - r_i,    P = polar(sum m t s^T)
struct TurnedExtrapolation {
  rigid::Extrapolation shape;
  rigid::Matrix b, turned;  // sum m t s^T, and P - 1
  bool turns;               // false: pinned, or there is no rotation; displacements are unchanged

  template <class T>
  DIFFVBD_FN Vector end(const MovingBody<T>& b_, int32_t i) const {
    return shape.arm(b_, i) + 1 / shape.lookback * shape.back(b_, i);
  }
  template <class T>
  DIFFVBD_FN Vector placed(const MovingBody<T>& b_, int32_t i) const {
    return end(b_, i) - shape.turning(b_, i);
  }
};

template <class T, class Team>
DIFFVBD_FN TurnedExtrapolation turned_extrapolation(const MovingBody<T>& b, const Team& team, double lookback) {
  TurnedExtrapolation out{};
  if (b.in.pinned_bodies[b.body]) return out;
  out.shape = rigid::extrapolation_of(b, team, lookback);
  if (!out.shape.turns) return out;
  double sum[9];
  team.template sum<9>(
      b.size(), sum, [&](int32_t i, double* to) { rigid::add_outer(to, b.mass(i) * out.end(b, i), out.placed(b, i)); });
  out.b = rigid::rows_of(sum);
  out.turns = rigid::turn_of(out.b, 1.0, out.turned);
  return out;
}

// extrapolated [B, V, 3]: `move` of free bodies without what stretches them.
template <class T, class Team>
DIFFVBD_FN void extrapolate(const MovingBody<T>& b, const Team& team, double lookback, T* extrapolated) {
  const TurnedExtrapolation c = turned_extrapolation(b, team, lookback);
  team.each(b.size(), [&](int32_t i) {
    T* to = extrapolated + 3 * b.row(i);
    if (!c.turns) return put(to, vector_at(b.in.move + 3 * b.row(i)));
    put(to, c.shape.displacement(b, i) + c.turned * c.placed(b, i));
  });
}

// `a.rigid` is the adjoint of `extrapolated`.
template <class T, class Team>
DIFFVBD_FN void reverse_extrapolate(const MovingBody<T>& b, const Team& team, double lookback,
                                    const MotionAdjoints<T>& a) {
  const TurnedExtrapolation c = turned_extrapolation(b, team, lookback);
  const auto write = [&](int32_t i, const Vector& x, const Vector& move, double mass) {
    put(a.x + 3 * b.row(i), x), put(a.move + 3 * b.row(i), move);
    a.mass[b.row(i)] = T(mass);
  };
  if (!c.turns) {
    team.each(b.size(), [&](int32_t i) { write(i, {}, b.of(a.rigid, i), 0); });
    return;
  }
  double sum[12];
  team.template sum<12>(b.size(), sum, [&](int32_t i, double* to) {
    const Vector g = b.of(a.rigid, i);
    add_to(to, g), rigid::add_outer(to + 3, g, c.placed(b, i));
  });
  const Vector total{sum[0], sum[1], sum[2]};
  const rigid::Matrix turn_bar = rigid::rows_of(sum + 3);
  const rigid::Matrix b_bar = rigid::polar_vjp(c.b, c.turned + rigid::identity(), turn_bar);
  const double per_mass = 1 / c.shape.mass;
  const Vector to_center = transposed_times(c.turned, total);
  const auto shape_bar = [&](int32_t i) {  // of s, where it is not in mean + e
    return transposed_times(c.turned, b.of(a.rigid, i)) + b.mass(i) * transposed_times(b_bar, c.end(b, i));
  };
  rigid::reverse_extrapolation(
      b, team, c.shape, total, [&](int32_t i) { return b.of(a.rigid, i) + shape_bar(i); },
      [&](int32_t i, const Vector& x, const Vector& move, double mass) {
        const double m = b.mass(i);
        const Vector end_bar = b_bar * c.placed(b, i), arm = c.shape.arm(b, i);
        write(i, x + shape_bar(i) + m * end_bar - m * per_mass * to_center, move + m * end_bar,
              mass + dot(c.end(b, i), end_bar) - per_mass * dot(arm, to_center));
      });
}

}  // namespace diffvbd::contact
