// The displacement that the planes of a floor leave to a body that moves as a whole, and its adjoint (docs/method.md,
// section 12). The body is shifted along their normals until no vertex closes more than a fraction of its gap: sliding
// and turning stay. Where no shift suits all planes, the displacement is scaled. In double precision.
#pragma once

#include <limits>

#include "../core/rotation.h"
#include "../sweep/body.h"
#include "islands.h"

namespace diffvbd::contact {

using rigid::Vector;

constexpr double kTruncated = 0.99;             // fraction of a displacement below which it counts as truncated
constexpr double kKept = 0.9;                   // fraction of a gap above a floor that rigid motion may close
constexpr double kDeep = 0.1, kKeptDeep = 0.1;  // fraction of dhat below which it may close less
constexpr double kRoundings = 8;                // of the terms of a gap, as FloorBarrier::Plane::guard()
constexpr int kPlaneDhat = 5;                   // which number of a plane is its dhat

// One vertex above one plane: its motion toward the plane and the largest allowed one [m]. Comparisons with NaN are
// false. T: the scalar of the scene, whose rounding counts.
template <class T>
struct Descent {
  Vector n;
  double safe, gap, deep, allowance, toward;  // gap less rounding, the same but not below 0, part of dhat

  // Not inlined: who decides is found by comparing bits, and a device compiler may round inlined copies differently.
  DIFFVBD_APART Descent(const T* plane, const Vector& at, const Vector& displacement)
      : n{plane[0], plane[1], plane[2]} {
    const double height = plane[3], size = absolute(n.x) * absolute(at.x) + absolute(n.y) * absolute(at.y) +
                                           absolute(n.z) * absolute(at.z) + absolute(height);
    safe = dot(n, at) - height - kRoundings * std::numeric_limits<T>::epsilon() * size;
    gap = safe < 0 ? 0 : safe;
    deep = kDeep * plane[kPlaneDhat];
    allowance = kKept * (gap < deep ? 0 : gap - deep) + kKeptDeep * (deep < gap ? deep : gap);
    toward = -dot(n, displacement);
  }
  DIFFVBD_FN bool closes() const { return allowance < toward; }
  DIFFVBD_FN double excess() const { return closes() ? toward - allowance : 0; }
  DIFFVBD_FN double fraction() const { return closes() ? allowance / toward : 1; }
  DIFFVBD_FN bool clears(const Vector& shift) const {
    const double rounding = kRoundings * std::numeric_limits<T>::epsilon() *
                            (absolute(toward) + absolute(shift.x) + absolute(shift.y) + absolute(shift.z));
    return toward - dot(n, shift) <= allowance + rounding;
  }
};

struct AboveFloor {
  double fraction;  // 1 where a shift suits all planes
  Vector shift;
  bool stopped;  // a vertex loses more than a hundredth of its motion toward a plane

  DIFFVBD_FN Vector left(const Vector& displacement) const { return fraction * displacement + shift; }
};

// The largest f(i) of a body. None may be NaN: least() of a device would drop it.
template <class Team, class F>
DIFFVBD_FN double most(const Team& team, int32_t size, const F& f) {
  return -team.least(size, [&](int32_t i) { return -f(i); });
}

// The largest excess of a vertex of the body over its allowance.
template <class T, class Team, class At, class Displacement, class Counts>
DIFFVBD_FN double excess_over(const Team& team, int32_t size, const T* plane, const At& at,
                              const Displacement& displacement, const Counts& counts) {
  return most(team, size,
              [&](int32_t i) { return counts(i) ? Descent<T>(plane, at(i), displacement(i)).excess() : 0.0; });
}

// planes: `count` planes, as in the data of FloorBarrier. at(i), displacement(i) [m] and counts(i), false where pinned,
// of the i-th of `size` vertices.
template <class T, class Team, class At, class Displacement, class Counts>
DIFFVBD_FN AboveFloor above_floor(const Team& team, int32_t size, const T* planes, int32_t count, At&& at,
                                  Displacement&& displacement, Counts&& counts) {
  AboveFloor out{1, Vector{0, 0, 0}, false};
  const double fraction = team.least(size, [&](int32_t i) {
    double least = 1;
    if (!counts(i)) return least;
    const Vector own_at = at(i), own_displacement = displacement(i);
    for (int32_t k = 0; k < count; ++k) {
      const double own = Descent<T>(planes + kPlaneScalars * k, own_at, own_displacement).fraction();
      least = own < least ? own : least;
    }
    return least;
  });
  if (!(fraction < 1)) return out;  // nothing closes more than it may
  out.stopped = fraction < kTruncated;
  Vector shift{0, 0, 0};
  for (int32_t k = 0; k < count; ++k) {
    const T* plane = planes + kPlaneScalars * k;
    shift += excess_over(team, size, plane, at, displacement, counts) * wide_at(plane);
  }
  const double clear = team.least(size, [&](int32_t i) {
    bool clears = true;
    if (!counts(i)) return 1.0;
    const Vector own_at = at(i), own_displacement = displacement(i);
    for (int32_t k = 0; k < count; ++k) {
      clears = clears && Descent<T>(planes + kPlaneScalars * k, own_at, own_displacement).clears(shift);
    }
    return clears ? 1.0 : 0.0;
  });
  if (0 < clear) {
    out.shift = shift;
  } else {
    out.fraction = fraction;
  }
  return out;
}

// The same for all bodies, and the adjoint. Several vertices or planes that decide alike share the adjoint evenly.

template <class T>
struct AboveFloorInputs {
  rigid::Inputs<T> scene;  // x, origin and the vertices of all bodies
  const T* displacement;   // [B, V, 3]  from x
  const T* u;              // [B, bodies, 3]  the part that is done already and is not limited; or null
  Batched<const T> floor;  // [1 | B, planes, 7]
  const bool* pinned;      // [V]
  int32_t planes;
};

// The arguments of above_floor() for one body.
template <class T>
struct DescendingBody {
  const AboveFloorInputs<T>& in;
  const rigid::Body<T>& b;
  Vector u;

  DIFFVBD_FN DescendingBody(const AboveFloorInputs<T>& inputs, const rigid::Body<T>& body)
      : in(inputs), b(body), u(in.u ? wide_at(in.u + 3 * index()) : Vector{0, 0, 0}) {}
  DIFFVBD_FN int64_t index() const { return b.scene * in.scene.bodies + b.body; }
  DIFFVBD_FN const T* plane(int32_t k) const {
    return in.floor.data + b.scene * in.floor.scene + kPlaneScalars * int64_t{k};
  }
  DIFFVBD_FN Vector at(int32_t i) const {
    const int32_t v = b.vertex(i);
    const Vector x = b.position(v) + u;
    const Batched<const T>& o = in.scene.origin;
    return o.data ? x + wide_at(o.data + b.scene * o.scene + 3 * int64_t{v}) : x;
  }
  DIFFVBD_FN Vector displacement(int32_t i) const { return wide_at(in.displacement + 3 * b.row(b.vertex(i))) - u; }
  DIFFVBD_FN bool counts(int32_t i) const { return !in.pinned[b.vertex(i)]; }
  DIFFVBD_FN Descent<T> descent(int32_t k, int32_t i) const { return Descent<T>(plane(k), at(i), displacement(i)); }
  template <class Team>
  DIFFVBD_FN AboveFloor found(const Team& team) const {
    return above_floor(
        team, b.size(), plane(0), in.planes, [&](int32_t i) { return at(i); },
        [&](int32_t i) { return displacement(i); }, [&](int32_t i) { return counts(i); });
  }
};

template <class T>
struct AboveFloorDisplacements {
  AboveFloorInputs<T> in;
  T* left;        // [B, V, 3]
  bool* stopped;  // [B, bodies]

  template <class Team>
  DIFFVBD_FN void operator()(const rigid::Body<T>& b, const Team& team) const {
    const DescendingBody<T> body(in, b);
    const AboveFloor found = body.found(team);
    if (team.leads()) stopped[body.index()] = found.stopped;
    team.each(b.size(), [&](int32_t i) { put(left + 3 * b.row(b.vertex(i)), found.left(body.displacement(i))); });
  }
};

// The adjoint of a deciding vertex, from those of its allowance and of its motion toward the plane.
struct DescentAdjoint {
  Vector at, displacement, n;
  double height, dhat;
  template <class T>
  DIFFVBD_FN DescentAdjoint(const Descent<T>& d, const Vector& p, const Vector& w, double allowance, double toward) {
    const double outside = d.gap < d.deep ? 0 : 1, inside = d.gap < d.deep ? 1 : d.deep < d.gap ? 0 : 0.5;
    const double gap = d.safe < 0 ? 0 : allowance * (kKept * outside + kKeptDeep * inside);
    at = gap * d.n;
    displacement = -toward * d.n;
    n = gap * p - toward * w;
    height = -gap;
    dhat = kDeep * allowance * (kKeptDeep * (1 - inside) - kKept * outside);
  }
};

template <class T>
struct ReverseAboveFloor {
  AboveFloorInputs<T> in;
  const T* left;  // of the output
  T *x, *u, *displacement;
  T* floor;  // [B, bodies, planes, 7], zero at first, or null where not wanted

  template <class Team>
  DIFFVBD_FN void operator()(const rigid::Body<T>& b, const Team& team) const {
    const DescendingBody<T> body(in, b);
    const AboveFloor found = body.found(team);
    double total[4];  // adjoints of the shift and of the fraction
    team.template sum<4>(b.size(), total, [&](int32_t i, double* to) {
      const int64_t row = 3 * b.row(b.vertex(i));
      const Vector bar = wide_at(left + row);
      put(x + row, Vector{0, 0, 0});
      put(displacement + row, found.fraction * bar);
      add_to(to, bar), to[3] += dot(bar, body.displacement(i));
    });
    const Vector shift{total[0], total[1], total[2]};
    Vector u_bar = -found.fraction * shift;
    const bool shifts = !(found.fraction < 1), binds = !shifts || 0 < dot(found.shift, found.shift);
    // deciding value of a plane: the largest excess, or the smallest fraction
    const auto value_of = [&](int32_t k) {
      return team.least(b.size(), [&](int32_t i) {
        if (!body.counts(i)) return 1.0;
        const Descent<T> d = body.descent(k, i);
        return shifts ? -d.excess() : d.fraction();
      });
    };
    double planes = 0;
    for (int32_t k = 0; k < in.planes && !shifts; ++k) planes += value_of(k) == found.fraction;
    for (int32_t k = 0; k < in.planes && binds; ++k) {
      const double value = value_of(k);
      if (shifts ? !(value < 0) : value != found.fraction) continue;
      const auto decides = [&](const Descent<T>& d) {
        return d.closes() && (shifts ? -d.excess() : d.fraction()) == value;
      };
      double ties[1];
      team.template sum<1>(b.size(), ties,
                           [&](int32_t i, double* to) { to[0] += body.counts(i) && decides(body.descent(k, i)); });
      const Vector n{body.plane(k)[0], body.plane(k)[1], body.plane(k)[2]};
      const double each = shifts ? dot(n, shift) / ties[0] : total[3] / (planes * ties[0]);
      double sum[8];
      team.template sum<8>(b.size(), sum, [&](int32_t i, double* to) {
        if (!body.counts(i)) return;
        const Descent<T> d = body.descent(k, i);
        if (!decides(d)) return;
        const DescentAdjoint bar(d, body.at(i), body.displacement(i), shifts ? -each : each / d.toward,
                                 shifts ? each : -each * d.fraction() / d.toward);
        const int64_t row = 3 * b.row(b.vertex(i));
        add_to(x + row, bar.at);
        add_to(displacement + row, bar.displacement);
        const Vector own = bar.at - bar.displacement;
        add_to(to, own);
        add_to(to + 3, bar.n), to[6] += bar.height, to[7] += bar.dhat;
      });
      u_bar += vector_at(sum);
      if (!floor || !team.leads()) continue;
      T* to = floor + (body.index() * in.planes + k) * kPlaneScalars;
      put(to, vector_at(sum + 3) + (shifts ? -value : 0.0) * shift);
      to[3] = T(sum[6]), to[kPlaneDhat] = T(sum[7]);
    }
    if (in.u && team.leads()) put(u + 3 * body.index(), u_bar);
  }
};

}  // namespace diffvbd::contact
