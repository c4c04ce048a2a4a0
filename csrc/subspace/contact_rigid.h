// The rigid correction of bodies that touch (docs/method.md, section 18): groups, the gradient and the matrix of the
// incremental potential over a turn and a shift of every body, and how it changes along a step. In double precision.
// Groups of bodies are solved for together: those that touch, unless they are too many; then each is a group by itself.
// The loops are those of rigid_step.h.
#pragma once

#include <cstdint>

#include "../contact/advance.h"
#include "../contact/friction.h"
#include "../core/vec.h"
#include "rigid.h"

namespace diffvbd::contact {

constexpr int kUnknowns = 6;                // of a body: a turn and a shift
constexpr int kMostCoupled = 64;            // bodies of a group
constexpr int64_t kGroupMemory = 32 << 10;  // bodies of a scene times those of a group at most: memory of matrices
constexpr int kGroupRows = 4;               // member, first, rank and count

// The most bodies of a group.
DIFFVBD_FN int64_t most_grouped(int64_t bodies) {
  if (bodies == 0) return 0;
  const int64_t most = kGroupMemory / bodies < kMostCoupled ? kGroupMemory / bodies : kMostCoupled;
  return most < 1 ? 1 : most < bodies ? most : bodies;
}

// The groups of a scene: bodies that touch, in parts of at most `capacity`. Bodies have places, those of a group in a
// row, in the order of their numbers.
struct Groups {
  int32_t bodies;
  int64_t capacity;  // bodies of a group
  int32_t* rows;     // [4, bodies]

  DIFFVBD_FN int32_t& member(int32_t place) const { return rows[place]; }
  DIFFVBD_FN int32_t& first(int32_t body) const { return rows[bodies + body]; }
  DIFFVBD_FN int32_t& rank(int32_t body) const { return rows[2 * bodies + body]; }
  // Of the group that begins at a place, or 0.
  DIFFVBD_FN int32_t& count(int32_t place) const { return rows[3 * bodies + place]; }
  DIFFVBD_FN int32_t place(int32_t body) const { return first(body) + rank(body); }
  DIFFVBD_FN bool joined(int32_t a, int32_t b) const { return first(a) == first(b); }
  // The offset of the matrix of the group that begins at a place.
  DIFFVBD_FN int64_t matrix(int32_t place) const { return kUnknowns * kUnknowns * capacity * place; }
};

using rigid::Vector;

constexpr double kLeastInertia = 1e-11;  // of a body's sum of m r^2, added to its turn: a rod has none about itself

template <class T>
struct RigidInputs {
  rigid::Inputs<T> scene;  // x, x_prev, y, mass, energies, and the vertices of all bodies
  AdvanceInputs<T> gate;   // pairs with a barrier, radii; `move` is the trial displacement
  PairList lagged;
  const T* lag;                       // [pairs, 9] or null
  const T* collider_prev;             // [B, Vc, 3]
  Batched<const T> kappa, floor_lag;  // floor_lag [1 | B, V, planes, 4]
  const bool* free;                   // [bodies]: nothing of it is pinned
  int32_t* groups;                    // [B, 4, bodies], or null: all are one
  const bool* moving;                 // [B, bodies], or null: all move
  int32_t planes;
  double friction_eps;
  double friction_bend;  // of the derivative of friction along its slip: 1 is exact, 0 majorises
  bool bends;            // bodies do not move rigidly (contact_coarse.h): pairs within one act, too

  DIFFVBD_FN int32_t bodies() const { return scene.bodies; }
  DIFFVBD_FN Groups groups_of(int64_t s) const {
    return {scene.bodies, most_grouped(scene.bodies), groups + kGroupRows * scene.bodies * s};
  }
  // Whether the group that begins at a place moves: some body of it is to.
  DIFFVBD_FN bool moves(int64_t s, const Groups& g, int32_t place) const {
    bool any = !moving;
    for (int32_t i = 0; i < g.count(place) && !any; ++i) any = moving[s * scene.bodies + g.member(place + i)];
    return any;
  }
  // Scalars of the matrices of a scene.
  DIFFVBD_FN int64_t matrix_size() const { return kUnknowns * kUnknowns * scene.bodies * most_grouped(scene.bodies); }
  DIFFVBD_FN int64_t first_listed(int64_t s) const { return gate.listed.ptr[s * gate.corners] / 4; }
  DIFFVBD_FN int64_t first_lagged(int64_t s) const { return lag ? lagged.ptr[s * gate.corners] / 4 : 0; }
};

// The body that a corner point moves with, or -1.
template <class T>
DIFFVBD_FN int32_t moving_body(const RigidInputs<T>& in, int32_t corner) {
  const int32_t body = in.gate.body[corner];
  return body < in.bodies() && in.free[body] ? body : -1;
}

// Whether a listed pair depends on the motions: of rigid ones the pairs within a body do not.
template <class T>
DIFFVBD_FN bool is_between(const RigidInputs<T>& in, int64_t pair) {
  const int32_t* record = in.gate.listed.pairs + kPairRow * pair;
  return in.bends || in.gate.body[record[0]] != in.gate.body[record[sides(record[4])]];
}

// Positions of corner points: at x, or after the trial displacement.
template <class T>
struct CornerPoints {
  const RigidInputs<T>& in;
  bool moved;
  DIFFVBD_FN Vector relative(int64_t scene, int32_t v) const {  // to origin
    if (v >= in.gate.vertices) {
      return wide_at(in.gate.collider + 3 * (scene * (in.gate.corners - in.gate.vertices) + v - in.gate.vertices));
    }
    const int64_t row = 3 * (scene * in.gate.vertices + v);
    const Vector x = wide_at(in.scene.x + row);
    return moved ? x + wide_at(in.gate.move + row) : x;
  }
  DIFFVBD_FN Vector operator()(int64_t scene, int32_t v) const {
    const Vector x = relative(scene, v);
    if (v >= in.gate.vertices || !in.scene.origin.data) return x;
    return x + wide_at(in.scene.origin.data + scene * in.scene.origin.scene + 3 * int64_t{v});
  }
};

// The displacement of a point at r from the center by a motion, to first order.
DIFFVBD_FN Vector moved_by(const double* motion, const Vector& r) {
  return cross(vector_at(motion), r) + vector_at(motion + 3);
}

// A pair's gradient and its derivative by the motion of the first side relative to the second, and the part of its
// weight at corners. Moments are about the origin of x.
struct PairForce {
  int32_t body[2];  // moving body on either side, or -1; a pair within one body has it on the first
  Vector force;
  Sym3<double> stiffness;
  double weight[2];
  Vector at[2], pull[2], torque[2];
  double value;

  // The item of a side, by comparison: an index unknown at compile time would move the arrays from registers to memory.
  static DIFFVBD_FN double of(int side, const double (&a)[2]) { return side == 0 ? a[0] : a[1]; }
  static DIFFVBD_FN Vector of(int side, const Vector (&a)[2]) {
    return {side == 0 ? a[0].x : a[1].x, side == 0 ? a[0].y : a[1].y, side == 0 ? a[0].z : a[1].z};
  }
  DIFFVBD_FN Vector arm(int side, const Vector& center) const { return of(side, at) - of(side, weight) * center; }
  // The motion of the pair by the k-th unknown of a side's body, about its center.
  DIFFVBD_FN Vector map(int side, int k, const Vector& center) const {
    const Vector e = {double(k % 3 == 0), double(k % 3 == 1), double(k % 3 == 2)};
    return k < 3 ? cross(e, arm(side, center)) : of(side, weight) * e;
  }
  DIFFVBD_FN double gradient(int side, int k, const Vector& center) const {
    const Vector by_shift = of(side, pull), own = k < 3 ? of(side, torque) - cross(center, by_shift) : by_shift;
    return dot(map(side, k, center), force) + (k % 3 == 0 ? own.x : k % 3 == 1 ? own.y : own.z);
  }
};
// Whether both sides of a pair move, but not as one group.
template <class T>
DIFFVBD_FN bool is_apart(const RigidInputs<T>& in, int64_t scene, const PairForce& a) {
  return in.groups && a.body[0] >= 0 && a.body[1] >= 0 && !in.groups_of(scene).joined(a.body[0], a.body[1]);
}
// Then each side has twice the stiffness: no step is too long.
template <class T>
DIFFVBD_FN double borne(const RigidInputs<T>& in, int64_t scene, const PairForce& a) {
  return is_apart(in, scene, a) ? 2 : 1;
}

template <class T>
DIFFVBD_FN void sides_of(const RigidInputs<T>& in, const int32_t* record, PairForce& out) {
  out.body[0] = moving_body(in, record[0]);
  out.body[1] = moving_body(in, record[sides(record[4])]);
  for (int side = 0; side < 2; ++side) {
    out.weight[side] = 0;
    out.at[side] = out.pull[side] = out.torque[side] = Vector{};
  }
}

// Calls f(side, k) for the corners of a pair whose first side has `first`; as each_across().
template <class F>
DIFFVBD_FN void each_corner(int first, const F& f) {
  for (int side = 0; side < 2; ++side) {
    for (int k = 0; k < 4; ++k) {
      if ((k < first) == (side == 0)) f(side, k);
    }
  }
}

// The barrier of a listed pair between bodies; false where it does not act, or moves with one body.
template <class T, class At>
DIFFVBD_FN bool barrier_force(const RigidInputs<T>& in, int64_t pair, const At& at, PairForce& out) {
  const int32_t* record = in.gate.listed.pairs + kPairRow * pair;
  const T* constants = in.gate.constants + kConstants * pair;
  const int64_t scene = record[5];
  const int first = sides(record[4]);
  const double listed = PairHints<T>(constants).gap, dhat = PairConstants<T>(constants).dhat;
  if (listed == std::numeric_limits<double>::infinity() || !is_between(in, pair)) return false;  // pair_list.h
  sides_of(in, record, out);
  if (out.body[0] < 0 && out.body[1] < 0) return false;
  // a gap shrinks by no more than its corners have moved since it was taken
  double one = 0, other = 0;
  bool known = true;
  Vector relative[4];
  for (int k = 0; k < 4; ++k) {
    relative[k] = at.relative(scene, record[k]);
    known = known && record[k] < in.gate.vertices;
    if (!known) continue;
    const Vector d = relative[k] - wide_at(in.gate.center + 3 * (scene * in.gate.vertices + record[k]));
    one = k < first && one < dot(d, d) ? dot(d, d) : one;
    other = k >= first && other < dot(d, d) ? dot(d, d) : other;
  }
  if (known) {
    const double slack = (listed - dhat) * (1 - 1e-6);
    if (0 < slack && one < 0.25 * slack * slack && other < 0.25 * slack * slack) return false;
  }
  Corners<double> c;
  Vector points[4];
  for (int k = 0; k < 4; ++k) points[k] = at(scene, record[k]);
  for (int k = 0; k < 4; ++k) c.x[k] = points[k] - points[0];
  const PairConstants<T> a(constants);
  const Distance<double> near = distance(record[4], c);
  const double gap = near.d - a.offset, h = in.scene.time_step;
  if (!(gap < dhat)) return false;
  const LogBarrier<double> b(gap, dhat, h * h * in.kappa.data[scene * in.kappa.scene]);
  const bool varied = varies(record[4], c, near, a);
  const Weight<double> weight = weight_of(record[4], c, a, varied);
  out.value = weight.e * b.value;
  out.force = (weight.e * b.first) * near.n;
  out.stiffness = Sym3<double>{};
  add_outer(out.stiffness, weight.e * b.second, near.n);
  each_corner(first, [&](int side, int k) {
    if (out.body[side] < 0) return;
    out.weight[side] += near.w[k];
    out.at[side] += near.w[k] * relative[k];
    if (!varied) return;
    const Vector pull = b.value * weight.gradient[k];
    out.pull[side] += pull;
    out.torque[side] += cross(relative[k], pull);
  });
  return true;
}

// f0 of smoothed friction, whose slope over |u| is FrictionRate.
DIFFVBD_FN double friction_value(double length, double eps) {
  return length < eps ? length * length * (1 / eps - length / (3 * eps * eps)) + eps / 3 : length;
}

// Gradient and block of a vertex at its position, without pairs and friction.
template <class T>
DIFFVBD_FN void vertex_force(const RigidInputs<T>& in, const rigid::Body<T>& b, int32_t v, Vector& g, Sym3<double>& H) {
  const double mass = b.mass(v);
  const Vector x = b.position(v);
  const VertexState<double> s = b.state(v, x);
  g = mass * (x - b.target(v));
  H = diagonal(mass);
  b.energies(v,
             [&](auto energy, int, const double* data, int count) { decltype(energy)::block(s, data, count, g, H); });
}

// Friction of a vertex on one plane of a floor.
struct FloorFriction {
  Vector n, tangential;  // since the start of the step
  double size;           // h^2 times the load [N]
};
template <class T>
DIFFVBD_FN const T* floor_lag(const RigidInputs<T>& in, const rigid::Body<T>& b, int32_t v, int plane) {
  return in.floor_lag.data + b.scene * in.floor_lag.scene + (int64_t{v} * in.planes + plane) * 4;
}
// Whether a plane has a normal force on a vertex: most planes do not.
template <class T>
DIFFVBD_FN bool bears(const RigidInputs<T>& in, const rigid::Body<T>& b, int32_t v, int plane) {
  return *floor_lag(in, b, v, plane) != T(0);
}
template <class T>
DIFFVBD_FN FloorFriction floor_friction(const RigidInputs<T>& in, const rigid::Body<T>& b, int32_t v, int plane,
                                        const Vector& moved) {
  const T* lag = floor_lag(in, b, v, plane);
  const Vector n = wide_at(lag + 1), x = b.position(v), travel = x - b.state(v, x).x_prev + moved;
  const double h = in.scene.time_step;
  return {n, travel - dot(n, travel) * n, h * h * double(lag[0])};
}

// Adds friction on all planes.
template <class T>
DIFFVBD_FN void add_floor_friction(const RigidInputs<T>& in, const rigid::Body<T>& b, int32_t v, Vector& g,
                                   Sym3<double>& H) {
  for (int k = 0; k < in.planes; ++k) {
    if (!bears(in, b, v, k)) continue;
    const FloorFriction a = floor_friction(in, b, v, k, Vector{});
    const FrictionRate<double> f(square_root(dot(a.tangential, a.tangential)), in.friction_eps);
    g += (a.size * f.value) * a.tangential;
    add_diagonal(H, a.size * f.value);
    add_outer(H, -a.size * f.value, a.n);
    add_outer(H, in.friction_bend * a.size * f.curvature, a.tangential);
  }
}

// The change of the energies of a vertex and of its friction on planes by a displacement; infinite where an energy does
// not admit it. Adds the sizes of the terms.
template <class T>
DIFFVBD_FN double change_of_vertex(const RigidInputs<T>& in, const rigid::Body<T>& b, int32_t v,
                                   const Vector& displacement, double& size) {
  const VertexState<double> before = b.state(v, b.position(v));
  VertexState<double> after = before;
  after.x += displacement;
  double change = 0;
  bool admitted = true;
  b.energies(v, [&](auto energy, int, const double* data, int count) {
    using E = decltype(energy);
    if constexpr (E::has_filter) {
      admitted = admitted && E::template admits<T>(after, before.x, data, count, rigid::kLeastGapFraction);
      change += E::change(before, displacement, data, count, size);
    } else {
      const double now = E::value(before, data, count), then = E::value(after, data, count);
      change += then - now, size += absolute(now) + absolute(then);
    }
  });
  for (int k = 0; k < in.planes; ++k) {
    if (!bears(in, b, v, k)) continue;
    const auto value = [&](const Vector& moved) {
      const FloorFriction a = floor_friction(in, b, v, k, moved);
      return a.size * friction_value(square_root(dot(a.tangential, a.tangential)), in.friction_eps);
    };
    const double now = value(Vector{}), then = value(displacement);
    change += then - now, size += absolute(now) + absolute(then);
  }
  return admitted ? change : std::numeric_limits<double>::infinity();
}

// The displacement of a point at r from the center by a turn and a shift.
DIFFVBD_FN Vector displaced(const double* motion, double fraction, const Vector& r) {
  const Vector w = fraction * vector_at(motion), turned = cross(w, r);
  const rigid::Angles s(w);
  return s.a * turned + s.b * cross(w, turned) + fraction * vector_at(motion + 3);
}

// --- lagged friction and damping of pairs

// The position of a corner point at the start of the step, relative to origin.
template <class T>
DIFFVBD_FN Vector before(const RigidInputs<T>& in, int64_t scene, int32_t v) {
  const int32_t mesh = in.gate.vertices;
  return wide_at(v < mesh ? in.scene.x_prev.data + scene * in.scene.x_prev.scene + 3 * int64_t{v}
                          : in.collider_prev + 3 * (scene * (in.gate.corners - mesh) + v - mesh));
}

// The friction and damping of a lagged pair, linear at x; false where it does not act. It acts along a gap, and so
// turns even a body by itself.
template <class T, class At>
DIFFVBD_FN bool lagged_force(const RigidInputs<T>& in, int64_t pair, const At& at, PairForce& out) {
  const int32_t* record = in.lagged.pairs + kPairRow * pair;
  const Lag<T> lag(in.lag + kLagScalars * pair);
  if (!lag.active()) return false;
  const int64_t scene = record[5];
  sides_of(in, record, out);
  if (out.body[0] < 0 && out.body[1] < 0) return false;
  const bool within = out.body[0] == out.body[1];
  if (within) out.body[1] = -1;
  Vector m{};
  each_corner(within ? 4 : sides(record[4]), [&](int side, int k) {
    const int32_t v = record[k];
    const Vector x = at.relative(scene, v);
    m += double(lag.w[k]) * (x - before(in, scene, v));
    if (out.body[side] < 0) return;
    out.weight[side] += lag.w[k];
    out.at[side] += double(lag.w[k]) * x;
  });
  const Vector n = {double(lag.n.x), double(lag.n.y), double(lag.n.z)};
  const double h = in.scene.time_step, along = dot(n, m), approach = along < 0 ? along : 0;
  const double load = h * h * double(lag.friction), damping = h * double(lag.damping), eps = in.friction_eps;
  const Vector u = m - along * n;
  const double length = square_root(dot(u, u));
  const FrictionRate<double> f(length, eps);
  out.value = load * friction_value(length, eps) + 0.5 * damping * approach * approach;
  out.force = (load * f.value) * u + (damping * approach) * n;
  out.stiffness = diagonal(load * f.value);
  add_outer(out.stiffness, damping - load * f.value, n);
  add_outer(out.stiffness, in.friction_bend * load * f.curvature, u);
  return true;
}

// The body that a pair counts for: the first of those that it moves with, or -1.
template <class T>
DIFFVBD_FN int32_t owner_of(const RigidInputs<T>& in, const int32_t* record) {
  const int32_t first = moving_body(in, record[0]);
  return 0 <= first ? first : moving_body(in, record[sides(record[4])]);
}

}  // namespace diffvbd::contact
