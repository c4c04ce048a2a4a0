// What is left of each body's acceleration once the contact forces at the start of a step have borne their part of it,
// and the adjoint of that (docs/method.md, section 18). In double, whatever the dtype of the scene.
#pragma once

#include "../sweep/body.h"
#include "islands.h"

namespace diffvbd::contact {

using rigid::Vector;

template <class T>
struct UnsupportedInputs {
  rigid::Inputs<T> scene;   // x, mass, the vertices of all bodies and the time step
  Batched<const T> lift;    // [1 | B, V, 3]  h^2 times the acceleration [m]
  const T* force;           // [B, N, 3]  of pairs at corner points [N], the vertices first
  Batched<const T> floor;   // [1 | B, planes, kPlaneScalars]
  const bool* held_bodies;  // [bodies]: a vertex of it is pinned; it hangs from that, and contact bears nothing
  int64_t corners;          // N
  int32_t planes;

  DIFFVBD_FN double square_of_step() const { return scene.time_step * scene.time_step; }
  DIFFVBD_FN Vector lift_of(int64_t s, int32_t v) const {
    return rigid::Body<T>::at(lift.data + s * lift.scene + 3 * int64_t{v});
  }
};

// One plane of a floor and one vertex. Its force is -kappa slope n.
struct FloorPush {
  Vector n;
  double kappa, dhat, gap, slope, curvature;  // the latter of a barrier whose kappa is 1

  template <class T>
  DIFFVBD_FN FloorPush(const UnsupportedInputs<T>& in, const rigid::Body<T>& b, int32_t v, int32_t plane) {
    const T* given = in.floor.data + b.scene * in.floor.scene + plane * kPlaneScalars;
    double record[kPlaneScalars];
    for (int i = 0; i < kPlaneScalars; ++i) record[i] = given[i];
    const Vector x = b.position(v);
    const FloorBarrier::Plane<double> at(record, b.state(v, x));
    n = at.n, kappa = at.kappa, dhat = at.dhat, gap = at.gap(x);
    // below a plane, where the barrier is not defined, nothing pushes
    const LogBarrier<double> barrier(0 < gap ? gap : dhat, dhat, 1.0);
    slope = barrier.first, curvature = barrier.second;
  }
};

// The force of pairs and of the floor on a vertex [N].
template <class T>
DIFFVBD_FN Vector force_on(const UnsupportedInputs<T>& in, const rigid::Body<T>& b, int32_t v) {
  Vector out = rigid::Body<T>::at(in.force + 3 * (b.scene * in.corners + v));
  for (int32_t k = 0; k < in.planes; ++k) {
    const FloorPush push(in, b, v, k);
    out -= (push.kappa * push.slope) * push.n;
  }
  return out;
}

DIFFVBD_FN double largest_part(const Vector& a) { return larger(absolute(a.x), larger(absolute(a.y), absolute(a.z))); }

constexpr int kSupportSums = 7;  // over the vertices of a body: mass times lift, force times h^2, mass

template <class T>
DIFFVBD_FN void add_to_support(const UnsupportedInputs<T>& in, const rigid::Body<T>& b, int32_t v, double* to) {
  const double m = b.mass(v);
  const Vector lift = m * in.lift_of(b.scene, v), push = in.square_of_step() * force_on(in, b, v);
  to[0] += lift.x, to[1] += lift.y, to[2] += lift.z;
  to[3] += push.x, to[4] += push.y, to[5] += push.z;
  to[6] += m;
}

// The lift of a body as a whole, that of contact alone, and the share of the latter which takes from the former what it
// can: it neither pulls nor pushes beyond that.
struct Support {
  double inverse;       // of the mass
  Vector own, borne;    // [m]
  Vector ratio, unit;   // both over the largest part of borne, or as they are if it bears nothing
  double square;        // of unit
  double asked, share;  // before and after it is held between 0 and 1
  bool bears;

  DIFFVBD_FN Support(const double* sum, double rounding) {
    inverse = 1 / larger(std::numeric_limits<double>::min(), sum[6]);
    own = inverse * Vector{sum[0], sum[1], sum[2]}, borne = inverse * Vector{sum[3], sum[4], sum[5]};
    // what bears less than rounding of the body's own acceleration bears nothing: its square may be no number
    const double largest = largest_part(borne);
    bears = rounding * largest_part(own) < largest;
    const double size = bears ? largest : 1;
    ratio = {own.x / size, own.y / size, own.z / size}, unit = {borne.x / size, borne.y / size, borne.z / size};
    square = dot(unit, unit);
    asked = bears ? -dot(ratio, unit) / square : 0;
    share = asked < 0 ? 0 : 1 < asked ? 1 : asked;
  }
};

// Loops and sums over the vertices of a body belong to a Team (rigid/body.h).

// out [B, V, 3] [m]
template <class T, class Team>
DIFFVBD_FN void leave_unsupported(const UnsupportedInputs<T>& in, const rigid::Body<T>& b, const Team& team, T* out) {
  Vector taken{};
  if (!in.held_bodies[b.body]) {
    double sum[kSupportSums];
    team.template sum<kSupportSums>(b.size(), sum,
                                    [&](int32_t i, double* to) { add_to_support(in, b, b.vertex(i), to); });
    const Support support(sum, std::numeric_limits<T>::epsilon());
    taken = support.share * support.borne;
  }
  team.each(b.size(), [&](int32_t i) {
    const int32_t v = b.vertex(i);
    rigid::put(out + 3 * b.row(v), in.lift_of(b.scene, v) + taken);
  });
}

// Adjoints of what is summed up, by that of what contact takes from every vertex.
struct SupportAdjoint {
  Vector lift, push;
  double mass;

  DIFFVBD_FN SupportAdjoint(const Support& s, const Vector& taken) {
    Vector own{}, borne = s.share * taken;
    if (s.bears && 0 <= s.asked && s.asked <= 1) {
      const double along = dot(taken, s.unit) / s.square;
      own = -along * s.unit;
      borne -= along * (s.ratio + (2 * s.asked) * s.unit);
    }
    lift = s.inverse * own, push = s.inverse * borne;
    mass = -dot(lift, s.own) - dot(push, s.borne);
  }
};

// x is null without a floor, planes where they want none. Force and planes are zero at first.
template <class T>
struct UnsupportedAdjoints {
  T *x, *lift, *force, *mass;  // [B, V, 3], [B, V, 3], [B, N, 3], [B, V]
  T* planes;                   // of each body [B, bodies, planes, kPlaneScalars]
};

// What a vertex sends to its position by the floor. push: adjoint of the force on it.
template <class T>
DIFFVBD_FN Vector floor_adjoint(const UnsupportedInputs<T>& in, const rigid::Body<T>& b, int32_t v,
                                const Vector& push) {
  Vector out{};
  for (int32_t k = 0; k < in.planes; ++k) {
    const FloorPush at(in, b, v, k);
    out -= (at.kappa * at.curvature * dot(at.n, push)) * at.n;
  }
  return out;
}

// And to the data of one plane: normal, height, kappa and dhat; damping has no say.
constexpr int kPushedScalars = 6;
template <class T>
DIFFVBD_FN void add_plane_adjoint(const UnsupportedInputs<T>& in, const rigid::Body<T>& b, int32_t v, int32_t plane,
                                  const Vector& push, double* to) {
  const FloorPush at(in, b, v, plane);
  const Vector x = b.position(v);
  const double along = dot(at.n, push), by_gap = -at.kappa * at.curvature * along;
  const Vector n = -(at.kappa * at.slope) * push + by_gap * (x + b.state(v, x).origin);
  to[0] += n.x, to[1] += n.y, to[2] += n.z;
  to[3] -= by_gap;
  to[4] -= at.slope * along;
  // the slope grows as gap and dhat do together
  to[5] -= at.kappa * along * (at.slope - at.gap * at.curvature) / at.dhat;
}

template <class T, class Team>
DIFFVBD_FN void reverse_unsupported(const UnsupportedInputs<T>& in, const rigid::Body<T>& b, const Team& team,
                                    const T* bar, const UnsupportedAdjoints<T>& out) {
  Vector lift{}, push{};
  double mass = 0;
  if (!in.held_bodies[b.body]) {
    double sum[kSupportSums + 3];
    team.template sum<kSupportSums + 3>(b.size(), sum, [&](int32_t i, double* to) {
      const int32_t v = b.vertex(i);
      add_to_support(in, b, v, to);
      const Vector own = rigid::Body<T>::at(bar + 3 * b.row(v));
      to[7] += own.x, to[8] += own.y, to[9] += own.z;
    });
    const SupportAdjoint sent(Support(sum, std::numeric_limits<T>::epsilon()), Vector{sum[7], sum[8], sum[9]});
    lift = sent.lift, push = in.square_of_step() * sent.push, mass = sent.mass;
  }
  team.each(b.size(), [&](int32_t i) {
    const int32_t v = b.vertex(i);
    const int64_t row = b.row(v);
    rigid::put(out.lift + 3 * row, rigid::Body<T>::at(bar + 3 * row) + b.mass(v) * lift);
    rigid::put(out.force + 3 * (b.scene * in.corners + v), push);
    out.mass[row] = T(mass + dot(in.lift_of(b.scene, v), lift));
    if (out.x) rigid::put(out.x + 3 * row, floor_adjoint(in, b, v, push));
  });
  for (int32_t k = 0; out.planes && k < in.planes; ++k) {
    double sum[kPushedScalars];
    team.template sum<kPushedScalars>(
        b.size(), sum, [&](int32_t i, double* to) { add_plane_adjoint(in, b, b.vertex(i), k, push, to); });
    T* to = out.planes + ((b.scene * in.scene.bodies + b.body) * in.planes + k) * kPlaneScalars;
    for (int c = 0; c < kPushedScalars && team.leads(); ++c) to[c] = T(sum[c]);
  }
}

}  // namespace diffvbd::contact
