// What the adjoint of the rigid correction needs of pairs: of their part of the virtual work
//
//     W = p . (gradient + matrix q)
//
// of two motions p and q of all corner points, the derivatives by p, q, positions, kappa and what is lagged. A listed
// pair is derived in twelve directions by Dual, once for each correction; a lagged one by hand. docs/method.md,
// section 18.
#pragma once

#include "rigid_rub.h"

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
  uint8_t* pushes;        // [listed]: whose rows are written
  T *friction, *lag_bar;  // [lagged, 4, 9]; [lagged, 9] less the derivatives by what is lagged
  int64_t listed, lagged;
};
// And their sums at all corner points [B, N, 3].
template <class T>
struct PointWork {
  T *x, *p, *q;  // p: without pairs of which no corner moves by p
  T* since;      // of lagged pairs, by how points have moved since the start of the step, which `x` has in it; or null
};
constexpr int kPointScalars = kWorkScalars + 3;

// Adds what every `stride`-th pair of a corner point from `first` on has at it: by x, p, q and since.
template <class T>
DIFFVBD_FN void add_at_point(const RigidInputs<T>& in, const RigidWork<T>& work, int64_t point, int first, int stride,
                             double* sum) {
  const auto add = [&](const PairList& list, const T* rows, const uint8_t* pushes) {
    const PairList::Entries all = list.of(point);
    for (int e = first; e < all.count; e += stride) {
      const int64_t entry = all.first[e];
      if (pushes && !pushes[entry >> 2]) continue;
      const T* row = rows + kWorkScalars * entry;
      for (int i = 0; i < kWorkScalars; ++i) sum[i] += row[i];
      for (int i = 0; !pushes && i < 3; ++i) sum[kWorkScalars + i] += row[i];
    }
  };
  if (work.listed > 0) add(in.gate.listed, work.barrier, work.pushes);
  if (work.lagged > 0) add(in.lagged, work.friction, nullptr);
}
template <class T>
DIFFVBD_FN void store_at_point(const double* sum, int64_t point, const PointWork<T>& out) {
  T* const to[] = {out.x, out.p, out.q, out.since};
  for (int k = 0; k < 4; ++k) {
    if (to[k]) rigid::put(to[k] + 3 * point, Vector{sum[3 * k], sum[3 * k + 1], sum[3 * k + 2]});
  }
}

// What the corners of a pair do by p and q, and which of them move together: all, or each side by itself.
struct PairMotions {
  Vector p[4], q[4];
  int sides, first;  // how many move by themselves; corners of the first
  double share;      // of the stiffness that each bears

  DIFFVBD_FN bool is_of(int side, int corner) const { return sides == 1 || (corner < first) == (side == 0); }
};

// Whether a corner of a pair moves by p: else the pair does no virtual work, and nobody needs its derivative by p.
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
    out.p[k] = rigid::Body<T>::at(given.p + row), out.q[k] = rigid::Body<T>::at(given.q + row);
  }
  out.first = sides(record[4]);
  const int32_t one = moving_body(in, record[0]), two = moving_body(in, record[out.first]);
  const bool apart = one >= 0 && two >= 0 && !in.groups_of(record[5]).joined(one, two);
  out.sides = apart ? 2 : 1, out.share = apart ? 2 : 1;
  return out;
}

// Of a listed pair, gradient and matrix by the motion of its weighted corners, and what a mollifier adds at corners.
template <class R>
struct PressTerms {
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
DIFFVBD_FN R virtual_work(const PressTerms<R>& a, const PairMotions& m) {
  R out(0);
  for (int k = 0; k < 4; ++k) {
    const Vec3<R> p = {R(m.p[k].x), R(m.p[k].y), R(m.p[k].z)};
    out = out + a.w[k] * dot(a.force, p) + dot(a.at_corner[k], p);
  }
  for (int side = 0; side < m.sides; ++side) {
    const Vec3<R> p = weighted(a.w, m.p, m, side), q = weighted(a.w, m.q, m, side);
    out = out + R(m.share) * a.along * dot(a.n, p) * dot(a.n, q);
  }
  return out;
}

// Adds the derivatives by p and q, to each corner's row.
template <class T>
DIFFVBD_FN void add_by_motions(const PressTerms<double>& a, const PairMotions& m, T* rows) {
  const auto pressed = [&](const Vector& u) { return (m.share * a.along * dot(a.n, u)) * a.n; };
  for (int side = 0; side < m.sides; ++side) {
    const Vector by_p = pressed(weighted(a.w, m.q, m, side)), by_q = pressed(weighted(a.w, m.p, m, side));
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
  PressTerms<R> out{};
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
    PairPress press;
    return pair < in.first_listed(in.scene.scenes) && works(in, given, in.gate.listed.pairs + kPairRow * pair) &&
           barrier_press(in, pair, CornerPoints<T>{in, false}, press);
  }

  // Of the rows of the corners [4, 9], and adds the derivative by kappa, where the pair pushes.
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

// Of a lagged pair. With d how its weighted corners have moved since the start of the step, P and Q how they move by p
// and q, n its normal, u the slip after Q, A = h damping, L = h^2 load and f1 of smoothed friction,
//
//     W = A min(n . d, 0) n . P + share A (n . P) (n . Q) + L f1(|u|) / |u| u . P,
//
// with the last two for each side that moves by itself, of which each bears a share of 2. Positions at the start of the
// step take the derivatives by x with the other sign.
template <class T>
struct LaggedWork {
  bool acts;
  PairMotions m;
  Vector since[4], n, d;  // since: how each corner has moved
  double w[4], load, damping, h, eps;

  DIFFVBD_FN LaggedWork(const RigidInputs<T>& in, const VirtualMotions<T>& given, int64_t pair)
      : acts(pair < in.first_lagged(in.scene.scenes)), m{}, d{}, h(in.scene.time_step), eps(in.friction_eps) {
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
    // what does nothing joined no bodies; with any coefficient it would
    if (load == 0 && damping == 0) m.sides = 1, m.share = 1;
    n = {double(lag.n.x), double(lag.n.y), double(lag.n.z)};
    for (int k = 0; k < 4; ++k) {
      w[k] = lag.w[k];
      since[k] = at.relative(record[5], record[k]) - before(in, record[5], record[k]);
      d += w[k] * since[k];
    }
  }

  // Of the rows of the corners [4, 9], and adds to lag_bar [9].
  DIFFVBD_FN void store(T* rows, T* lag_bar) const {
    const double along = dot(n, d), approach = along < 0 ? along : 0, A = h * damping, L = h * h * load;
    double by_along = 0, by_load = 0, by_damping = 0, by_w[4] = {0, 0, 0, 0};
    Vector by_n{}, by_d{};
    for (int side = 0; side < m.sides; ++side) {
      const Vector P = weighted(w, m.p, m, side), Q = weighted(w, m.q, m, side), way = m.share * Q;
      const Vector u = d - along * n + (way - dot(n, way) * n);
      const FrictionRate<double> f(square_root(dot(u, u)), eps);
      const double nP = dot(n, P), nQ = dot(n, Q), slipping = dot(u, P);
      const Vector by_u = L * (f.value * P + (f.curvature * slipping) * u);
      const Vector by_way = by_u - dot(n, by_u) * n;
      by_d += by_u;
      by_along += (along < 0 ? A * nP : 0) - dot(n, by_u);
      by_n +=
          (A * approach) * P + (m.share * A) * (nQ * P + nP * Q) - (along + dot(n, way)) * by_u - dot(n, by_u) * way;
      by_load += f.value * slipping, by_damping += approach * nP + m.share * nP * nQ;
      const Vector by_p = (A * (approach + m.share * nQ)) * n + (L * f.value) * u;
      const Vector by_q = m.share * ((A * nP) * n + by_way);
      for (int k = 0; k < 4; ++k) {
        if (!m.is_of(side, k)) continue;
        rigid::put(rows + kWorkScalars * k + 3, w[k] * by_p);
        rigid::put(rows + kWorkScalars * k + 6, w[k] * by_q);
        by_w[k] += dot(by_p, m.p[k]) + dot(by_q, m.q[k]);
      }
    }
    by_d += by_along * n, by_n += by_along * d;
    for (int k = 0; k < 4; ++k) rigid::put(rows + kWorkScalars * k, w[k] * by_d);
    lag_bar[0] -= T(h * h * by_load), lag_bar[1] -= T(h * by_damping);
    rigid::add_to(lag_bar + 2, -by_n);
    for (int k = 0; k < 4; ++k) lag_bar[5 + k] -= T(by_w[k] + dot(by_d, since[k]));
  }
  DIFFVBD_FN static void store_none(T* rows) {
    for (int i = 0; i < 4 * kWorkScalars; ++i) rows[i] = T(0);
  }
};

}  // namespace diffvbd::contact
