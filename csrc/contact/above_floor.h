// What the planes of a floor leave of the way of a body that moves as a whole: it is shifted along their normals until
// no vertex closes more than a part of its gap, which leaves sliding and turning as they are. Where no shift suits all
// planes, the way is shortened (docs/method.md, section 12). In double, whatever the dtype of the scene.
#pragma once

#include <limits>

#include "../core/rotation.h"
#include "../sweep/body.h"
#include "islands.h"

namespace diffvbd::contact {

using rigid::Vector;

constexpr double kShort = 0.99;                 // share of a way that counts as all of it
constexpr double kKept = 0.9;                   // share of a gap above a floor that rigid motion may close
constexpr double kDeep = 0.1, kKeptDeep = 0.1;  // part of dhat below which that is less: sweeps open such gaps slowly
constexpr double kRoundings = 8;                // of the terms of a gap, as FloorBarrier::Plane::guard()
constexpr int kPlaneDhat = 5;                   // which number of a plane is its dhat

// One vertex above one plane: how far it goes toward the plane, and how far it may [m]. What is no number makes both
// comparisons below false. T: of the scene, whose rounding counts.
template <class T>
struct Descent {
  Vector n;
  double safe, gap, deep, room, toward;  // gap less rounding, the same but not below 0, part of dhat

  // Not inlined: who decides is found by comparing bits, and a device compiler may round inlined copies differently.
  DIFFVBD_APART Descent(const T* plane, const Vector& at, const Vector& way) : n{plane[0], plane[1], plane[2]} {
    const double height = plane[3], size = absolute(n.x) * absolute(at.x) + absolute(n.y) * absolute(at.y) +
                                           absolute(n.z) * absolute(at.z) + absolute(height);
    safe = dot(n, at) - height - kRoundings * std::numeric_limits<T>::epsilon() * size;
    gap = safe < 0 ? 0 : safe;
    deep = kDeep * plane[kPlaneDhat];
    room = kKept * (gap < deep ? 0 : gap - deep) + kKeptDeep * (deep < gap ? deep : gap);
    toward = -dot(n, way);
  }
  DIFFVBD_FN bool closes() const { return room < toward; }
  DIFFVBD_FN double excess() const { return closes() ? toward - room : 0; }
  DIFFVBD_FN double share() const { return closes() ? room / toward : 1; }
  DIFFVBD_FN bool clears(const Vector& shift) const {
    const double rounding = kRoundings * std::numeric_limits<T>::epsilon() *
                            (absolute(toward) + absolute(shift.x) + absolute(shift.y) + absolute(shift.z));
    return toward - dot(n, shift) <= room + rounding;
  }
};

struct AboveFloor {
  double share;  // 1 but between planes that no shift suits
  Vector shift;
  bool stopped;  // it loses more than a hundredth of what a vertex moves toward a plane

  DIFFVBD_FN Vector left(const Vector& way) const { return share * way + shift; }
};

// The largest f(i) of a body, of which none may be NaN: least() of a device would drop it.
template <class Team, class F>
DIFFVBD_FN double most(const Team& team, int32_t size, const F& f) {
  return -team.least(size, [&](int32_t i) { return -f(i); });
}

// How far beyond its room a vertex of the body goes at most.
template <class T, class Team, class At, class Way, class Counts>
DIFFVBD_FN double excess_over(const Team& team, int32_t size, const T* plane, const At& at, const Way& way,
                              const Counts& counts) {
  return most(team, size, [&](int32_t i) { return counts(i) ? Descent<T>(plane, at(i), way(i)).excess() : 0.0; });
}

// planes: `count` as in the data of FloorBarrier. Of the i-th of `size` vertices of a body: where it is [m], its way
// [m], and false for what is held.
template <class T, class Team, class At, class Way, class Counts>
DIFFVBD_FN AboveFloor above_floor(const Team& team, int32_t size, const T* planes, int32_t count, At&& at, Way&& way,
                                  Counts&& counts) {
  AboveFloor out{1, Vector{0, 0, 0}, false};
  const double share = team.least(size, [&](int32_t i) {
    double least = 1;
    if (!counts(i)) return least;
    const Vector own_at = at(i), own_way = way(i);
    for (int32_t k = 0; k < count; ++k) {
      const double own = Descent<T>(planes + kPlaneScalars * k, own_at, own_way).share();
      least = own < least ? own : least;
    }
    return least;
  });
  if (!(share < 1)) return out;  // nothing closes more than it may
  out.stopped = share < kShort;
  Vector shift{0, 0, 0};
  for (int32_t k = 0; k < count; ++k) {
    const T* plane = planes + kPlaneScalars * k;
    shift += excess_over(team, size, plane, at, way, counts) * Vector{plane[0], plane[1], plane[2]};
  }
  const double clear = team.least(size, [&](int32_t i) {
    bool clears = true;
    if (!counts(i)) return 1.0;
    const Vector own_at = at(i), own_way = way(i);
    for (int32_t k = 0; k < count; ++k) {
      clears = clears && Descent<T>(planes + kPlaneScalars * k, own_at, own_way).clears(shift);
    }
    return clears ? 1.0 : 0.0;
  });
  if (0 < clear) {
    out.shift = shift;
  } else {
    out.share = share;
  }
  return out;
}

// What a floor leaves of the ways of all bodies that move as wholes (contact/above_floor.h), and the adjoint. Where
// several vertices or planes decide alike, they share it evenly.

template <class T>
struct AboveFloorInputs {
  rigid::Inputs<T> scene;  // x, origin and the vertices of all bodies
  const T* way;            // [B, V, 3]  from x
  const T* u;              // [B, bodies, 3]  the part of it that is behind, which the floor lets pass; or null
  Batched<const T> floor;  // [1 | B, planes, 7]
  const bool* held;        // [V]
  int32_t planes;
};

// One body as above_floor() asks for it.
template <class T>
struct DescendingBody {
  const AboveFloorInputs<T>& in;
  const rigid::Body<T>& b;
  Vector u;

  DIFFVBD_FN DescendingBody(const AboveFloorInputs<T>& inputs, const rigid::Body<T>& body)
      : in(inputs), b(body), u(in.u ? body.at(in.u + 3 * index()) : Vector{0, 0, 0}) {}
  DIFFVBD_FN int64_t index() const { return b.scene * in.scene.bodies + b.body; }
  DIFFVBD_FN const T* plane(int32_t k) const {
    return in.floor.data + b.scene * in.floor.scene + kPlaneScalars * int64_t{k};
  }
  DIFFVBD_FN Vector at(int32_t i) const {
    const int32_t v = b.vertex(i);
    const Vector x = b.position(v) + u;
    const Batched<const T>& o = in.scene.origin;
    return o.data ? x + b.at(o.data + b.scene * o.scene + 3 * int64_t{v}) : x;
  }
  DIFFVBD_FN Vector way(int32_t i) const { return b.at(in.way + 3 * b.row(b.vertex(i))) - u; }
  DIFFVBD_FN bool counts(int32_t i) const { return !in.held[b.vertex(i)]; }
  DIFFVBD_FN Descent<T> descent(int32_t k, int32_t i) const { return Descent<T>(plane(k), at(i), way(i)); }
  template <class Team>
  DIFFVBD_FN AboveFloor found(const Team& team) const {
    return above_floor(
        team, b.size(), plane(0), in.planes, [&](int32_t i) { return at(i); }, [&](int32_t i) { return way(i); },
        [&](int32_t i) { return counts(i); });
  }
};

template <class T>
struct AboveFloorWays {
  AboveFloorInputs<T> in;
  T* left;        // [B, V, 3]
  bool* stopped;  // [B, bodies]

  template <class Team>
  DIFFVBD_FN void operator()(const rigid::Body<T>& b, const Team& team) const {
    const DescendingBody<T> body(in, b);
    const AboveFloor found = body.found(team);
    if (team.leads()) stopped[body.index()] = found.stopped;
    team.each(b.size(), [&](int32_t i) { rigid::put(left + 3 * b.row(b.vertex(i)), found.left(body.way(i))); });
  }
};

// The adjoint of one vertex that decides what a plane does, of the adjoints of its room and of its motion toward it.
struct DescentAdjoint {
  Vector at, way, n;
  double height, dhat;
  template <class T>
  DIFFVBD_FN DescentAdjoint(const Descent<T>& d, const Vector& p, const Vector& w, double room, double toward) {
    const double outside = d.gap < d.deep ? 0 : 1, inside = d.gap < d.deep ? 1 : d.deep < d.gap ? 0 : 0.5;
    const double gap = d.safe < 0 ? 0 : room * (kKept * outside + kKeptDeep * inside);
    at = gap * d.n;
    way = -toward * d.n;
    n = gap * p - toward * w;
    height = -gap;
    dhat = kDeep * room * (kKeptDeep * (1 - inside) - kKept * outside);
  }
};

template <class T>
struct ReverseAboveFloor {
  AboveFloorInputs<T> in;
  const T* left;  // of the output
  T *x, *u, *way;
  T* floor;  // [B, bodies, planes, 7], zero at first, or null where not wanted

  template <class Team>
  DIFFVBD_FN void operator()(const rigid::Body<T>& b, const Team& team) const {
    const DescendingBody<T> body(in, b);
    const AboveFloor found = body.found(team);
    double total[4];  // adjoints of the shift and of the share
    team.template sum<4>(b.size(), total, [&](int32_t i, double* to) {
      const int64_t row = 3 * b.row(b.vertex(i));
      const Vector bar = b.at(left + row);
      rigid::put(x + row, Vector{0, 0, 0});
      rigid::put(way + row, found.share * bar);
      to[0] += bar.x, to[1] += bar.y, to[2] += bar.z, to[3] += dot(bar, body.way(i));
    });
    const Vector shift{total[0], total[1], total[2]};
    Vector u_bar = -found.share * shift;
    const bool shifts = !(found.share < 1), binds = !shifts || 0 < dot(found.shift, found.shift);
    // what decides on a plane: its largest excess, or the smallest share, which several may have
    const auto value_of = [&](int32_t k) {
      return team.least(b.size(), [&](int32_t i) {
        if (!body.counts(i)) return 1.0;
        const Descent<T> d = body.descent(k, i);
        return shifts ? -d.excess() : d.share();
      });
    };
    double planes = 0;
    for (int32_t k = 0; k < in.planes && !shifts; ++k) planes += value_of(k) == found.share;
    for (int32_t k = 0; k < in.planes && binds; ++k) {
      const double value = value_of(k);
      if (shifts ? !(value < 0) : value != found.share) continue;
      const auto decides = [&](const Descent<T>& d) {
        return d.closes() && (shifts ? -d.excess() : d.share()) == value;
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
        const DescentAdjoint bar(d, body.at(i), body.way(i), shifts ? -each : each / d.toward,
                                 shifts ? each : -each * d.share() / d.toward);
        const int64_t row = 3 * b.row(b.vertex(i));
        rigid::add_to(x + row, bar.at);
        rigid::add_to(way + row, bar.way);
        const Vector own = bar.at - bar.way;
        to[0] += own.x, to[1] += own.y, to[2] += own.z;
        to[3] += bar.n.x, to[4] += bar.n.y, to[5] += bar.n.z, to[6] += bar.height, to[7] += bar.dhat;
      });
      u_bar += Vector{sum[0], sum[1], sum[2]};
      if (!floor || !team.leads()) continue;
      T* to = floor + (body.index() * in.planes + k) * kPlaneScalars;
      rigid::put(to, Vector{sum[3], sum[4], sum[5]} + (shifts ? -value : 0.0) * shift);
      to[3] = T(sum[6]), to[kPlaneDhat] = T(sum[7]);
    }
    if (in.u && team.leads()) rigid::put(u + 3 * body.index(), u_bar);
  }
};

}  // namespace diffvbd::contact
