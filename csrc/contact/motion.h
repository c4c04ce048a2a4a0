// The rigid motion of each body with the linear and angular momentum of the wanted displacements, and the deviations
// from it (docs/method.md, section 12). Index data: not differentiated.
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

}  // namespace diffvbd::contact
