// The residual acceleration of each body, less the part that contact forces at the start of a step balance, and the
// adjoint (docs/method.md, section 18). In double precision.
#pragma once

#include "../sweep/body.h"
#include "islands.h"

namespace diffvbd::contact {

using rigid::Vector;

template <class T>
struct ResidualInputs {
  rigid::Inputs<T> scene;     // x, mass, the vertices of all bodies and the time step
  Batched<const T> h2a;       // [1 | B, V, 3]  h^2 times the acceleration [m]
  const T* force;             // [B, N, 3]  of pairs at corner points [N], the vertices first
  Batched<const T> floor;     // [1 | B, planes, kPlaneScalars]
  const bool* pinned_bodies;  // [bodies]: bodies with a pinned vertex, which contact does not support
  int64_t corners;            // N
  int32_t planes;

  DIFFVBD_FN double square_of_step() const { return scene.time_step * scene.time_step; }
  DIFFVBD_FN Vector h2a_of(int64_t s, int32_t v) const { return wide_at(h2a.data + s * h2a.scene + 3 * int64_t{v}); }
};

// One plane of a floor and one vertex. Its force is -kappa slope n.
struct FloorPush {
  Vector n;
  double kappa, dhat, gap, slope, curvature;  // the latter of a barrier whose kappa is 1

  template <class T>
  DIFFVBD_FN FloorPush(const ResidualInputs<T>& in, const rigid::Body<T>& b, int32_t v, int32_t plane) {
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
DIFFVBD_FN Vector force_on(const ResidualInputs<T>& in, const rigid::Body<T>& b, int32_t v) {
  Vector out = wide_at(in.force + 3 * (b.scene * in.corners + v));
  for (int32_t k = 0; k < in.planes; ++k) {
    const FloorPush push(in, b, v, k);
    out -= (push.kappa * push.slope) * push.n;
  }
  return out;
}

DIFFVBD_FN double largest_part(const Vector& a) { return larger(absolute(a.x), larger(absolute(a.y), absolute(a.z))); }

constexpr int kSupportSums = 7;  // over the vertices of a body: mass times h^2 a, force times h^2, mass

template <class T>
DIFFVBD_FN void add_to_support(const ResidualInputs<T>& in, const rigid::Body<T>& b, int32_t v, double* to) {
  const double m = b.mass(v);
  const Vector h2a = m * in.h2a_of(b.scene, v), push = in.square_of_step() * force_on(in, b, v);
  add_to(to, h2a);
  add_to(to + 3, push);
  to[6] += m;
}

// h^2 a of a body as a whole, that of contact alone, and the fraction of the latter that best balances the former,
// between 0 and 1.
struct Support {
  double inverse;          // of the mass
  Vector own, borne;       // [m]
  Vector ratio, unit;      // both over the largest part of borne, or as they are if it bears nothing
  double square;           // of unit
  double asked, fraction;  // before and after it is clamped to 0 ... 1
  bool bears;

  DIFFVBD_FN Support(const double* sum, double rounding) {
    inverse = 1 / larger(std::numeric_limits<double>::min(), sum[6]);
    own = inverse * vector_at(sum), borne = inverse * vector_at(sum + 3);
    // a support below the rounding of the own acceleration counts as none: its square may vanish
    const double largest = largest_part(borne);
    bears = rounding * largest_part(own) < largest;
    const double size = bears ? largest : 1;
    ratio = {own.x / size, own.y / size, own.z / size}, unit = {borne.x / size, borne.y / size, borne.z / size};
    square = dot(unit, unit);
    asked = bears ? -dot(ratio, unit) / square : 0;
    fraction = asked < 0 ? 0 : 1 < asked ? 1 : asked;
  }
};

// out [B, V, 3] [m]
template <class T, class Team>
DIFFVBD_FN void residual_acceleration(const ResidualInputs<T>& in, const rigid::Body<T>& b, const Team& team, T* out) {
  Vector taken{};
  if (!in.pinned_bodies[b.body]) {
    double sum[kSupportSums];
    team.template sum<kSupportSums>(b.size(), sum,
                                    [&](int32_t i, double* to) { add_to_support(in, b, b.vertex(i), to); });
    const Support support(sum, std::numeric_limits<T>::epsilon());
    taken = support.fraction * support.borne;
  }
  team.each(b.size(), [&](int32_t i) {
    const int32_t v = b.vertex(i);
    put(out + 3 * b.row(v), in.h2a_of(b.scene, v) + taken);
  });
}

// Adjoints of the sums, by that of what contact takes from every vertex.
struct SupportAdjoint {
  Vector h2a, push;
  double mass;

  DIFFVBD_FN SupportAdjoint(const Support& s, const Vector& taken) {
    Vector own{}, borne = s.fraction * taken;
    if (s.bears && 0 <= s.asked && s.asked <= 1) {
      const double along = dot(taken, s.unit) / s.square;
      own = -along * s.unit;
      borne -= along * (s.ratio + (2 * s.asked) * s.unit);
    }
    h2a = s.inverse * own, push = s.inverse * borne;
    mass = -dot(h2a, s.own) - dot(push, s.borne);
  }
};

// x is null without a floor, planes where not wanted. Force and planes are zero at first.
template <class T>
struct ResidualAdjoints {
  T *x, *h2a, *force, *mass;  // [B, V, 3], [B, V, 3], [B, N, 3], [B, V]
  T* planes;                  // of each body [B, bodies, planes, kPlaneScalars]
};

// The adjoint of a position by the floor. push: adjoint of the force on the vertex.
template <class T>
DIFFVBD_FN Vector floor_adjoint(const ResidualInputs<T>& in, const rigid::Body<T>& b, int32_t v, const Vector& push) {
  Vector out{};
  for (int32_t k = 0; k < in.planes; ++k) {
    const FloorPush at(in, b, v, k);
    out -= (at.kappa * at.curvature * dot(at.n, push)) * at.n;
  }
  return out;
}

// The adjoint of the data of one plane: normal, height, kappa and dhat.
constexpr int kPushedScalars = 6;
template <class T>
DIFFVBD_FN void add_plane_adjoint(const ResidualInputs<T>& in, const rigid::Body<T>& b, int32_t v, int32_t plane,
                                  const Vector& push, double* to) {
  const FloorPush at(in, b, v, plane);
  const Vector x = b.position(v);
  const double along = dot(at.n, push), by_gap = -at.kappa * at.curvature * along;
  const Vector n = -(at.kappa * at.slope) * push + by_gap * (x + b.state(v, x).origin);
  add_to(to, n);
  to[3] -= by_gap;
  to[4] -= at.slope * along;
  // the slope grows as gap and dhat do together
  to[5] -= at.kappa * along * (at.slope - at.gap * at.curvature) / at.dhat;
}

template <class T, class Team>
DIFFVBD_FN void reverse_residual_acceleration(const ResidualInputs<T>& in, const rigid::Body<T>& b, const Team& team,
                                              const T* bar, const ResidualAdjoints<T>& out) {
  Vector h2a{}, push{};
  double mass = 0;
  if (!in.pinned_bodies[b.body]) {
    double sum[kSupportSums + 3];
    team.template sum<kSupportSums + 3>(b.size(), sum, [&](int32_t i, double* to) {
      const int32_t v = b.vertex(i);
      add_to_support(in, b, v, to);
      const Vector own = wide_at(bar + 3 * b.row(v));
      add_to(to + 7, own);
    });
    const SupportAdjoint scattered(Support(sum, std::numeric_limits<T>::epsilon()), vector_at(sum + 7));
    h2a = scattered.h2a, push = in.square_of_step() * scattered.push, mass = scattered.mass;
  }
  team.each(b.size(), [&](int32_t i) {
    const int32_t v = b.vertex(i);
    const int64_t row = b.row(v);
    put(out.h2a + 3 * row, wide_at(bar + 3 * row) + b.mass(v) * h2a);
    put(out.force + 3 * (b.scene * in.corners + v), push);
    out.mass[row] = T(mass + dot(in.h2a_of(b.scene, v), h2a));
    if (out.x) put(out.x + 3 * row, floor_adjoint(in, b, v, push));
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
