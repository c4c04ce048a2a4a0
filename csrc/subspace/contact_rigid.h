// The rigid correction of bodies that touch (docs/method.md, section 18): groups, the gradient and the matrix of the
// incremental potential over a turn and a shift of every body, friction along a step, and the trial fractions of the
// Newton step. In double precision.
// Groups of bodies are solved for together: those that touch, unless they are too many; then each is a group by itself.
// Scenes of few bodies are one group.
#pragma once

#include <cstdint>

#include "../contact/advance.h"
#include "../contact/friction.h"
#include "../core/vec.h"
#include "rigid.h"

namespace diffvbd::contact {

constexpr int kUnknowns = 6;                // of a body: a turn and a shift
constexpr int kFew = 3;                     // bodies of scenes that are one group
constexpr int kMostCoupled = 64;            // bodies of a group
constexpr int64_t kGroupMemory = 32 << 10;  // bodies of a scene times those of a group at most: memory of matrices
constexpr int kGroupRows = 4;               // member, first, rank and count
constexpr int32_t kLeft = -1;               // count of a group: a body of too many that touch

// The most bodies of a group.
DIFFVBD_FN int64_t most_grouped(int64_t bodies) {
  if (bodies == 0) return 0;
  const int64_t most = kGroupMemory / bodies < kMostCoupled ? kGroupMemory / bodies : kMostCoupled;
  return most < 1 ? 1 : most < bodies ? most : bodies;
}

// The groups of a scene. Bodies have places, those of a group in a row: up to kFew in the order of their numbers, more
// in the order of elimination.
struct Groups {
  int32_t bodies;
  int64_t capacity;     // bodies of a group that fit the memory of its matrix: larger groups do not move
  const int32_t* rows;  // [4, bodies], or null: all are one group

  DIFFVBD_FN int32_t member(int32_t place) const { return rows ? rows[place] : place; }
  DIFFVBD_FN int32_t first(int32_t body) const { return rows ? rows[bodies + body] : 0; }
  DIFFVBD_FN int32_t rank(int32_t body) const { return rows ? rows[2 * bodies + body] : body; }
  // The size of the group that begins at a place, or 0.
  DIFFVBD_FN int32_t count(int32_t place) const {
    if (!rows) return place == 0 ? bodies : 0;
    return is_left(place) ? 1 : rows[3 * bodies + place];
  }
  // Whether the body there is alone because those that touch are too many.
  DIFFVBD_FN bool is_left(int32_t place) const { return rows && rows[3 * bodies + place] == kLeft; }
  DIFFVBD_FN bool joined(int32_t a, int32_t b) const { return first(a) == first(b); }
  // The offset of the matrix of the group that begins at a place.
  DIFFVBD_FN int64_t matrix(int32_t place) const { return rows ? kUnknowns * kUnknowns * capacity * place : 0; }
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
  const int32_t* groups;              // [B, 4, bodies], or null: one group, or not needed
  int64_t capacity;                   // bodies of a group that fit the memory of its matrix
  const bool* moving;                 // [B, bodies], or null: all move
  int32_t planes;
  double friction_eps;
  bool has_friction;
  bool bends;  // bodies do not move rigidly (contact_coarse.h): pairs within one act, too; friction is linear at x

  DIFFVBD_FN int32_t bodies() const { return scene.bodies; }
  // Lists are of all scenes, but what a scene does must not depend on others.
  DIFFVBD_FN bool has_friction_in(int64_t s) const {
    return has_friction && (planes > 0 || first_lagged(s) < first_lagged(s + 1));
  }
  // Whether all bodies of a scene are one group.
  DIFFVBD_FN bool together() const { return scene.bodies <= kFew; }
  DIFFVBD_FN Groups groups_of(int64_t s) const {
    return {scene.bodies, capacity, groups ? groups + kGroupRows * scene.bodies * s : nullptr};
  }
  // Whether the group that begins at a place moves: some body of it is to, and its matrix fits.
  DIFFVBD_FN bool moves(int64_t s, const Groups& g, int32_t place) const {
    const int32_t count = g.count(place);
    bool any = !moving;
    for (int32_t i = 0; i < count && !any; ++i) any = moving[s * scene.bodies + g.member(place + i)];
    return any && count <= capacity;
  }
  // Scalars of the matrices of a scene.
  DIFFVBD_FN int64_t matrix_size() const { return kUnknowns * kUnknowns * scene.bodies * capacity; }
  DIFFVBD_FN int64_t first_listed(int64_t s) const { return gate.listed.ptr[s * gate.corners] / 4; }
  DIFFVBD_FN int64_t first_lagged(int64_t s) const { return lag ? lagged.ptr[s * gate.corners] / 4 : 0; }
};

// The bodies of a scene of few that are to move, and those that touch them, directly or not. touching [n, n]: of two,
// either order.
DIFFVBD_FN void find_moving(int32_t n, const bool* moving, const uint8_t* touching, bool* out) {
  for (int32_t k = 0; k < n; ++k) out[k] = moving[k];
  for (int32_t round = 1; round < n; ++round) {
    for (int32_t i = 0; i < n * n; ++i) {
      if (touching[i] && (out[i / n] || out[i % n])) out[i / n] = out[i % n] = true;
    }
  }
}

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
  Vector tangential;     // tangential displacement that friction is linear about
  double friction_load;  // h^2 times its load [N], over `doubled`
  double doubled;        // 2 where sides are not of one group: each takes twice its body's motion; else 1

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
  // The motion by all of its unknowns.
  DIFFVBD_FN Vector moved(int side, const Vector& center, const double* motion) const {
    const Vector turn = {motion[0], motion[1], motion[2]}, shift = {motion[3], motion[4], motion[5]};
    return cross(turn, arm(side, center)) + of(side, weight) * shift;
  }
  DIFFVBD_FN double gradient(int side, int k, const Vector& center) const {
    const Vector by_shift = of(side, pull), own = k < 3 ? of(side, torque) - cross(center, by_shift) : by_shift;
    return dot(map(side, k, center), force) + (k % 3 == 0 ? own.x : k % 3 == 1 ? own.y : own.z);
  }
};
constexpr int kForceDoubles = 29;  // of a PairForce without its bodies, its value and its friction

DIFFVBD_FN void store_force(const PairForce& a, double* to) {
  int i = 0;
  const auto put = [&](const Vector& v) { to[i] = v.x, to[i + 1] = v.y, to[i + 2] = v.z, i += 3; };
  put(a.force);
  const Sym3<double>& s = a.stiffness;
  const double entries[] = {s.xx, s.xy, s.xz, s.yy, s.yz, s.zz, a.weight[0], a.weight[1]};
  for (const double entry : entries) to[i++] = entry;
  for (int side = 0; side < 2; ++side) put(a.at[side]), put(a.pull[side]), put(a.torque[side]);
}
DIFFVBD_FN PairForce load_force(const double* from, const int32_t* body) {
  PairForce a;
  int i = 0;
  const auto get = [&] { return i += 3, Vector{from[i - 3], from[i - 2], from[i - 1]}; };
  a.body[0] = body[0], a.body[1] = body[1];
  a.force = get();
  a.stiffness = {from[3], from[4], from[5], from[6], from[7], from[8]};
  a.weight[0] = from[9], a.weight[1] = from[10];
  i = 11;
  for (int side = 0; side < 2; ++side) a.at[side] = get(), a.pull[side] = get(), a.torque[side] = get();
  a.value = 0;
  return a;
}

// Whether both sides of a pair move, but not as one group.
template <class T>
DIFFVBD_FN bool is_apart(const RigidInputs<T>& in, int64_t scene, const PairForce& a) {
  return a.body[0] >= 0 && a.body[1] >= 0 && !in.groups_of(scene).joined(a.body[0], a.body[1]);
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
  out.friction_load = 0;
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

// Adds friction on a plane, linear about the position after `displacement`.
template <class T>
DIFFVBD_FN void add_plane_friction(const RigidInputs<T>& in, const rigid::Body<T>& b, int32_t v, int plane,
                                   const Vector& displacement, Vector& g, Sym3<double>& H) {
  const FloorFriction a = floor_friction(in, b, v, plane, displacement);
  const FrictionRate<double> f(square_root(dot(a.tangential, a.tangential)), in.friction_eps);
  const Vector along = displacement - dot(a.n, displacement) * a.n;
  g += a.size * (f.value * (a.tangential - along) - (f.curvature * dot(a.tangential, along)) * a.tangential);
  add_diagonal(H, a.size * f.value);
  add_outer(H, -a.size * f.value, a.n);
  add_outer(H, a.size * f.curvature, a.tangential);
}
// The same on all planes.
template <class T>
DIFFVBD_FN void add_floor_friction(const RigidInputs<T>& in, const rigid::Body<T>& b, int32_t v,
                                   const Vector& displacement, Vector& g, Sym3<double>& H) {
  for (int k = 0; k < in.planes; ++k) {
    if (bears(in, b, v, k)) add_plane_friction(in, b, v, k, displacement, g, H);
  }
}

// Roundings of its position by which a vertex may leave its target before its potential counts as increased: in free
// flight the potential is nothing else.
constexpr double kValueUlps = 8;

// The potential of a vertex, now or after the trial displacement, less its rounding.
template <class T>
DIFFVBD_FN double vertex_value(const RigidInputs<T>& in, const rigid::Body<T>& b, int32_t v, bool moved) {
  const Vector x = CornerPoints<T>{in, moved}.relative(b.scene, v), off = x - b.target(v);
  const VertexState<double> s = b.state(v, x);
  double value = 0.5 * b.mass(v) * dot(off, off);
  b.energies(
      v, [&](auto energy, int, const double* data, int count) { value += decltype(energy)::value(s, data, count); });
  for (int k = 0; k < in.planes; ++k) {
    if (!bears(in, b, v, k)) continue;
    const FloorFriction a = floor_friction(in, b, v, k, x - b.position(v));
    value += a.size * friction_value(square_root(dot(a.tangential, a.tangential)), in.friction_eps);
  }
  const double rounding = kValueUlps * std::numeric_limits<T>::epsilon() * size_of(x);
  return moved ? value - b.mass(v) * rounding * rounding : value;
}

// The displacement of a point at r from the center by a turn and a shift.
DIFFVBD_FN Vector displaced(const double* motion, double fraction, const Vector& r) {
  const Vector w = fraction * vector_at(motion), turned = cross(w, r);
  const rigid::Angles s(w);
  return s.a * turned + s.b * cross(w, turned) + fraction * vector_at(motion + 3);
}

// The Newton step of a body from the solution for its gradient; zero where the matrix was not positive definite.
DIFFVBD_FN void keep_finite(double* solution) {
  bool finite = true;
  for (int i = 0; i < kUnknowns; ++i)
    finite = finite && absolute(solution[i]) < std::numeric_limits<double>::infinity();
  for (int i = 0; i < kUnknowns; ++i) solution[i] = finite ? -solution[i] : 0.0;
}

// --- lagged friction and damping of pairs

// The position of a corner point at the start of the step, relative to origin.
template <class T>
DIFFVBD_FN Vector before(const RigidInputs<T>& in, int64_t scene, int32_t v) {
  const int32_t mesh = in.gate.vertices;
  return wide_at(v < mesh ? in.scene.x_prev.data + scene * in.scene.x_prev.scene + 3 * int64_t{v}
                          : in.collider_prev + 3 * (scene * (in.gate.corners - mesh) + v - mesh));
}

// Motions of all bodies of a scene, about which friction is linear; null: no motion.
struct BodyMotions {
  const double *center, *motion;  // [bodies, 3], [bodies, 6]
};

// The relative displacement of the sides of a lagged pair by such motions.
DIFFVBD_FN Vector displacement_of(const PairForce& a, const BodyMotions& motions) {
  Vector displacement{};
  for (int side = 0; side < 2; ++side) {
    const int32_t body = a.body[side];
    if (body < 0) continue;
    displacement += a.doubled * a.moved(side, wide_at(motions.center + 3 * body), motions.motion + kUnknowns * body);
  }
  return displacement;
}

// The part of lagged friction and damping that does not depend on the motions.
struct LaggedFriction {
  Vector n, u;                     // u: tangential displacement since the start of the step
  double size, damping, approach;  // h^2 times the normal force [N]; h times the coefficient; approach of the sides
};

// The sides of a lagged pair and its state; false where it does not act. It acts along a gap, and so turns even a body
// by itself. Where the sides are of two groups, `alone` selects one: it has half of the potential at twice its motion,
// and the potential is convex, so that lowering both halves lowers the whole. alone = -1: both.
template <class T, class At>
DIFFVBD_FN bool lagged_sides(const RigidInputs<T>& in, int64_t pair, const At& at, int alone, PairForce& out,
                             LaggedFriction& lagged_state) {
  const int32_t* record = in.lagged.pairs + kPairRow * pair;
  const Lag<T> lag(in.lag + kLagScalars * pair);
  if (!lag.active()) return false;
  const int64_t scene = record[5];
  const int first = sides(record[4]);
  sides_of(in, record, out);
  if (out.body[0] < 0 && out.body[1] < 0) return false;
  const bool within = out.body[0] == out.body[1];
  if (within) out.body[1] = -1;
  const bool halves = alone >= 0 && is_apart(in, scene, out);
  if (halves) out.body[1 - alone] = -1;
  out.doubled = halves ? 2 : 1;
  Vector m{};
  each_corner(within ? 4 : first, [&](int side, int k) {
    const int32_t v = record[k];
    const Vector x = at.relative(scene, v);
    m += double(lag.w[k]) * (x - before(in, scene, v));
    if (out.body[side] < 0) return;
    out.weight[side] += lag.w[k];
    out.at[side] += double(lag.w[k]) * x;
  });
  lagged_state.n = {double(lag.n.x), double(lag.n.y), double(lag.n.z)};
  const double h = in.scene.time_step, along = dot(lagged_state.n, m);
  lagged_state.u = m - along * lagged_state.n;
  lagged_state.size = h * h * double(lag.friction), lagged_state.damping = h * double(lag.damping);
  lagged_state.approach = along < 0 ? along : 0;
  return true;
}

// Its force. Gradient and matrix are exact after the relative displacement.
DIFFVBD_FN void lagged_friction_force(const LaggedFriction& a, const Vector& displacement, double eps, PairForce& out) {
  out.tangential = a.u + (displacement - dot(a.n, displacement) * a.n);
  const double length = square_root(dot(out.tangential, out.tangential));
  const FrictionRate<double> f(length, eps);
  out.friction_load = a.size / out.doubled;
  out.value = a.size * friction_value(length, eps) + 0.5 * a.damping * a.approach * a.approach;
  out.force = a.size * (f.value * a.u - (f.curvature * dot(out.tangential, displacement)) * out.tangential) +
              (a.damping * a.approach) * a.n;
  const double borne = out.doubled;
  out.stiffness = diagonal(borne * a.size * f.value);
  add_outer(out.stiffness, borne * (a.damping - a.size * f.value), a.n);
  add_outer(out.stiffness, borne * a.size * f.curvature, out.tangential);
}

// Both, about the given motions.
template <class T, class At>
DIFFVBD_FN bool lagged_force(const RigidInputs<T>& in, int64_t pair, const At& at, const BodyMotions& motions,
                             PairForce& out, int alone) {
  LaggedFriction lagged_state;
  if (!lagged_sides(in, pair, at, alone, out, lagged_state)) return false;
  lagged_friction_force(lagged_state, motions.motion ? displacement_of(out, motions) : Vector{}, in.friction_eps, out);
  return true;
}

// --- friction along a step. All else is linear in the motions of bodies. Newton's method iterates on friction, with
// shorter steps where a full one would reverse a tangential displacement.

constexpr int kFrictionIterations = 200;  // of Newton's method at most; most systems need 10 to 30
constexpr int kHalvings = 40;             // in the search for the length of a step, at most
constexpr double kOvershoot = 0.1;        // slope at the end of a step over that at its start that counts as small
constexpr double kSettled = 1e-9;         // of the whole motion: one more step follows

// FrictionRate's value for the square of a length, without the divisions that take most of the time of a search.
DIFFVBD_FN double friction_rate(double square, double eps) {
  if (!(0 < square)) return 2 / eps;
#ifdef __CUDA_ARCH__
  const double inverse = rsqrt(square);
#else
  const double inverse = 1 / square_root(square);
#endif
  if (!(square < eps * eps)) return inverse;
  const double over = 1 / eps;
  return (2 - square * inverse * over) * over;
}

// A tangential displacement u along a step c of Newton's method, as far as friction depends on it.
struct FrictionLine {
  double start, along, step_square;  // u u, u c and c c
  double size, rate, bend;           // linear model of friction: f1(|u|) / |u| at the start, and its derivative

  FrictionLine() = default;
  DIFFVBD_FN FrictionLine(const Vector& tangential, const Vector& change, double load, double eps)
      : start(dot(tangential, tangential)),
        along(dot(tangential, change)),
        step_square(dot(change, change)),
        size(load) {
    const FrictionRate<double> first(square_root(start), eps);
    rate = first.value, bend = first.curvature * along;
  }

  // The slope of the potential after a fraction of the step, beyond that of the linear model.
  DIFFVBD_FN double excess(double fraction, double eps) const {
    const double toward = along + fraction * step_square, square = start + fraction * (along + toward);
    return size * ((friction_rate(square, eps) - rate) * toward - fraction * bend * along);
  }
};

// The line of a lagged pair, from its force.
template <class T>
DIFFVBD_FN FrictionLine friction_line(const RigidInputs<T>& in, int64_t pair, const PairForce& a, const double* center,
                                      const double* step) {
  const Lag<T> lag(in.lag + kLagScalars * pair);
  const Vector n = {double(lag.n.x), double(lag.n.y), double(lag.n.z)};
  const Vector displacement = displacement_of(a, {center, step});
  return {a.tangential, displacement - dot(n, displacement) * n, a.friction_load, in.friction_eps};
}

// The line of a vertex at r from its body's center on one plane of a floor, with that body's motion so far and its
// step.
template <class T>
DIFFVBD_FN FrictionLine friction_line(const RigidInputs<T>& in, const rigid::Body<T>& b, int32_t v, int plane,
                                      const Vector& r, const double* motion, const double* step) {
  const FloorFriction a = floor_friction(in, b, v, plane, moved_by(motion, r));
  const Vector displacement = moved_by(step, r);
  return {a.tangential, displacement - dot(a.n, displacement) * a.n, a.size, in.friction_eps};
}

// The fraction of a step after which the slope of the potential is small or negative. decrease: twice the decrease of
// the linear model along the step; excess(fraction): the sum over all lines.
template <class Excess>
DIFFVBD_FN double friction_fraction(double decrease, const Excess& excess) {
  if (!(kOvershoot * decrease < excess(1.0))) return 1;
  double low = 0, high = 1;
  for (int i = 0; i < kHalvings; ++i) {
    const double middle = 0.5 * (low + high), slope = excess(middle) - decrease * (1 - middle);
    if (absolute(slope) <= kOvershoot * decrease) return middle;
    (slope < 0 ? low : high) = middle;
  }
  return high;
}

// State of a system: iterating, at the settled motion but without its matrix there, and done.
enum Settling : uint8_t { kIterating, kSettledAt, kDone };

// The fraction of a step. decrease, whole: twice the potential of the step and of the motion after it.
template <class Fraction>
DIFFVBD_FN double settle(Settling& state, bool has_friction, double decrease, double whole, const Fraction& fraction) {
  if (!has_friction || state == kSettledAt) {
    state = kDone;
    return 1;
  }
  if (decrease <= kSettled * kSettled * whole) {
    state = kSettledAt;
    return 1;
  }
  return fraction(decrease);
}

// --- trial fractions of the rigid motions: reduced until no body is blocked and the potential does not increase.
// Bodies decide together with those that they may touch, and with no others.

constexpr int kTrials = 6;           // of motions, each reduced for some bodies
constexpr int kShorter = 3;          // of these: reductions of a blocked body before it stays
constexpr int kSpreads = 4;          // how often a reduction spreads to touching bodies
constexpr double kIncrease = 1e-12;  // of the potential: counts as no increase
constexpr double kRounded = 1e-6;    // of a length, that rounding cannot reach

// The body that a pair counts for: the first of those that it moves with, or -1.
template <class T>
DIFFVBD_FN int32_t owner_of(const RigidInputs<T>& in, const int32_t* record) {
  const int32_t first = moving_body(in, record[0]);
  return 0 <= first ? first : moving_body(in, record[sides(record[4])]);
}

// Whether the energies of a vertex admit its trial.
template <class T>
DIFFVBD_FN bool admitted(const RigidInputs<T>& in, const rigid::Body<T>& b, int32_t v) {
  const VertexState<double> s = b.state(v, CornerPoints<T>{in, true}.relative(b.scene, v));
  bool out = true;
  b.energies(v, [&](auto energy, int, const double* data, int count) {
    using E = decltype(energy);
    if constexpr (E::has_filter)
      out = out && E::template admits<T>(s, b.position(v), data, count, rigid::kLeastGapFraction);
  });
  return out;
}

// Bounds for any fraction of the motion of a vertex's body: its displacement since gaps were taken, and the size of its
// position, the scale of rounding.
struct Farthest {
  double displacement, size;
};
template <class T>
DIFFVBD_FN Farthest farthest_of(const RigidInputs<T>& in, const rigid::Body<T>& b, int32_t v, const double* center,
                                const double* motion) {
  const Vector x = b.position(v), arm = x - wide_at(center);
  const Vector since = x - wide_at(in.gate.center + 3 * b.row(v));
  const Vector turn = wide_at(motion), shift = wide_at(motion + 3);
  const auto length = [](const Vector& a) { return square_root(dot(a, a)); };
  const Vec3<T> at = vector_at(in.gate.x + 3 * b.row(v));
  const Vec3<T> from = in.gate.origin ? vector_at(in.gate.origin + 3 * b.row(v)) : zero3<T>();
  const double displacement = length(since) + length(shift) + length(turn) * length(arm);
  return {(1 + kRounded) * displacement, size_of(at + from)};
}

// Whether a listed pair may come within reach of its barrier for any fractions: a gap shrinks by no more than its sides
// have moved. displacement, size [bodies]: the largest of their vertices.
template <class T>
DIFFVBD_FN bool may_touch(const RigidInputs<T>& in, int64_t pair, const double* displacement, const double* size) {
  if (!is_between(in, pair)) return false;
  const int32_t* record = in.gate.listed.pairs + kPairRow * pair;
  const T* constants = in.gate.constants + kConstants * pair;
  const int32_t a = in.gate.body[record[0]], b = in.gate.body[record[sides(record[4])]];
  if (a >= in.bodies() || b >= in.bodies()) return true;  // its gap may be older
  const double gap = PairHints<T>(constants).gap - PairConstants<T>(constants).dhat;
  const T larger = static_cast<T>(size[a] < size[b] ? size[b] : size[a]);
  return !(displacement[a] + displacement[b] < (1 - kRounded) * (gap - guard_of_size(larger)));  // as stays_far()
}

// Whether a trial is accepted: all bodies fit, and their potential does not increase.
DIFFVBD_FN bool is_safe(double before, double after, bool fits) {
  return fits && after <= before + kIncrease * absolute(before);
}
// The factor of the next trial of a body, before reductions spread.
DIFFVBD_FN double shortened(bool blocked, bool fits, int attempt) {
  if (fits) return 0.5;  // the potential increases: all are halved
  if (!blocked) return 1.0;
  return attempt == 0 ? 0.5 : attempt < kShorter ? 0.25 : 0.0;
}

// The result of the trials, of each body [B, bodies].
template <class T>
struct RigidOutcome {
  double* fraction;  // of its motion
  bool* moved;       // whether it has a motion
  // whether it was blocked, in a scene in which some blocked bodies have moved: others may move on now
  bool* blocked;
  T* left;  // the rest of its shift [m]
};
// Ends the trials of a body; returns whether it was blocked after a part of its motion.
template <class T>
DIFFVBD_FN bool finish_trials(const RigidInputs<T>& in, const double* motions, int64_t unit,
                              const RigidOutcome<T>& out) {
  const double* motion = motions + kUnknowns * unit;
  bool moved = false;
  for (int i = 0; i < kUnknowns; ++i) moved = moved || motion[i] != 0;
  double& fraction = out.fraction[unit];
  if (in.moving && !moved) fraction = 0;  // it passes no adjoint on
  const Vector shift = wide_at(motion + 3);
  out.moved[unit] = moved, out.blocked[unit] = moved && fraction < 1;
  out.left[unit] = T((1 - fraction) * square_root(dot(shift, shift)));
  return out.blocked[unit] && 0 < fraction;
}

}  // namespace diffvbd::contact
