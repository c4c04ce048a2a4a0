// What the planes of a floor leave of the way of a body that moves as a whole: it is shifted along their normals until
// no vertex closes more than a part of its gap, which leaves sliding and turning as they are. Where no shift suits all
// planes, the way is shortened (docs/method.md, section 12). In double, whatever the dtype of the scene.
#pragma once

#include <limits>

#include "../rigid/rotation.h"
#include "lowest.h"

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

}  // namespace diffvbd::contact
