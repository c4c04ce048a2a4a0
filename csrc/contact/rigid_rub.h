// What lagged friction and damping of pairs add to the rigid correction (docs/method.md, section 18).
#pragma once

#include "rigid.h"

namespace diffvbd::contact {

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

}  // namespace diffvbd::contact
