// How far a vertex may go without that two surfaces cross: as long as a plane keeps the sides of a pair apart, with the
// pair's own closest points, or with a direction that the neighbourhood suggests. A limit is a power of two, from 1
// down to 2^-7, or 0: it is decided, not differentiated (docs/method.md, section 12).
#pragma once

#include <cstdint>
#include <limits>

#include "pairs.h"

namespace diffvbd::contact {

constexpr int kNoMove = 8;                   // the exponent that stands for a limit of 0
constexpr double kBothShare = 0.45;          // of a gap that an update may close where both sides move
constexpr double kShare = 2 * kBothShare;    // and where the other one rests
constexpr double kStartLeast = 0.05;         // of any gap that what does not minimise the barrier may close
constexpr double kStartPart = 0.5;           // of dhat: such motion brings no pair closer
constexpr double kTight = 0.125;             // of that: a gap below it such motion closes no further,
constexpr double kTightest = 1e-6;           // or by so much of itself
constexpr double kGuardUlps = 32;            // roundings of a position, which a gap is not trusted to
constexpr double kClosedGuards = 1.0 / 128;  // of these, that a way along a gap may seem to close
constexpr double kTrusted = 0.25;            // of these, below which nothing goes; up to them, what does not close it

template <class T>
DIFFVBD_FN T least_of(T dhat) {
  return T(kStartPart) * dhat;
}

template <class T>
DIFFVBD_FN T limit_of(int exponent) {
  return exponent >= kNoMove ? T(0) : T(1) / T(1 << exponent);
}

// Corner k of a pair is of the first side if k is below this.
DIFFVBD_FN int sides(int kind) { return kind == kEdgeEdge ? 2 : 1; }

// Calls f(i, j) for corners i of the first side, which has so many, and j of the second. The loops have fixed ends, so
// that what they index stays in registers.
template <class F>
DIFFVBD_FN void each_across(int first, const F& f) {
  for (int i = 0; i < 2; ++i) {
    for (int j = 1; j < 4; ++j) {
      if (i < first && first <= j) f(i, j);
    }
  }
}

// How two sides lie along a direction m that points from the second to the first.
template <class R>
struct Separation {
  R gap;       // between the lowest corner of the first and the highest of the second, less the radii [m]
  R slack[4];  // how far behind that one each corner lies [m]
  Separation() = default;
  DIFFVBD_FN Separation(int kind, const Corners<R>& c, const Vec3<R>& m, const R& offset) {
    const int first = sides(kind);
    R h[4], lowest = R(std::numeric_limits<float>::infinity()), highest = -lowest;
    for (int k = 0; k < 4; ++k) {
      h[k] = dot(m, c.x[k]);
      if (k < first) lowest = select(h[k] < lowest, h[k], lowest);
      if (k >= first) highest = select(highest < h[k], h[k], highest);
    }
    for (int k = 0; k < 4; ++k) slack[k] = k < first ? h[k] - lowest : highest - h[k];
    gap = lowest - highest - offset;
  }
};

// What one corner of a pair may do while the others rest: the first of the questions that a Gate asks.
template <class T>
struct Clearance {
  Vec3<T> toward;  // in which direction the corner closes the gap
  T gap, slack;    // along that direction [m]
  DIFFVBD_FN bool holds(const Vec3<T>& d, T share, T guard) const {
    const T wide = gap - guard;
    return T(0) < wide && dot(toward, d) <= slack + share * wide;
  }
};

// The exponent of a limit that keeps a vertex `offset` from the center of its room within the room.
template <class T>
DIFFVBD_FN int limit_by_room(const Vec3<T>& offset, const Vec3<T>& d, T room) {
  int exponent = 0;
  while (exponent < kNoMove) {
    const Vec3<T> end = offset + limit_of<T>(exponent) * d;
    if (dot(end, end) <= room * room) break;
    ++exponent;
  }
  return exponent;
}

// What a listed pair knows beside its constants: the direction of the nearest gap around it and that gap, and the gap
// of the pair itself, when it was found.
template <class T>
struct PairHints {
  Vec3<T> star;
  T nearest, gap;
  DIFFVBD_FN explicit PairHints(const T* a) : star{a[3], a[4], a[5]}, nearest(a[6]), gap(a[7]) {}
};

// A direction across both sides that does not depend on where they end.
template <class T>
DIFFVBD_FN Vec3<T> across(int kind, const Corners<T>& c) {
  const Vec3<T> n =
      kind == kEdgeEdge ? cross(c.x[1] - c.x[0], c.x[3] - c.x[2]) : cross(c.x[2] - c.x[1], c.x[3] - c.x[1]);
  const T size2 = dot(n, n), scale = T(0) < size2 ? T(1) / square_root(size2) : T(0);
  const T toward = dot(n, c.x[0] - c.x[2]);
  return (toward < T(0) ? -scale : scale) * n;
}

// Whether corners that move by d[k], each as far as its share of the gap lets it, keep the sides apart along m, where
// these lie as s says. guard: of their gap; bounded: no closer than `least`, or by but a little.
template <class T>
DIFFVBD_FN bool holds_along(int kind, const Vec3<T>& m, const Separation<T>& s, T guard, T least, const Vec3<T> (&d)[4],
                            const T (&share)[4], bool bounded, bool careful) {
  if (!(T(kTrusted) * guard < s.gap)) return false;
  const T wide = guard < s.gap ? s.gap - guard : T(0), rounded = T(kClosedGuards) * guard;
  const T some = T(careful && wide < T(kTight) * least ? kTightest : kStartLeast) * wide;
  for (int k = 0; k < 4; ++k) {
    const T toward = k < sides(kind) ? -dot(m, d[k]) : dot(m, d[k]);
    T room = share[k] * wide;
    if (bounded) {
      const T outside = share[k] * (wide - least);
      room = some < outside ? outside : some;
    }
    if (!(toward <= s.slack[k] + (room + rounded))) return false;
  }
  return true;
}

// One pair as it is now, and what motions of its corners it lets pass.
template <class T>
struct Gate {
  int kind;
  Corners<T> corners;
  PairConstants<T> constants;
  PairHints<T> hints;
  Vec3<T> n;
  T gap, guard;

  // guard: what rounding may make of a height [m]
  DIFFVBD_FN Gate(int pair_kind, const Corners<T>& c, const T* a, T rounding)
      : kind(pair_kind), corners(c), constants(a), hints(a), guard(rounding) {
    const Distance<T> at = distance(kind, c);
    n = at.n;
    gap = at.d - constants.offset;
  }
  DIFFVBD_FN T least() const { return least_of(constants.dhat); }

  // Whether corners that move by d[k], each as far as its share of the gap lets it, keep the sides apart along m.
  // careful: the motion does not minimise the barrier.
  DIFFVBD_FN bool holds(const Vec3<T>& m, const Vec3<T> (&d)[4], const T (&share)[4], bool careful, bool own) const {
    const Separation<T> s(kind, corners, m, constants.offset);
    const T wide = s.gap - guard;
    // other directions than that of the closest points must keep what is near
    const T near = hints.nearest < least() ? hints.nearest : least();
    if (!own && !(T(0.5) * near < wide)) return false;
    return holds_along(kind, m, s, guard, least(), d, share, careful || !own, careful);
  }
  DIFFVBD_FN bool holds(const Vec3<T> (&d)[4], const T (&share)[4], bool careful) const {
    if (holds(n, d, share, careful, true)) return true;
    if (kind == kPointPlane) return false;  // which ends nowhere
    return holds(hints.star, d, share, careful, false) || holds(across(kind, corners), d, share, careful, false);
  }
};

// Whether corners that move along straight lines, all at once, by d[k], stay apart: steps that the gap proves safe, one
// after another.
constexpr int kAdvances = 8;
template <class T>
DIFFVBD_FN bool stays_apart(const Gate<T>& g, const Vec3<T> (&d)[4], bool careful) {
  Vec3<T> mean = zero3<T>(), relative[4];
  for (int k = 0; k < 4; ++k) mean += T(0.25) * d[k];
  T one = T(0), other = T(0);
  for (int k = 0; k < 4; ++k) {
    relative[k] = d[k] - mean;
    const T size = square_root(dot(relative[k], relative[k]));
    const bool is_first = k < sides(g.kind);
    one = is_first && one < size ? size : one;
    other = !is_first && other < size ? size : other;
  }
  const T total = one + other, wide = g.gap - g.guard, least = g.least();
  if (g.kind == kPointPlane || !(T(0) < wide)) return false;
  // it may come as close as a start may bring it, and a little closer where it is close already
  const T half = T(1 - kBothShare) * wide, most = least < half ? half : least;
  const T part = wide < T(kTight) * least ? T(1) : T(1 - 2 * kStartLeast);
  const T keeps = !careful ? half : part * wide < most ? part * wide : most;
  const auto gap_at = [&](T time) {
    Corners<T> moved = g.corners;
    for (int k = 0; k < 4; ++k) moved.x[k] += time * relative[k];
    return distance(g.kind, moved).d - g.constants.offset - g.guard;
  };
  T time = T(0), now = wide;
  for (int i = 0; i < kAdvances; ++i) {
    if (!(keeps < now)) return total * (T(1) - time) <= T(0);
    time = time + (now - keeps) / total;
    if (!(time < T(1))) return true;
    // most pairs that come too close are too close at the end of their way: one distance tells
    if (i == 0 && gap_at(T(1)) < keeps) return false;
    now = gap_at(time);
  }
  return false;
}

}  // namespace diffvbd::contact

namespace diffvbd {

// A first answer to whether a pair can matter, of which most pairs need no second: by how far each of its vertices may
// be from where gaps were taken.

// By how much the gap of a pair may have shrunk since it was taken, at most. bound [V], of its scene. Infinity where a
// corner is of a collider, whose gap may be of another time.
template <class T>
T most_closed(const int32_t* record, int32_t vertices, const T* bound) {
  const int first = contact::sides(record[4]);
  T most[2] = {T(0), T(0)};
  for (int k = 0; k < 4; ++k) {
    if (record[k] >= vertices) return std::numeric_limits<T>::infinity();
    T& side = most[k < first ? 0 : 1];
    side = side < bound[record[k]] ? bound[record[k]] : side;
  }
  return most[0] + most[1];
}

}  // namespace diffvbd
