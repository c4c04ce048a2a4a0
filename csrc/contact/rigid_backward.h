// What the adjoint of the rigid correction needs of pairs: of their part of the virtual work
//
//     W = p . (gradient + matrix q)
//
// of two motions p and q of all corner points, the derivatives by p, q, positions, kappa and what is lagged. A pair is
// derived in twelve directions by Dual, once for each correction. docs/method.md, section 18.
#pragma once

#include "rigid_rub.h"

namespace diffvbd::contact {

constexpr int kWorkScalars = 9;  // of a corner: derivatives by its position, by p and by q

// Two motions of all corner points [B, N, 3].
template <class T>
struct VirtualMotions {
  const T *p, *q;
};

// Derivatives of the virtual work of all pairs, of lists with so many rows.
template <class T>
struct RigidWork {
  T *barrier, *by_kappa;  // [listed, 4, 9], [listed]
  T *friction, *by_lag;   // [lagged, 4, 9], [lagged, 9]
  int64_t listed, lagged;
};

// What the corners of a pair do by p and q, and which of them move together: all, or each side by itself.
struct PairMotions {
  Vector p[4], q[4];
  int sides, first;  // how many move by themselves; corners of the first
  double share;      // of the stiffness that each bears

  DIFFVBD_FN bool is_of(int side, int corner) const { return sides == 1 || (corner < first) == (side == 0); }
};

template <class T>
DIFFVBD_FN PairMotions motions_of(const RigidInputs<T>& in, const VirtualMotions<T>& given, const int32_t* record) {
  PairMotions out;
  for (int k = 0; k < 4; ++k) {
    const int64_t row = 3 * (int64_t{record[5]} * in.gate.corners + record[k]);
    out.p[k] = rigid::Body<T>::at(given.p + row), out.q[k] = rigid::Body<T>::at(given.q + row);
  }
  out.first = sides(record[4]);
  const int32_t one = moving_body(in, record[0]), two = moving_body(in, record[out.first]);
  const bool apart = one >= 0 && two >= 0 && !in.groups_of(record[5]).joined(one, two);
  out.sides = apart ? 2 : 1, out.share = apart ? 2 : 1;
  return out;
}

// Gradient and matrix of a pair by the motion of its weighted corners, and what a mollifier adds at corners.
template <class R>
struct PressTerms {
  Vec3<R> force, n, at_corner[4];
  R w[4], along;  // stiffness along the normal
  // Of friction, for each side that moves by itself, where q has taken it: its force, the slip, its derivative there,
  // and what that has along the slip.
  Vec3<R> rub[2], slip[2];
  R rate[2], bend[2];
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
DIFFVBD_FN R virtual_work(const PressTerms<R>& a, const PairMotions& m) {
  R out(0);
  for (int k = 0; k < 4; ++k) {
    const Vec3<R> p = {R(m.p[k].x), R(m.p[k].y), R(m.p[k].z)};
    out = out + a.w[k] * dot(a.force, p) + dot(a.at_corner[k], p);
  }
  for (int side = 0; side < m.sides; ++side) {
    const Vec3<R> p = weighted(a.w, m.p, m, side), q = weighted(a.w, m.q, m, side);
    out = out + R(m.share) * a.along * dot(a.n, p) * dot(a.n, q) + dot(a.rub[side], p);
  }
  return out;
}

// Adds the derivatives by p and q, to each corner's row.
template <class T>
DIFFVBD_FN void add_by_motions(const PressTerms<double>& a, const PairMotions& m, T* rows) {
  const auto pressed = [&](const Vector& u) { return (a.along * dot(a.n, u)) * a.n; };
  for (int side = 0; side < m.sides; ++side) {
    const Vector& slip = a.slip[side];
    const auto rubbed = [&](const Vector& u) {
      return a.rate[side] * (u - dot(a.n, u) * a.n) + (a.bend[side] * dot(slip, u)) * slip;
    };
    const Vector P = weighted(a.w, m.p, m, side), Q = weighted(a.w, m.q, m, side);
    const Vector by_p = a.rub[side] + m.share * pressed(Q), by_q = m.share * (pressed(P) + rubbed(P));
    for (int k = 0; k < 4; ++k) {
      if (!m.is_of(side, k)) continue;
      rigid::put(rows + kWorkScalars * k + 3, a.w[k] * (a.force + by_p) + a.at_corner[k]);
      rigid::put(rows + kWorkScalars * k + 6, a.w[k] * by_q);
    }
  }
}

// size: h^2 kappa.
template <class R, class T>
DIFFVBD_FN PressTerms<R> barrier_terms(int kind, const Corners<R>& c, const PairConstants<T>& a, double size) {
  const Distance<R> near = distance(kind, c);
  const LogBarrier<R> b(near.d - R(a.offset), R(a.dhat), R(size));
  PressTerms<R> out{};  // no friction
  R e(1);
  if (is_mollified(kind, c, a.threshold)) {
    const Mollifier<R> m = mollifier(c, a.threshold);
    e = m.e;
    for (int k = 0; k < 4; ++k) out.at_corner[k] = b.value * m.gradient[k];
  }
  out.force = (e * b.first) * near.n, out.n = near.n, out.along = e * b.second;
  for (int k = 0; k < 4; ++k) out.w[k] = near.w[k];
  return out;
}

// Twelve directions that a pair is derived by, one evaluation each, and what needs none: work that threads share out.
constexpr int kDirections = 12, kWorkParts = kDirections + 1;

// Of a listed pair.
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
      : acts(known || pushes(in, pair)), m{}, c{}, a(in.gate.constants + kConstants * pair), kind(0), h2(0), kappa(0) {
    if (!acts) return;
    const CornerPoints<T> at{in, false};
    const int32_t* record = in.gate.listed.pairs + kPairRow * pair;
    const int64_t scene = record[5];
    m = motions_of(in, given, record), kind = record[4];
    const Vector origin = at(scene, record[0]);
    for (int k = 0; k < 4; ++k) c.x[k] = at(scene, record[k]) - origin;
    h2 = in.scene.time_step * in.scene.time_step, kappa = in.kappa.data[scene * in.kappa.scene];
  }

  DIFFVBD_FN static bool pushes(const RigidInputs<T>& in, int64_t pair) {
    PairPress press;
    return pair < in.first_listed(in.scene.scenes) && barrier_press(in, pair, CornerPoints<T>{in, false}, press);
  }

  // Of the rows of the corners [4, 9] and the derivative by kappa; zero where the pair does not push.
  DIFFVBD_FN void store(int part, T* rows, T* by_kappa) const {
    if (part < kDirections) {
      const int k = part / 3, i = part % 3;
      const Vector z = {double(i == 0), double(i == 1), double(i == 2)};
      const auto terms = [&] { return barrier_terms(kind, moved_along(c, k, z), a, h2 * kappa); };
      rows[kWorkScalars * k + i] = acts ? T(virtual_work(terms(), m).derivative) : T(0);
      return;
    }
    for (int k = 0; k < 4; ++k) {
      for (int i = 3; i < kWorkScalars; ++i) rows[kWorkScalars * k + i] = T(0);
    }
    *by_kappa = acts ? T(virtual_work(barrier_terms(kind, c, a, h2), m)) : T(0);
    if (acts) add_by_motions(barrier_terms(kind, c, a, h2 * kappa), m, rows);
  }
};

// f1(|u|) / |u| and its derivative over |u|, which are taken as constant below what rounding makes of rest.
DIFFVBD_FN FrictionRate<double> slip_rate(const Vector& u, double eps) {
  return FrictionRate<double>(square_root(dot(u, u)), eps);
}
DIFFVBD_FN FrictionRate<Dual<double>> slip_rate(const Vec3<Dual<double>>& u, double eps) {
  const Dual<double> square = dot(u, u);
  const double length = square_root(square.value);
  const Dual<double> known = kRestingMotion * eps < length ? square_root(square) : Dual<double>(length);
  return FrictionRate<Dual<double>>(known, Dual<double>(eps));
}

// lag: as Lag reads it; since: how corners have moved since the start of the step; beside: added to what they make.
template <class R>
DIFFVBD_FN PressTerms<R> lagged_terms(const R* lag, const Vector* since, const PairMotions& motions,
                                      const Vec3<R>& beside, double h, double eps) {
  PressTerms<R> out{};
  out.n = {lag[2], lag[3], lag[4]};
  Vec3<R> m = beside;
  for (int k = 0; k < 4; ++k) {
    out.w[k] = lag[5 + k];
    m = m + Vec3<R>{out.w[k] * R(since[k].x), out.w[k] * R(since[k].y), out.w[k] * R(since[k].z)};
    out.at_corner[k] = {R(0), R(0), R(0)};
  }
  const R along = dot(out.n, m), approach = select(along < R(0), along, R(0));
  const R load = R(h * h) * lag[0];
  out.along = R(h) * lag[1];
  out.force = (out.along * approach) * out.n;
  for (int side = 0; side < motions.sides; ++side) {
    const Vec3<R> way = R(motions.share) * weighted(out.w, motions.q, motions, side);
    out.slip[side] = m - along * out.n + (way - dot(out.n, way) * out.n);
    const FrictionRate<R> f = slip_rate(out.slip[side], eps);
    out.rate[side] = load * f.value, out.bend[side] = load * f.curvature;
    out.rub[side] = out.rate[side] * out.slip[side];
  }
  return out;
}

// Of a lagged pair. Positions at the start of the step take the derivatives by x with the other sign.
template <class T>
struct LaggedWork {
  bool acts;
  PairMotions m;
  Vector since[4];
  double lag[kLagScalars], h, eps;

  DIFFVBD_FN LaggedWork(const RigidInputs<T>& in, const VirtualMotions<T>& given, int64_t pair)
      : acts(pair < in.first_lagged(in.scene.scenes)), m{}, h(in.scene.time_step), eps(in.friction_eps) {
    if (!acts) return;
    const int32_t* record = in.lagged.pairs + kPairRow * pair;
    // also of pairs without a force, which a coefficient of zero has made so
    acts = moving_body(in, record[0]) >= 0 || moving_body(in, record[sides(record[4])]) >= 0;
    if (!acts) return;
    const CornerPoints<T> at{in, false};
    m = motions_of(in, given, record);
    // what does nothing joined no bodies; with any coefficient it would
    if (in.lag[kLagScalars * pair] == T(0) && in.lag[kLagScalars * pair + 1] == T(0)) m.sides = 1, m.share = 1;
    for (int k = 0; k < 4; ++k) since[k] = at.relative(record[5], record[k]) - before(in, record[5], record[k]);
    for (int i = 0; i < kLagScalars; ++i) lag[i] = in.lag[kLagScalars * pair + i];
  }

  DIFFVBD_FN double derived(int direction) const {
    Dual<double> turned[kLagScalars];
    for (int i = 0; i < kLagScalars; ++i) turned[i] = {lag[i], double(i + 3 == direction)};
    const Vec3<Dual<double>> beside = {
        {0.0, double(direction == 0)}, {0.0, double(direction == 1)}, {0.0, double(direction == 2)}};
    return virtual_work(lagged_terms(turned, since, m, beside, h, eps), m).derivative;
  }

  // Of the rows of the corners [4, 9] and the derivatives by what is lagged [9].
  DIFFVBD_FN void store(int part, T* rows, T* by_lag) const {
    if (part < kDirections) {
      const double own = acts ? derived(part) : 0;
      if (part >= 3) by_lag[part - 3] = T(own);
      for (int k = 0; k < 4 && part < 3; ++k) rows[kWorkScalars * k + part] = acts ? T(lag[5 + k] * own) : T(0);
      return;
    }
    for (int k = 0; k < 4; ++k) {
      for (int i = 3; i < kWorkScalars; ++i) rows[kWorkScalars * k + i] = T(0);
    }
    if (acts) add_by_motions(lagged_terms(lag, since, m, Vector{}, h, eps), m, rows);
  }
};

}  // namespace diffvbd::contact
