// The adjoint of the rigid correction of bodies that touch (docs/method.md, section 18). Pairs first: the derivatives
// of their part of the virtual work
//
//     W = p . (gradient + matrix q)
//
// of two motions p and q of all corner points by p, q, positions, kappa and the lagged state. A listed pair is derived
// in twelve directions by Dual, once for each correction; a lagged one by hand.
#pragma once

#include "contact_rigid.h"
#include "rigid.h"

namespace diffvbd::contact {

constexpr int kWorkScalars = 9;  // of a corner: derivatives by its position, by p and by q

// Two motions of all corner points [B, N, 3].
template <class T>
struct VirtualMotions {
  const T *p, *q;
};

// Derivatives of the virtual work of all pairs, of lists with so many rows. by_kappa and lag_bar are added to.
template <class T>
struct RigidWork {
  T *barrier, *by_kappa;  // [listed, 4, 9], [listed]
  uint8_t* pushes;        // [listed]: the pairs whose rows are written
  T *friction, *lag_bar;  // [lagged, 4, 9]; [lagged, 9] less the derivatives by what is lagged
  int64_t listed, lagged;
};
// Their sums at all corner points [B, N, 3].
template <class T>
struct PointWork {
  T *x, *p, *q;  // p: without pairs whose corners do not move by p
  T* since;      // of lagged pairs, by displacements since the start of the step, included in `x`; or null
};
constexpr int kPointScalars = kWorkScalars + 3;

template <class T>
DIFFVBD_FN void store_at_point(const double* sum, int64_t point, const PointWork<T>& out) {
  T* const to[] = {out.x, out.p, out.q, out.since};
  for (int k = 0; k < 4; ++k) {
    if (to[k]) put(to[k] + 3 * point, Vector{sum[3 * k], sum[3 * k + 1], sum[3 * k + 2]});
  }
}

// The motions of the corners of a pair by p and q, and which of them move together: all, or each side by itself.
struct PairMotions {
  Vector p[4], q[4];
  int sides, first;  // how many move by themselves; corners of the first
  double fraction;   // of the stiffness that each bears

  DIFFVBD_FN bool is_of(int side, int corner) const { return sides == 1 || (corner < first) == (side == 0); }
};

// Whether a corner of a pair moves by p: else the pair does no virtual work.
template <class T>
DIFFVBD_FN bool works(const RigidInputs<T>& in, const VirtualMotions<T>& given, const int32_t* record) {
  for (int k = 0; k < 4; ++k) {
    const T* p = given.p + 3 * (int64_t{record[5]} * in.gate.corners + record[k]);
    if (p[0] != T(0) || p[1] != T(0) || p[2] != T(0)) return true;
  }
  return false;
}

template <class T>
DIFFVBD_FN PairMotions motions_of(const RigidInputs<T>& in, const VirtualMotions<T>& given, const int32_t* record) {
  PairMotions out;
  for (int k = 0; k < 4; ++k) {
    const int64_t row = 3 * (int64_t{record[5]} * in.gate.corners + record[k]);
    out.p[k] = wide_at(given.p + row), out.q[k] = wide_at(given.q + row);
  }
  out.first = sides(record[4]);
  const int32_t one = moving_body(in, record[0]), two = moving_body(in, record[out.first]);
  const bool apart = in.groups && one >= 0 && two >= 0 && !in.groups_of(record[5]).joined(one, two);
  out.sides = apart ? 2 : 1, out.fraction = apart ? 2 : 1;
  return out;
}

// Gradient and matrix of a listed pair by the motion of its weighted corners, and the part of its weight at corners.
template <class R>
struct ForceTerms {
  Vec3<R> force, n, at_corner[4];
  R w[4], along;  // stiffness along the normal
};

template <class R>
DIFFVBD_FN Vec3<R> weighted(const R* w, const Vector* moved, const PairMotions& m, int side) {
  Vec3<R> out{R(0), R(0), R(0)};
  for (int k = 0; k < 4; ++k) {
    if (m.is_of(side, k)) out = out + Vec3<R>{w[k] * R(moved[k].x), w[k] * R(moved[k].y), w[k] * R(moved[k].z)};
  }
  return out;
}

template <class R>
DIFFVBD_FN R virtual_work(const ForceTerms<R>& a, const PairMotions& m) {
  R out(0);
  for (int k = 0; k < 4; ++k) {
    const Vec3<R> p = {R(m.p[k].x), R(m.p[k].y), R(m.p[k].z)};
    out = out + a.w[k] * dot(a.force, p) + dot(a.at_corner[k], p);
  }
  for (int side = 0; side < m.sides; ++side) {
    const Vec3<R> p = weighted(a.w, m.p, m, side), q = weighted(a.w, m.q, m, side);
    out = out + R(m.fraction) * a.along * dot(a.n, p) * dot(a.n, q);
  }
  return out;
}

// Adds the derivatives by p and q, to each corner's row.
template <class T>
DIFFVBD_FN void add_by_motions(const ForceTerms<double>& a, const PairMotions& m, T* rows) {
  const auto normal_force = [&](const Vector& u) { return (m.fraction * a.along * dot(a.n, u)) * a.n; };
  for (int side = 0; side < m.sides; ++side) {
    const Vector by_p = normal_force(weighted(a.w, m.q, m, side)), by_q = normal_force(weighted(a.w, m.p, m, side));
    for (int k = 0; k < 4; ++k) {
      if (!m.is_of(side, k)) continue;
      put(rows + kWorkScalars * k + 3, a.w[k] * (a.force + by_p) + a.at_corner[k]);
      put(rows + kWorkScalars * k + 6, a.w[k] * by_q);
    }
  }
}

// size: h^2 kappa.
template <class R, class T>
DIFFVBD_FN ForceTerms<R> barrier_terms(int kind, const Corners<R>& c, const PairConstants<T>& a, double size) {
  const Distance<R> near = distance(kind, c);
  const LogBarrier<R> b(near.d - R(a.offset), R(a.dhat), R(size));
  ForceTerms<R> out{};
  const Weight<R> weight = weight_of(kind, c, a, varies(kind, c, near, a));
  for (int k = 0; k < 4; ++k) out.at_corner[k] = b.value * weight.gradient[k];
  out.force = (weight.e * b.first) * near.n, out.n = near.n, out.along = weight.e * b.second;
  for (int k = 0; k < 4; ++k) out.w[k] = near.w[k];
  return out;
}

// Twelve directions that a pair is derived by, one evaluation each, and a part without direction: work items of
// threads.
constexpr int kDirections = 12, kWorkParts = kDirections + 1;

// The work of a listed pair.
template <class T>
struct BarrierWork {
  bool acts;
  PairMotions m;
  Corners<double> c;
  PairConstants<T> a;
  int kind;
  double h2, kappa;

  // known: that it acts
  DIFFVBD_FN BarrierWork(const RigidInputs<T>& in, const VirtualMotions<T>& given, int64_t pair, bool known = false)
      : acts(known || pushes(in, given, pair)),
        m{},
        c{},
        a(in.gate.constants + kConstants * pair),
        kind(0),
        h2(0),
        kappa(0) {
    if (!acts) return;
    const CornerPoints<T> at{in, false};
    const int32_t* record = in.gate.listed.pairs + kPairRow * pair;
    const int64_t scene = record[5];
    m = motions_of(in, given, record), kind = record[4];
    const Vector origin = at(scene, record[0]);
    for (int k = 0; k < 4; ++k) c.x[k] = at(scene, record[k]) - origin;
    h2 = in.scene.time_step * in.scene.time_step, kappa = in.kappa.data[scene * in.kappa.scene];
  }

  DIFFVBD_FN static bool pushes(const RigidInputs<T>& in, const VirtualMotions<T>& given, int64_t pair) {
    PairForce term;
    return pair < in.first_listed(in.scene.scenes) && works(in, given, in.gate.listed.pairs + kPairRow * pair) &&
           barrier_force(in, pair, CornerPoints<T>{in, false}, term);
  }

  // Stores a part of the rows of the corners [4, 9], and adds the derivative by kappa, where the pair acts.
  DIFFVBD_FN void store(int part, T* rows, T* by_kappa) const {
    if (part < kDirections) {
      const int k = part / 3, i = part % 3;
      const Vector z = {double(i == 0), double(i == 1), double(i == 2)};
      const auto terms = barrier_terms(kind, moved_along(c, k, z), a, h2 * kappa);
      rows[kWorkScalars * k + i] = T(virtual_work(terms, m).derivative);
      return;
    }
    *by_kappa += T(virtual_work(barrier_terms(kind, c, a, h2), m));
    add_by_motions(barrier_terms(kind, c, a, h2 * kappa), m, rows);
  }
};

// f1(|u|) / |u| and its derivative over |u|, constant below the rounding of rest.
template <class R>
DIFFVBD_FN FrictionRate<R> friction_rate_of(const Vec3<R>& u, double eps) {
  const R square = dot(u, u);
  const double length = square_root(value_of(square));
  const R known = kRestingMotion * eps < length ? square_root(square) : R(length);
  return FrictionRate<R>(known, R(eps));
}

// The virtual work by P of friction with a load of 1 after a motion Q. d: the motion since the start of the step, of
// which u is tangential to n. Force and stiffness at u, times Q. bend: RigidInputs::friction_bend.
template <class R>
DIFFVBD_FN R friction_work(const Vec3<R>& n, const Vec3<R>& d, const Vec3<R>& P, const Vec3<R>& Q, double eps,
                           double bend) {
  const Vec3<R> u = d - dot(n, d) * n, slip = Q - dot(n, Q) * n;
  const FrictionRate<R> f = friction_rate_of(u, eps);
  return f.value * dot(u + slip, P) + R(bend) * f.curvature * dot(u, P) * dot(u, Q);
}
DIFFVBD_FN Vec3<Dual<double>> dual_of(const Vector& a, int direction) {
  return {{a.x, double(direction == 0)}, {a.y, double(direction == 1)}, {a.z, double(direction == 2)}};
}

// Of a lagged pair. With d how its weighted corners have moved since the start of the step, P and Q how they move by p
// and q, n its normal, A = h damping, L = h^2 normal force,
//
//     W = A min(n . d, 0) n . P + s A (n . P) (n . Q) + L friction_work(n, d, P, s Q),
//
// for each side that moves by itself, where s = 2, else 1. Positions at the start of the step take the derivatives by x
// with the other sign.
template <class T>
struct LaggedWork {
  bool acts;
  PairMotions m;
  Vector since[4], n, d;  // since: how each corner has moved
  double w[4], load, damping, h, eps, bend;

  DIFFVBD_FN LaggedWork(const RigidInputs<T>& in, const VirtualMotions<T>& given, int64_t pair)
      : acts(pair < in.first_lagged(in.scene.scenes)),
        m{},
        d{},
        h(in.scene.time_step),
        eps(in.friction_eps),
        bend(in.friction_bend) {
    if (!acts) return;
    const int32_t* record = in.lagged.pairs + kPairRow * pair;
    // also of pairs without a force: above dhat, or by a coefficient of zero
    acts =
        (moving_body(in, record[0]) >= 0 || moving_body(in, record[sides(record[4])]) >= 0) && works(in, given, record);
    if (!acts) return;
    const CornerPoints<T> at{in, false};
    const Lag<T> lag(in.lag + kLagScalars * pair);
    load = lag.friction, damping = lag.damping;
    m = motions_of(in, given, record);
    // a pair that does nothing joined no bodies; with any coefficient it would
    if (load == 0 && damping == 0) m.sides = 1, m.fraction = 1;
    n = {double(lag.n.x), double(lag.n.y), double(lag.n.z)};
    for (int k = 0; k < 4; ++k) {
      w[k] = lag.w[k];
      since[k] = at.relative(record[5], record[k]) - before(in, record[5], record[k]);
      d += w[k] * since[k];
    }
  }

  template <class R>
  DIFFVBD_FN R work(const Vec3<R>& by_n, const Vec3<R>& by_d, const Vec3<R>& P, const Vec3<R>& Q, double A,
                    double L) const {
    const R along = dot(by_n, by_d), approach = along < R(0) ? along : R(0), fraction = R(m.fraction);
    const R damped = R(A) * (approach + fraction * dot(by_n, Q)) * dot(by_n, P);
    if (L == 0) return damped;
    return damped + R(L) * friction_work(by_n, by_d, P, fraction * Q, eps, bend);
  }

  // Stores the rows of the corners [4, 9], and adds to lag_bar [9].
  DIFFVBD_FN void store(T* rows, T* lag_bar) const {
    const double h2 = h * h;
    double by_load = 0, by_damping = 0, by_w[4] = {0, 0, 0, 0};
    Vector by_n{}, by_d{};
    for (int side = 0; side < m.sides; ++side) {
      const Vector P = weighted(w, m.p, m, side), Q = weighted(w, m.q, m, side);
      by_load += work(n, d, P, Q, 0, h2), by_damping += work(n, d, P, Q, h, 0);
      Vector by[4] = {};  // by n, d, P and Q
      for (int which = 0; (load != 0 || damping != 0) && which < 4; ++which) {
        double* const to[] = {&by[which].x, &by[which].y, &by[which].z};
        for (int i = 0; i < 3; ++i) {
          const auto along = [&](const Vector& a, int k) { return dual_of(a, k == which ? i : -1); };
          *to[i] = work(along(n, 0), along(d, 1), along(P, 2), along(Q, 3), h * damping, h2 * load).derivative;
        }
      }
      by_n += by[0], by_d += by[1];
      for (int k = 0; k < 4; ++k) {
        if (!m.is_of(side, k)) continue;
        put(rows + kWorkScalars * k + 3, w[k] * by[2]);
        put(rows + kWorkScalars * k + 6, w[k] * by[3]);
        by_w[k] += dot(by[2], m.p[k]) + dot(by[3], m.q[k]);
      }
    }
    for (int k = 0; k < 4; ++k) put(rows + kWorkScalars * k, w[k] * by_d);
    lag_bar[0] -= T(by_load), lag_bar[1] -= T(by_damping);
    add_to(lag_bar + 2, -by_n);
    for (int k = 0; k < 4; ++k) lag_bar[5 + k] -= T(by_w[k] + dot(by_d, since[k]));
  }
  DIFFVBD_FN static void store_none(T* rows) {
    for (int i = 0; i < 4 * kWorkScalars; ++i) rows[i] = T(0);
  }
};

// Then the correction itself.
//
// A correction moves vertices by displaced(fraction d, r), with H d = -g. The adjoint of d, l = H^-1 (adjoint of the
// displacement), makes that of everything g and H read the adjoint of -W, where
//
//     W = sum over vertices P . (g_v + H_v Q) + pairs + what keeps H definite,
//
// and P and Q are how a vertex moves by l and by d. docs/method.md, section 18.

// The adjoint of r in displaced(), of an adjoint g of the displacement.
DIFFVBD_FN Vector arm_adjoint(const Vector& w, const rigid::Angles& s, const Vector& g) {
  const Vector turned = cross(w, g);
  return s.b * cross(w, turned) - s.a * turned;
}

// The adjoint of its motion: over all vertices of a body `sum` = sum g, and `turning` = sum g r^T.
DIFFVBD_FN void motion_adjoint(const double* motion, double fraction, const Vector& sum, const rigid::Matrix& turning,
                               double* out) {
  const Vector w = fraction * vector_at(motion);
  const rigid::Matrix turn = rigid::identity() + rigid::turned_by(w);
  const Vector turned = rigid::turn_vjp(w, turning * rigid::transposed(turn));
  const Vector parts[] = {fraction * turned, fraction * sum};
  for (int i = 0; i < 2; ++i) put(out + 3 * i, parts[i]);
}

// Of friction on one plane of a floor, the derivatives of the work by the travel since the start of the step, and by
// what is lagged [4]: load [N] and normal.
DIFFVBD_FN Vector friction_adjoint(const double* lag, const Vector& travel, const Vector& P, const Vector& Q, double h2,
                                   double eps, double bend, double* by_lag) {
  const Vector n = vector_at(lag + 1);
  const auto derived = [&](int direction) {
    return h2 * lag[0] *
           friction_work(dual_of(n, direction - 3), dual_of(travel, direction), dual_of(P, -1), dual_of(Q, -1), eps,
                         bend)
               .derivative;
  };
  by_lag[0] = h2 * friction_work(n, travel, P, Q, eps, bend);
  for (int i = 0; i < 3; ++i) by_lag[1 + i] = derived(3 + i);
  return {derived(0), derived(1), derived(2)};
}

// The adjoint of -W seen from one vertex of a free body at r from its center.
struct VertexAdjoint {
  Vector x, x_prev, y;  // x: without the part of the center of mass
  Vector arm;           // the part of x that goes by r
  double mass;
};

// Adds that of friction on planes. floor_lag: the adjoint of floor_lag at this vertex, which is added to, or null.
template <class T>
DIFFVBD_FN void add_friction_adjoint(const RigidInputs<T>& in, const rigid::Body<T>& b, int32_t v, const Vector& travel,
                                     const Vector& P, const Vector& Q, double h2, T* floor_lag, VertexAdjoint& out) {
  for (int k = 0; k < in.planes; ++k) {
    const T* given = contact::floor_lag(in, b, v, k);
    double lag[kFloorLag], by_lag[kFloorLag];
    for (int i = 0; i < kFloorLag; ++i) lag[i] = given[i];
    const Vector by_travel = friction_adjoint(lag, travel, P, Q, h2, in.friction_eps, in.friction_bend, by_lag);
    out.x -= by_travel, out.x_prev += by_travel;
    for (int i = 0; floor_lag && i < kFloorLag; ++i) floor_lag[kFloorLag * k + i] -= T(by_lag[i]);
  }
}

// by_p, by_q: adjoints of P and Q by pairs. floor_lag: the adjoint of floor_lag at this vertex, which is added to, or
// null.
template <class T>
DIFFVBD_FN VertexAdjoint vertex_adjoint(const RigidInputs<T>& in, const rigid::Body<T>& b, int32_t v, const Vector& r,
                                        const double* p, const double* q, const Vector& by_p, const Vector& by_q,
                                        T* floor_lag) {
  const double mass = b.mass(v), h = in.scene.time_step;
  const Vector P = moved_by(p, r), Q = moved_by(q, r), x = b.position(v);
  const VertexState<double> s = b.state(v, x);
  Vector g;
  Sym3<double> H;
  vertex_force(in, b, v, g, H);
  add_floor_friction(in, b, v, g, H);
  VertexAdjoint out{-mass * P, Vector{}, mass * P, Vector{}, -dot(P, x - b.target(v) + Q)};
  b.energies(v, [&](auto energy, int, const double* data, int count) {
    vertex_energy_vjp<decltype(energy)>(s, data, count, P, Q, out.x, out.x_prev);
  });
  add_friction_adjoint(in, b, v, x - s.x_prev, P, Q, h * h, floor_lag, out);
  const Vector turn_p = {p[0], p[1], p[2]}, turn_q = {q[0], q[1], q[2]};
  const double turns = dot(turn_p, turn_q);
  out.arm = -cross(g + H * Q + by_p, turn_p) - cross(H * P + by_q, turn_q) - (2 * kLeastInertia * turns * mass) * r;
  out.mass -= kLeastInertia * turns * dot(r, r);
  return out;
}

struct Whole {
  double mass;
  Vector center;
};

template <class T, class Team>
DIFFVBD_FN Whole whole_of(const rigid::Body<T>& b, const Team& team) {
  double sum[4];
  team.template sum<4>(b.size(), sum, [&](int32_t i, double* to) {
    const int32_t v = b.vertex(i);
    const double m = b.mass(v);
    const Vector x = b.position(v);
    to[0] += m, to[1] += m * x.x, to[2] += m * x.y, to[3] += m * x.z;
  });
  return {sum[0], 0 < sum[0] ? (1 / sum[0]) * vector_at(sum + 1) : Vector{}};
}

// The adjoint of the center of mass, c_bar, scattered to positions and masses.
template <class T, class Team>
DIFFVBD_FN void scatter_center(const rigid::Body<T>& b, const Team& team, const Whole& whole, const Vector& c_bar, T* x,
                               T* mass) {
  if (!(0 < whole.mass)) return;
  const Vector common = (1 / whole.mass) * c_bar;
  team.each(b.size(), [&](int32_t i) {
    const int32_t v = b.vertex(i);
    add_to(x + 3 * b.row(v), b.mass(v) * common);
    mass[b.row(v)] += T(dot(b.position(v) - whole.center, common));
  });
}

// Of the adjoint of the corrected positions, end_bar [B, V, 3]: the direct adjoints of x and mass, and that of the
// motion. All are written but mass, which is added to.
template <class T, class Team>
DIFFVBD_FN void reverse_end(const rigid::Body<T>& b, const Team& team, const double* motion, double fraction,
                            const T* end_bar, double* motion_bar, T* x, T* mass) {
  if (fraction == 0) {  // it stayed
    team.each(b.size(), [&](int32_t i) {
      const int64_t at = 3 * b.row(b.vertex(i));
      put(x + at, wide_at(end_bar + at));
    });
    for (int i = 0; i < kUnknowns && team.leads(); ++i) motion_bar[i] = 0;
    return;
  }
  const Whole whole = whole_of(b, team);
  const Vector w = fraction * vector_at(motion);
  const rigid::Angles angles(w);
  double sum[15];
  team.template sum<15>(b.size(), sum, [&](int32_t i, double* to) {
    const int32_t v = b.vertex(i);
    const Vector g = wide_at(end_bar + 3 * b.row(v)), r = b.position(v) - whole.center;
    const Vector arm = arm_adjoint(w, angles, g);
    put(x + 3 * b.row(v), g + arm);
    add_to(to, -arm);
    add_to(to + 3, g);
    to[6] += g.x * r.x, to[7] += g.x * r.y, to[8] += g.x * r.z;
    to[9] += g.y * r.x, to[10] += g.y * r.y, to[11] += g.y * r.z;
    to[12] += g.z * r.x, to[13] += g.z * r.y, to[14] += g.z * r.z;
  });
  const rigid::Matrix turning{{sum[6], sum[7], sum[8]}, {sum[9], sum[10], sum[11]}, {sum[12], sum[13], sum[14]}};
  if (team.leads()) motion_adjoint(motion, fraction, vector_at(sum + 3), turning, motion_bar);
  scatter_center(b, team, whole, vector_at(sum), x, mass);
}

// The motions of corner points [B, N, 3] by the solution for that adjoint, and by the motion; those of no body are
// zero. The solution of a body that did not move becomes zero: a matrix that was not positive definite has no adjoint.
template <class T, class Team>
DIFFVBD_FN void virtual_motion(const RigidInputs<T>& in, const rigid::Body<T>& b, const Team& team,
                               const double* motion, double* solution, T* p, T* q) {
  double l[kUnknowns];
  bool moves = in.free[b.body], any = false;
  for (int i = 0; i < kUnknowns; ++i) {
    l[i] = solution[i];
    moves = moves && absolute(l[i]) < std::numeric_limits<double>::infinity();
    any = any || l[i] != 0 || motion[i] != 0;
  }
  if (!any) {
    team.each(b.size(), [&](int32_t i) {
      const int64_t to = 3 * (b.scene * in.gate.corners + b.vertex(i));
      put(p + to, Vector{}), put(q + to, Vector{});
    });
    return;
  }
  for (int i = 0; i < kUnknowns && !moves; ++i) l[i] = 0;
  const Whole whole = whole_of(b, team);  // after which all have read
  for (int i = 0; i < kUnknowns && team.leads(); ++i) solution[i] = l[i];
  team.each(b.size(), [&](int32_t i) {
    const int32_t v = b.vertex(i);
    const int64_t to = 3 * (b.scene * in.gate.corners + v);
    const Vector r = b.position(v) - whole.center;
    put(p + to, moved_by(l, r));
    put(q + to, moved_by(motion, r));
  });
}

// The adjoints of a correction. All are added to, but x, which is written.
template <class T>
struct CorrectionAdjoints {
  rigid::Adjoints<T> vertices;  // of vertices and of data
  T* floor_lag;                 // [B, V, planes, 4], or null
  T *collider, *collider_prev;  // [B, Vc, 3]
};

// Of a body's vertices. displacement [B, V, 3]: the direct adjoint of x. scattered: the adjoints of pairs at corner
// points.
template <class T, class Team>
DIFFVBD_FN void reverse_vertices(const RigidInputs<T>& in, const rigid::Body<T>& b, const Team& team,
                                 const double* motion, const double* solution, const T* displacement,
                                 const PointWork<T>& scattered, const CorrectionAdjoints<T>& bars) {
  const rigid::Adjoints<T>& out = bars.vertices;
  T* floor_lag = bars.floor_lag;
  team.each(b.size(), [&](int32_t i) {
    const int32_t v = b.vertex(i);
    const int64_t row = b.row(v), corner = 3 * (b.scene * in.gate.corners + v);
    put(out.x + 3 * row, wide_at(displacement + 3 * row) - wide_at(scattered.x + corner));
    if (scattered.since) add_to(out.x_prev + 3 * row, wide_at(scattered.since + corner));
  });
  bool moves = false;
  for (int i = 0; i < kUnknowns; ++i) moves = moves || solution[i] != 0;
  if (!moves) return;
  const Whole whole = whole_of(b, team);
  double sum[3];
  team.template sum<3>(b.size(), sum, [&](int32_t i, double* to) {
    const int32_t v = b.vertex(i);
    const int64_t row = b.row(v), corner = 3 * (b.scene * in.gate.corners + v);
    const VertexAdjoint bar =
        vertex_adjoint(in, b, v, b.position(v) - whole.center, solution, motion, wide_at(scattered.p + corner),
                       wide_at(scattered.q + corner), floor_lag ? floor_lag + row * in.planes * kFloorLag : nullptr);
    add_to(out.x + 3 * row, bar.x + bar.arm);
    add_to(out.x_prev + 3 * row, bar.x_prev);
    add_to(out.y + 3 * row, bar.y);
    out.mass[row] += T(bar.mass);
    add_to(to, -bar.arm);
  });
  scatter_center(b, team, whole, vector_at(sum), out.x, out.mass);
  if (!out.shared && !out.own) return;
  rigid::reverse_data(b, team, out, [&](int32_t v) {
    const Vector x = b.position(v), r = x - whole.center;
    return rigid::VertexMotions{x, moved_by(solution, r), moved_by(motion, r)};
  });
}

// The adjoint of a point of a collider.
template <class T>
DIFFVBD_FN void reverse_collider(const RigidInputs<T>& in, int64_t scene, int32_t point, const PointWork<T>& scattered,
                                 const CorrectionAdjoints<T>& bars) {
  const int64_t corner = 3 * (scene * in.gate.corners + in.gate.vertices + point);
  const int64_t to = 3 * (scene * (in.gate.corners - in.gate.vertices) + point);
  add_to(bars.collider + to, -wide_at(scattered.x + corner));
  if (scattered.since) add_to(bars.collider_prev + to, wide_at(scattered.since + corner));
}

}  // namespace diffvbd::contact
