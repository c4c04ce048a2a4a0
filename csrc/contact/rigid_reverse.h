// The adjoint of the rigid correction of bodies that touch, but for what pairs have in it (contact/rigid_backward.h).
//
// A correction moves vertices by displaced(share d, r), with H d = -g. The adjoint of d, l = H^-1 (adjoint of the way),
// makes that of everything g and H read the adjoint of -W, where
//
//     W = sum over vertices P . (g_v + H_v Q) + pairs + what keeps H definite,
//
// and P and Q are how a vertex moves by l and by d. docs/method.md, section 18.
#pragma once

#include "rigid_backward.h"

namespace diffvbd::contact {

// What displaced() sends back to r, of an adjoint g of the way.
DIFFVBD_FN Vector arm_adjoint(const Vector& w, const rigid::Angles& s, const Vector& g) {
  const Vector turned = cross(w, g);
  return s.b * cross(w, turned) - s.a * turned;
}

// And to its motion: of all vertices of a body `sum` = sum g, and `turning` = sum g r^T.
DIFFVBD_FN void motion_adjoint(const double* motion, double share, const Vector& sum, const rigid::Matrix& turning,
                               double* out) {
  const Vector w = share * Vector{motion[0], motion[1], motion[2]};
  const rigid::Matrix turn = rigid::identity() + rigid::turned_by(w);
  const Vector turned = rigid::turn_vjp(w, turning * rigid::transposed(turn));
  const Vector parts[] = {share * turned, share * sum};
  for (int i = 0; i < 2; ++i) rigid::put(out + 3 * i, parts[i]);
}

// P . g of friction on one plane of a floor after Q. lag: load [N], normal; travel: since the start of the step.
template <class R>
DIFFVBD_FN R slip_work(const R* lag, const Vec3<R>& travel, const Vector& P, const Vector& Q, double h2, double eps) {
  const Vec3<R> n = {lag[1], lag[2], lag[3]}, p = {R(P.x), R(P.y), R(P.z)}, q = {R(Q.x), R(Q.y), R(Q.z)};
  const Vec3<R> way = travel + q, u = way - dot(n, way) * n;
  return R(h2) * lag[0] * slip_rate(u, eps).value * dot(p, u);
}

// Its derivatives: by travel, and by what is lagged [4].
DIFFVBD_FN Vector slip_adjoint(const double* lag, const Vector& travel, const Vector& P, const Vector& Q, double h2,
                               double eps, double* by_lag) {
  const auto derived = [&](int direction) {
    Dual<double> turned[kFloorLag];
    for (int i = 0; i < kFloorLag; ++i) turned[i] = {lag[i], double(i + 3 == direction)};
    const Vec3<Dual<double>> way = {
        {travel.x, double(direction == 0)}, {travel.y, double(direction == 1)}, {travel.z, double(direction == 2)}};
    return slip_work(turned, way, P, Q, h2, eps).derivative;
  };
  for (int i = 0; i < kFloorLag; ++i) by_lag[i] = derived(3 + i);
  return {derived(0), derived(1), derived(2)};
}

// The adjoint of -W seen from one vertex of a free body at r from its center.
struct VertexAdjoint {
  Vector x, x_prev, y;  // x: but for what the center of mass sends
  Vector arm;           // the part of x that goes by r
  double mass;
};

// by_p, by_q: what pairs send to P and Q. floor_lag: what becomes of a scene's floor_lag at this vertex, or null.
template <class T>
DIFFVBD_FN VertexAdjoint vertex_adjoint(const RigidInputs<T>& in, const rigid::Body<T>& b, int32_t v, const Vector& r,
                                        const double* p, const double* q, const Vector& by_p, const Vector& by_q,
                                        T* floor_lag) {
  const double mass = b.mass(v), h = in.scene.time_step;
  const Vector P = moved_by(p, r), Q = moved_by(q, r), x = b.position(v);
  const VertexState<double> s = b.state(v, x);
  Vector g;
  Sym3<double> H;
  vertex_press(in, b, v, g, H);
  add_floor_friction(in, b, v, Q, g, H);
  VertexAdjoint out{-mass * P, Vector{}, mass * P, Vector{}, -dot(P, x - b.target(v) + Q)};
  b.energies(v, [&](auto energy, int, const double* data, int count) {
    vertex_energy_vjp<decltype(energy)>(s, data, count, P, Q, out.x, out.x_prev);
  });
  for (int k = 0; k < in.planes; ++k) {
    const T* given = in.floor_lag.data + b.scene * in.floor_lag.scene + (int64_t{v} * in.planes + k) * kFloorLag;
    double lag[kFloorLag], by_lag[kFloorLag];
    for (int i = 0; i < kFloorLag; ++i) lag[i] = given[i];
    const Vector by_travel = slip_adjoint(lag, x - s.x_prev, P, Q, h * h, in.friction_eps, by_lag);
    out.x -= by_travel, out.x_prev += by_travel;
    for (int i = 0; floor_lag && i < kFloorLag; ++i) floor_lag[kFloorLag * k + i] = T(-by_lag[i]);
  }
  const Vector turn_p = {p[0], p[1], p[2]}, turn_q = {q[0], q[1], q[2]};
  const double turns = dot(turn_p, turn_q), shifts = p[3] * q[3] + p[4] * q[4] + p[5] * q[5];
  out.arm = -cross(g + H * Q + by_p, turn_p) - cross(H * P + by_q, turn_q) - (2 * kLeastInertia * turns * mass) * r;
  out.mass -= kLeastInertia * (turns * dot(r, r) + shifts);
  return out;
}

}  // namespace diffvbd::contact
