// Groups of bodies whose rigid motions are solved for together (docs/method.md, section 18): those that touch, unless
// they are too many: then each of them is left alone. Scenes of few bodies are one group.
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
constexpr int64_t kGroupMemory = 32 << 10;  // bodies of a scene times those of a group at most: room for matrices
constexpr int kGroupRows = 4;               // member, first, rank and count
constexpr int32_t kLeft = -1;               // as the count of a group: a body of too many that touch

// Bodies of a group at most.
DIFFVBD_FN int64_t most_grouped(int64_t bodies) {
  if (bodies == 0) return 0;
  const int64_t most = kGroupMemory / bodies < kMostCoupled ? kGroupMemory / bodies : kMostCoupled;
  return most < 1 ? 1 : most < bodies ? most : bodies;
}

// Those of a scene. Bodies have places, those of a group in a row: of no more than kFew in the order of their numbers,
// else in that of their elimination, if they are solved for.
struct Groups {
  int32_t bodies;
  int64_t room;  // bodies of a group that the memory of its matrix has room for: none is solved for that has more
  const int32_t* rows;  // [4, bodies], or null: all are one group

  DIFFVBD_FN int32_t member(int32_t place) const { return rows ? rows[place] : place; }
  DIFFVBD_FN int32_t first(int32_t body) const { return rows ? rows[bodies + body] : 0; }
  DIFFVBD_FN int32_t rank(int32_t body) const { return rows ? rows[2 * bodies + body] : body; }
  // Of the group that begins at a place, or 0.
  DIFFVBD_FN int32_t count(int32_t place) const {
    if (!rows) return place == 0 ? bodies : 0;
    return is_left(place) ? 1 : rows[3 * bodies + place];
  }
  // Whether the body there is alone because those that touch are too many.
  DIFFVBD_FN bool is_left(int32_t place) const { return rows && rows[3 * bodies + place] == kLeft; }
  DIFFVBD_FN bool joined(int32_t a, int32_t b) const { return first(a) == first(b); }
  // Where in the memory of its scene the matrix of the group is that begins at a place.
  DIFFVBD_FN int64_t matrix(int32_t place) const { return rows ? kUnknowns * kUnknowns * room * place : 0; }
};

// The rigid correction of bodies that touch (docs/method.md, section 18): what vertices and pairs add to the gradient
// and the matrix of the step's potential over a turn and a shift of every body, and which share of the Newton step each
// body may take. In double, whatever the dtype of the scene.

using rigid::Vector;

constexpr double kLeastInertia = 1e-11;  // of a body's mass and sum of m r^2, that keeps its system definite

template <class T>
struct RigidInputs {
  rigid::Inputs<T> scene;  // x, x_prev, y, mass, energies, and the vertices of all bodies
  AdvanceInputs<T> gate;   // pairs that repel, rooms; `move` is what is tried
  PairList lagged;
  const T* lag;                       // [pairs, 9] or null
  const T* collider_prev;             // [B, Vc, 3]
  Batched<const T> kappa, floor_lag;  // floor_lag [1 | B, V, planes, 4]
  const bool* free;                   // [bodies]: nothing of it is pinned
  const int32_t* groups;              // [B, 4, bodies], or null where they do not matter or all are one
  int64_t room;                       // bodies of a group that the memory of its matrix has room for
  const bool* moving;                 // [B, bodies]: those that do, or null, if all do
  int32_t planes;
  double friction_eps;
  bool has_friction;

  DIFFVBD_FN int32_t bodies() const { return scene.bodies; }
  // Lists are of all scenes, but what a scene does must not depend on others.
  DIFFVBD_FN bool rubs(int64_t s) const {
    return has_friction && (planes > 0 || first_lagged(s) < first_lagged(s + 1));
  }
  // Whether all bodies of a scene are one group.
  DIFFVBD_FN bool together() const { return scene.bodies <= kFew; }
  DIFFVBD_FN Groups groups_of(int64_t s) const {
    return {scene.bodies, room, groups ? groups + kGroupRows * scene.bodies * s : nullptr};
  }
  // Whether the group that begins at a place moves: one of it is to, and there is room for its matrix.
  DIFFVBD_FN bool moves(int64_t s, const Groups& g, int32_t place) const {
    const int32_t count = g.count(place);
    bool any = !moving;
    for (int32_t i = 0; i < count && !any; ++i) any = moving[s * scene.bodies + g.member(place + i)];
    return any && count <= room;
  }
  // Scalars of the matrices of a scene.
  DIFFVBD_FN int64_t matrix_size() const { return kUnknowns * kUnknowns * scene.bodies * room; }
  DIFFVBD_FN int64_t first_listed(int64_t s) const { return gate.listed.ptr[s * gate.corners] / 4; }
  DIFFVBD_FN int64_t first_lagged(int64_t s) const { return lag ? lagged.ptr[s * gate.corners] / 4 : 0; }
};

// Of a scene of few, which is one group: the bodies that are to move, and those that touch them, by way of others or
// not. touching [n, n]: of two, either way.
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

// Whether a listed pair has a say in rigid motions: a body's own keep their distance.
template <class T>
DIFFVBD_FN bool is_between(const RigidInputs<T>& in, int64_t pair) {
  const int32_t* record = in.gate.listed.pairs + kPairRow * pair;
  return in.gate.body[record[0]] != in.gate.body[record[sides(record[4])]];
}

// Where corner points are: of the mesh at x, or where they would go.
template <class T>
struct CornerPoints {
  const RigidInputs<T>& in;
  bool moved;
  DIFFVBD_FN Vector relative(int64_t scene, int32_t v) const {  // to origin
    if (v >= in.gate.vertices) {
      return rigid::Body<T>::at(in.gate.collider +
                                3 * (scene * (in.gate.corners - in.gate.vertices) + v - in.gate.vertices));
    }
    const int64_t row = 3 * (scene * in.gate.vertices + v);
    const Vector x = rigid::Body<T>::at(in.scene.x + row);
    return moved ? x + rigid::Body<T>::at(in.gate.move + row) : x;
  }
  DIFFVBD_FN Vector operator()(int64_t scene, int32_t v) const {
    const Vector x = relative(scene, v);
    if (v >= in.gate.vertices || !in.scene.origin.data) return x;
    return x + rigid::Body<T>::at(in.scene.origin.data + scene * in.scene.origin.scene + 3 * int64_t{v});
  }
};

// How far a point at r from the center goes by a motion, to the first order.
DIFFVBD_FN Vector moved_by(const double* motion, const Vector& r) {
  return cross(Vector{motion[0], motion[1], motion[2]}, r) + Vector{motion[3], motion[4], motion[5]};
}

// What one pair adds: gradient and its derivative by the motion of the first side relative to the second, and what the
// mollifier adds at corners. Moments are about the origin of x.
struct PairPress {
  int32_t body[2];  // what moves on either side, or -1; a pair within one body has it on the first
  Vector force;
  Sym3<double> stiffness;
  double weight[2];
  Vector at[2], pull[2], torque[2];
  double value;
  Vector slip;     // where friction is linear about
  double rubs;     // h^2 times its load [N], over `doubled`
  double doubled;  // 2 where sides are not of one group: each takes twice its body's motion; else 1

  // Of one of two sides. Chosen by comparison: an index that is not known when this is compiled would move the arrays
  // from registers to memory.
  static DIFFVBD_FN double of(int side, const double (&a)[2]) { return side == 0 ? a[0] : a[1]; }
  static DIFFVBD_FN Vector of(int side, const Vector (&a)[2]) {
    return {side == 0 ? a[0].x : a[1].x, side == 0 ? a[0].y : a[1].y, side == 0 ? a[0].z : a[1].z};
  }
  DIFFVBD_FN Vector arm(int side, const Vector& center) const { return of(side, at) - of(side, weight) * center; }
  // What the body of a side does to the pair by its k-th unknown, about its center.
  DIFFVBD_FN Vector map(int side, int k, const Vector& center) const {
    const Vector e = {double(k % 3 == 0), double(k % 3 == 1), double(k % 3 == 2)};
    return k < 3 ? cross(e, arm(side, center)) : of(side, weight) * e;
  }
  // And by all of its unknowns.
  DIFFVBD_FN Vector moved(int side, const Vector& center, const double* motion) const {
    const Vector turn = {motion[0], motion[1], motion[2]}, shift = {motion[3], motion[4], motion[5]};
    return cross(turn, arm(side, center)) + of(side, weight) * shift;
  }
  DIFFVBD_FN double gradient(int side, int k, const Vector& center) const {
    const Vector by_shift = of(side, pull), own = k < 3 ? of(side, torque) - cross(center, by_shift) : by_shift;
    return dot(map(side, k, center), force) + (k % 3 == 0 ? own.x : k % 3 == 1 ? own.y : own.z);
  }
};
constexpr int kPressDoubles = 29;  // of a PairPress without its bodies, its value and its friction

DIFFVBD_FN void store_press(const PairPress& a, double* to) {
  int i = 0;
  const auto put = [&](const Vector& v) { to[i] = v.x, to[i + 1] = v.y, to[i + 2] = v.z, i += 3; };
  put(a.force);
  const Sym3<double>& s = a.stiffness;
  const double entries[] = {s.xx, s.xy, s.xz, s.yy, s.yz, s.zz, a.weight[0], a.weight[1]};
  for (const double entry : entries) to[i++] = entry;
  for (int side = 0; side < 2; ++side) put(a.at[side]), put(a.pull[side]), put(a.torque[side]);
}
DIFFVBD_FN PairPress load_press(const double* from, const int32_t* body) {
  PairPress a;
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
DIFFVBD_FN bool is_apart(const RigidInputs<T>& in, int64_t scene, const PairPress& a) {
  return a.body[0] >= 0 && a.body[1] >= 0 && !in.groups_of(scene).joined(a.body[0], a.body[1]);
}
// Then each bears what both would: so that no step is too long.
template <class T>
DIFFVBD_FN double borne(const RigidInputs<T>& in, int64_t scene, const PairPress& a) {
  return is_apart(in, scene, a) ? 2 : 1;
}

template <class T>
DIFFVBD_FN void sides_of(const RigidInputs<T>& in, const int32_t* record, PairPress& out) {
  out.body[0] = moving_body(in, record[0]);
  out.body[1] = moving_body(in, record[sides(record[4])]);
  for (int side = 0; side < 2; ++side) {
    out.weight[side] = 0;
    out.at[side] = out.pull[side] = out.torque[side] = Vector{};
  }
  out.rubs = 0;
}

// Calls f(side, k) for the corners of a pair, of which the first side has so many; as each_across().
template <class F>
DIFFVBD_FN void each_corner(int first, const F& f) {
  for (int side = 0; side < 2; ++side) {
    for (int k = 0; k < 4; ++k) {
      if ((k < first) == (side == 0)) f(side, k);
    }
  }
}

// The barrier of a listed pair between bodies; false where it does not push, or moves with one body.
template <class T, class At>
DIFFVBD_FN bool barrier_press(const RigidInputs<T>& in, int64_t pair, const At& at, PairPress& out) {
  const int32_t* record = in.gate.listed.pairs + kPairRow * pair;
  const T* constants = in.gate.constants + kConstants * pair;
  const int64_t scene = record[5];
  const int first = sides(record[4]);
  const double listed = PairHints<T>(constants).gap, dhat = PairConstants<T>(constants).dhat;
  if (listed == std::numeric_limits<double>::infinity() || !is_between(in, pair)) return false;  // contact/narrow.h
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
    const Vector d = relative[k] - rigid::Body<T>::at(in.gate.center + 3 * (scene * in.gate.vertices + record[k]));
    one = k < first && one < dot(d, d) ? dot(d, d) : one;
    other = k >= first && other < dot(d, d) ? dot(d, d) : other;
  }
  if (known) {
    const double room = (listed - dhat) * (1 - 1e-6);
    if (0 < room && one < 0.25 * room * room && other < 0.25 * room * room) return false;
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
  double e = 1;
  Mollifier<double> m{};
  const bool mollified = is_mollified(record[4], c, a.threshold);
  if (mollified) m = mollifier(c, a.threshold), e = m.e;
  out.value = e * b.value;
  out.force = (e * b.first) * near.n;
  out.stiffness = Sym3<double>{};
  add_outer(out.stiffness, e * b.second, near.n);
  each_corner(first, [&](int side, int k) {
    if (out.body[side] < 0) return;
    out.weight[side] += near.w[k];
    out.at[side] += near.w[k] * relative[k];
    if (!mollified) return;
    const Vector pull = b.value * m.gradient[k];
    out.pull[side] += pull;
    out.torque[side] += cross(relative[k], pull);
  });
  return true;
}

// f0 of smoothed friction, whose slope over |u| is FrictionRate.
DIFFVBD_FN double slip_value(double length, double eps) {
  return length < eps ? length * length * (1 / eps - length / (3 * eps * eps)) + eps / 3 : length;
}

// Gradient and block of what acts on a vertex alone, at where it is, without friction.
template <class T>
DIFFVBD_FN void vertex_press(const RigidInputs<T>& in, const rigid::Body<T>& b, int32_t v, Vector& g, Sym3<double>& H) {
  const double mass = b.mass(v);
  const Vector x = b.position(v);
  const VertexState<double> s = b.state(v, x);
  g = mass * (x - b.target(v));
  H = diagonal(mass);
  b.energies(v,
             [&](auto energy, int, const double* data, int count) { decltype(energy)::block(s, data, count, g, H); });
}

// Friction of a vertex on one plane of a floor.
struct FloorSlip {
  Vector n, slip;  // since the start of the step
  double size;     // h^2 times the load [N]
};
template <class T>
DIFFVBD_FN const T* floor_lag(const RigidInputs<T>& in, const rigid::Body<T>& b, int32_t v, int plane) {
  return in.floor_lag.data + b.scene * in.floor_lag.scene + (int64_t{v} * in.planes + plane) * 4;
}
// Whether a plane bears a vertex: most planes do not, and where there is no load there is no friction.
template <class T>
DIFFVBD_FN bool bears(const RigidInputs<T>& in, const rigid::Body<T>& b, int32_t v, int plane) {
  return *floor_lag(in, b, v, plane) != T(0);
}
template <class T>
DIFFVBD_FN FloorSlip floor_slip(const RigidInputs<T>& in, const rigid::Body<T>& b, int32_t v, int plane,
                                const Vector& moved) {
  const T* lag = floor_lag(in, b, v, plane);
  const Vector n = rigid::Body<T>::at(lag + 1), x = b.position(v), travel = x - b.state(v, x).x_prev + moved;
  const double h = in.scene.time_step;
  return {n, travel - dot(n, travel) * n, h * h * double(lag[0])};
}

// Adds that of a plane, linear about where the vertex would be after `way`.
template <class T>
DIFFVBD_FN void add_floor_slip(const RigidInputs<T>& in, const rigid::Body<T>& b, int32_t v, int plane,
                               const Vector& way, Vector& g, Sym3<double>& H) {
  const FloorSlip a = floor_slip(in, b, v, plane, way);
  const FrictionRate<double> f(square_root(dot(a.slip, a.slip)), in.friction_eps);
  const Vector along = way - dot(a.n, way) * a.n;
  g += a.size * (f.value * (a.slip - along) - (f.curvature * dot(a.slip, along)) * a.slip);
  add_diagonal(H, a.size * f.value);
  add_outer(H, -a.size * f.value, a.n);
  add_outer(H, a.size * f.curvature, a.slip);
}
// And of all.
template <class T>
DIFFVBD_FN void add_floor_friction(const RigidInputs<T>& in, const rigid::Body<T>& b, int32_t v, const Vector& way,
                                   Vector& g, Sym3<double>& H) {
  for (int k = 0; k < in.planes; ++k) {
    if (bears(in, b, v, k)) add_floor_slip(in, b, v, k, way, g, H);
  }
}

// How many roundings of its position a vertex may come away from its target before its potential has risen. In flight
// the potential is nothing but such roundings.
constexpr double kValueUlps = 8;

// The potential of a vertex where it is, or where it would go, less what rounding may have added on the way.
template <class T>
DIFFVBD_FN double vertex_value(const RigidInputs<T>& in, const rigid::Body<T>& b, int32_t v, bool moved) {
  const Vector x = CornerPoints<T>{in, moved}.relative(b.scene, v), off = x - b.target(v);
  const VertexState<double> s = b.state(v, x);
  double value = 0.5 * b.mass(v) * dot(off, off);
  b.energies(
      v, [&](auto energy, int, const double* data, int count) { value += decltype(energy)::value(s, data, count); });
  for (int k = 0; k < in.planes; ++k) {
    if (!bears(in, b, v, k)) continue;
    const FloorSlip a = floor_slip(in, b, v, k, x - b.position(v));
    value += a.size * slip_value(square_root(dot(a.slip, a.slip)), in.friction_eps);
  }
  const double rounding = kValueUlps * std::numeric_limits<T>::epsilon() * size_of(x);
  return moved ? value - b.mass(v) * rounding * rounding : value;
}

// How far a turn and a shift take a point at r from the center.
DIFFVBD_FN Vector displaced(const double* motion, double share, const Vector& r) {
  const Vector w = share * Vector{motion[0], motion[1], motion[2]}, turned = cross(w, r);
  const rigid::Angles s(w);
  return s.a * turned + s.b * cross(w, turned) + share * Vector{motion[3], motion[4], motion[5]};
}

// The Newton step of a body, where `solution` is of its gradient; none where a matrix was not positive definite.
DIFFVBD_FN void keep_finite(double* solution) {
  bool finite = true;
  for (int i = 0; i < kUnknowns; ++i)
    finite = finite && absolute(solution[i]) < std::numeric_limits<double>::infinity();
  for (int i = 0; i < kUnknowns; ++i) solution[i] = finite ? -solution[i] : 0.0;
}

// What lagged friction and damping of pairs add to the rigid correction (docs/method.md, section 18).

// Where a corner point was at the start of the step, relative to origin.
template <class T>
DIFFVBD_FN Vector before(const RigidInputs<T>& in, int64_t scene, int32_t v) {
  const int32_t mesh = in.gate.vertices;
  return rigid::Body<T>::at(v < mesh ? in.scene.x_prev.data + scene * in.scene.x_prev.scene + 3 * int64_t{v}
                                     : in.collider_prev + 3 * (scene * (in.gate.corners - mesh) + v - mesh));
}

// Motions of all bodies of a scene, about which friction is linear; about none where they are null.
struct Slid {
  const double *center, *motion;  // [bodies, 3], [bodies, 6]
};

// What the sides of a pair that rubs do by such motions, one relative to the other.
DIFFVBD_FN Vector way_of(const PairPress& a, const Slid& slid) {
  Vector way{};
  for (int side = 0; side < 2; ++side) {
    const int32_t body = a.body[side];
    if (body < 0) continue;
    way += a.doubled * a.moved(side, rigid::Body<double>::at(slid.center + 3 * body), slid.motion + kUnknowns * body);
  }
  return way;
}

// Of lagged friction and damping what does not depend on how bodies go.
struct Rubbing {
  Vector n, u;                     // u: slip since the start of the step
  double size, damping, approach;  // h^2 times the load [N]; h times the coefficient; how much closer sides have come
};

// The sides of a lagged pair, and what it does there; false where it does nothing. It acts along a gap, so that it
// turns a body even by itself. Where sides are not of one group, `alone` says which is meant. It has half of the
// potential, at twice its motion: the potential is convex, so that what lowers both halves lowers the whole. -1: both
// are.
template <class T, class At>
DIFFVBD_FN bool lagged_sides(const RigidInputs<T>& in, int64_t pair, const At& at, int alone, PairPress& out,
                             Rubbing& rubbing) {
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
  rubbing.n = {double(lag.n.x), double(lag.n.y), double(lag.n.z)};
  const double h = in.scene.time_step, along = dot(rubbing.n, m);
  rubbing.u = m - along * rubbing.n;
  rubbing.size = h * h * double(lag.friction), rubbing.damping = h * double(lag.damping);
  rubbing.approach = along < 0 ? along : 0;
  return true;
}

// What it presses. The gradient is that of a matrix which holds where bodies have gone, by `way`: there both are exact.
DIFFVBD_FN void rub(const Rubbing& a, const Vector& way, double eps, PairPress& out) {
  out.slip = a.u + (way - dot(a.n, way) * a.n);
  const double length = square_root(dot(out.slip, out.slip));
  const FrictionRate<double> f(length, eps);
  out.rubs = a.size / out.doubled;
  out.value = a.size * slip_value(length, eps) + 0.5 * a.damping * a.approach * a.approach;
  out.force = a.size * (f.value * a.u - (f.curvature * dot(out.slip, way)) * out.slip) + (a.damping * a.approach) * a.n;
  const double borne = out.doubled;
  out.stiffness = diagonal(borne * a.size * f.value);
  add_outer(out.stiffness, borne * (a.damping - a.size * f.value), a.n);
  add_outer(out.stiffness, borne * a.size * f.curvature, out.slip);
}

// Both, where bodies have gone as `slid` says.
template <class T, class At>
DIFFVBD_FN bool lagged_press(const RigidInputs<T>& in, int64_t pair, const At& at, const Slid& slid, PairPress& out,
                             int alone) {
  Rubbing rubbing;
  if (!lagged_sides(in, pair, at, alone, out, rubbing)) return false;
  rub(rubbing, slid.motion ? way_of(out, slid) : Vector{}, in.friction_eps, out);
  return true;
}

// Friction in the rigid correction of bodies that touch (docs/method.md, section 18): all but friction is linear in the
// motions of bodies, friction is taken as it is. Newton's method finds where they come to rest, with shorter steps
// where a full one would take a slip past that.

constexpr int kSlipIterations = 200;  // of Newton's method at most: mostly it settles within 10 to 30
constexpr int kHalvings = 40;         // in the search for the length of a step, at most: down to eps over a long way
constexpr double kOvershoot = 0.1;    // slope at the end of a step over that at its start, that is small
constexpr double kSettled = 1e-9;     // of the whole, a step after which there is but one more

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

// A slip u along a step c of Newton's method, as far as friction depends on it.
struct SlipLine {
  double start, along, way;  // u u, u c and c c
  double size, rate, bend;   // what the step takes friction for: f1(|u|) / |u| at its start, and its derivative

  SlipLine() = default;
  DIFFVBD_FN SlipLine(const Vector& slip, const Vector& change, double load, double eps)
      : start(dot(slip, slip)), along(dot(slip, change)), way(dot(change, change)), size(load) {
    const FrictionRate<double> first(square_root(start), eps);
    rate = first.value, bend = first.curvature * along;
  }

  // The slope of the potential after a share of the step, over what that takes it for.
  DIFFVBD_FN double excess(double share, double eps) const {
    const double toward = along + share * way, square = start + share * (along + toward);
    return size * ((friction_rate(square, eps) - rate) * toward - share * bend * along);
  }
};

// Of a lagged pair that rubs, and its press.
template <class T>
DIFFVBD_FN SlipLine slip_line(const RigidInputs<T>& in, int64_t pair, const PairPress& a, const double* center,
                              const double* step) {
  const Lag<T> lag(in.lag + kLagScalars * pair);
  const Vector n = {double(lag.n.x), double(lag.n.y), double(lag.n.z)};
  const Vector way = way_of(a, {center, step});
  return {a.slip, way - dot(n, way) * n, a.rubs, in.friction_eps};
}

// Of a vertex at r from its body's center on one plane of a floor, with that body's motion so far and its step.
template <class T>
DIFFVBD_FN SlipLine slip_line(const RigidInputs<T>& in, const rigid::Body<T>& b, int32_t v, int plane, const Vector& r,
                              const double* motion, const double* step) {
  const FloorSlip a = floor_slip(in, b, v, plane, moved_by(motion, r));
  const Vector way = moved_by(step, r);
  return {a.slip, way - dot(a.n, way) * a.n, a.size, in.friction_eps};
}

// The share of a step that is taken, after which the slope of the potential is small or negative. fall: twice by how
// much the step lowers what it takes the potential for; `excess` of a share: that of all that slips.
template <class Excess>
DIFFVBD_FN double slip_share(double fall, const Excess& excess) {
  if (!(kOvershoot * fall < excess(1.0))) return 1;
  double low = 0, high = 1;
  for (int i = 0; i < kHalvings; ++i) {
    const double middle = 0.5 * (low + high), slope = excess(middle) - fall * (1 - middle);
    if (absolute(slope) <= kOvershoot * fall) return middle;
    (slope < 0 ? low : high) = middle;
  }
  return high;
}

// Where Newton's method is with a system: on its way, at the motion it has settled at but not with the matrix there,
// and done.
enum Settling : uint8_t { kOnItsWay, kSettledAt, kDone };

// The share of a step that is taken. fall, whole: twice what the step and the motion after it are worth in potential.
template <class Share>
DIFFVBD_FN double settle(Settling& state, bool rubs, double fall, double whole, const Share& share) {
  if (!rubs || state == kSettledAt) {
    state = kDone;
    return 1;
  }
  if (fall <= kSettled * kSettled * whole) {
    state = kSettledAt;
    return 1;
  }
  return share(fall);
}

// Which share of its rigid motion each body may take: it is tried, and tried again shorter, until nothing holds it up
// and the potential does not rise. Bodies decide this with those that they may come to press, and with no others
// (docs/method.md, section 18).

constexpr int kTries = 6;       // of motions, each shorter for some bodies, or none for them
constexpr int kShorter = 3;     // of these: how often a body whose way is blocked tries a shorter one before it stays
constexpr int kSpreads = 4;     // how often a shorter motion is handed on to the bodies that one touches
constexpr double kRise = 1e-9;  // of the potential, that counts as none
constexpr double kRounded = 1e-6;  // of a length, that rounding cannot reach

// The body that a pair counts for, which decides with all others that it moves: the first of them, or -1.
template <class T>
DIFFVBD_FN int32_t owner_of(const RigidInputs<T>& in, const int32_t* record) {
  const int32_t first = moving_body(in, record[0]);
  return 0 <= first ? first : moving_body(in, record[sides(record[4])]);
}

// Whether the energies of a vertex admit what it tries.
template <class T>
DIFFVBD_FN bool admitted(const RigidInputs<T>& in, const rigid::Body<T>& b, int32_t v) {
  const VertexState<double> s = b.state(v, CornerPoints<T>{in, true}.relative(b.scene, v));
  bool out = true;
  b.energies(v, [&](auto energy, int, const double* data, int count) {
    using E = decltype(energy);
    if constexpr (E::has_filter) out = out && E::template admits<T>(s, b.position(v), data, count, rigid::kLeastShare);
  });
  return out;
}

// Of a vertex, whatever share of its motion its body takes: how far it may be from where gaps were taken, and the size
// of its position, which rounding is measured by.
struct Farthest {
  double way, size;
};
template <class T>
DIFFVBD_FN Farthest farthest_of(const RigidInputs<T>& in, const rigid::Body<T>& b, int32_t v, const double* center,
                                const double* motion) {
  const Vector x = b.position(v), arm = x - rigid::Body<double>::at(center);
  const Vector since = x - rigid::Body<T>::at(in.gate.center + 3 * b.row(v));
  const Vector turn = rigid::Body<double>::at(motion), shift = rigid::Body<double>::at(motion + 3);
  const auto length = [](const Vector& a) { return square_root(dot(a, a)); };
  const Vec3<T> at = point_at(in.gate.x, b.row(v));
  const Vec3<T> from = in.gate.origin ? point_at(in.gate.origin, b.row(v)) : zero3<T>();
  const double way = length(since) + length(shift) + length(turn) * length(arm);
  return {(1 + kRounded) * way, size_of(at + from)};
}

// Whether a listed pair may come within reach of its barrier, whatever share of its motion each body takes: a gap
// shrinks by no more than its sides have moved since it was taken. way, size [bodies]: the farthest of their vertices.
template <class T>
DIFFVBD_FN bool may_press(const RigidInputs<T>& in, int64_t pair, const double* way, const double* size) {
  if (!is_between(in, pair)) return false;
  const int32_t* record = in.gate.listed.pairs + kPairRow * pair;
  const T* constants = in.gate.constants + kConstants * pair;
  const int32_t a = in.gate.body[record[0]], b = in.gate.body[record[sides(record[4])]];
  if (a >= in.bodies() || b >= in.bodies()) return true;  // its gap is not of the time of the centers
  const double gap = PairHints<T>(constants).gap - PairConstants<T>(constants).dhat;
  const T larger = static_cast<T>(size[a] < size[b] ? size[b] : size[a]);
  return !(way[a] + way[b] < (1 - kRounded) * (gap - guard_of_size(larger)));  // as stays_far()
}

// Whether bodies may go as they try: all fit, and their potential does not rise.
DIFFVBD_FN bool is_safe(double before, double after, bool fits) {
  return fits && after <= before + kRise * absolute(before);
}
// The factor of what a body tries next, before it is handed on.
DIFFVBD_FN double shortened(bool blocked, bool fits, int attempt) {
  if (fits) return 0.5;  // the potential rises: all go half as far
  if (!blocked) return 1.0;
  return attempt == 0 ? 0.5 : attempt < kShorter ? 0.25 : 0.0;
}

// What came of the tries, of each body [B, bodies].
template <class T>
struct RigidOutcome {
  double* share;  // of its motion that it took
  bool* moved;    // whether it had one
  // whether it was held up on its way, in a scene in which some of those have gone on: where these are now, others may
  // go on, too
  bool* held;
  T* left;  // how much of its shift it did not take [m]
};
// Of a body whose share is known; returns whether it was held up after some of its way. `held` is to be confirmed.
template <class T>
DIFFVBD_FN bool end_tries(const RigidInputs<T>& in, const double* motions, int64_t unit, const RigidOutcome<T>& out) {
  const double* motion = motions + kUnknowns * unit;
  bool moved = false;
  for (int i = 0; i < kUnknowns; ++i) moved = moved || motion[i] != 0;
  double& share = out.share[unit];
  if (in.moving && !moved) share = 0;  // what stays passes nothing on
  const Vector shift = rigid::Body<double>::at(motion + 3);
  out.moved[unit] = moved, out.held[unit] = moved && share < 1;
  out.left[unit] = T((1 - share) * square_root(dot(shift, shift)));
  return out.held[unit] && 0 < share;
}

}  // namespace diffvbd::contact
