// The largest step fraction of a vertex for which no two surfaces cross: a plane keeps the sides of a pair apart, by
// the pair's closest points or by a direction that the neighbourhood suggests. A limit is 1, 1/2, ... 2^-7, or 0: it is
// decided, not differentiated (docs/method.md, section 12).
#pragma once

#include <cstdint>
#include <limits>

#include "pairs.h"

namespace diffvbd::contact {

constexpr int kNoMove = 8;                             // the exponent that stands for a limit of 0
constexpr double kBothGapFraction = 0.45;              // of a gap that an update may close where both sides move
constexpr double kGapFraction = 2 * kBothGapFraction;  // and where one side moves
constexpr double kLeastTrial = 1.0 / 64;               // the smallest fraction of a start that is tried, but for 0
constexpr double kStartLeast = 0.05;         // of any gap that a motion may close which does not minimise the barrier
constexpr double kStartFraction = 0.5;       // of dhat: such a motion brings no pair closer
constexpr double kTight = 0.125;             // of that: it closes a smaller gap no further,
constexpr double kTightest = 1e-6;           // or by so much of itself
constexpr double kGuardUlps = 32;            // roundings of a position, the uncertainty of a gap
constexpr double kClosedGuards = 1.0 / 128;  // of these, that a displacement along a gap may seem to close
constexpr double kTrusted = 0.25;            // of these: below, nothing moves; up to them, what does not close the gap

template <class T>
DIFFVBD_FN T least_of(T dhat) {
  return T(kStartFraction) * dhat;
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
    R h[4], minimum = R(std::numeric_limits<float>::infinity()), maximum = -minimum;
    for (int k = 0; k < 4; ++k) {
      h[k] = dot(m, c.x[k]);
      if (k < first) minimum = select(h[k] < minimum, h[k], minimum);
      if (k >= first) maximum = select(maximum < h[k], h[k], maximum);
    }
    for (int k = 0; k < 4; ++k) slack[k] = k < first ? h[k] - minimum : maximum - h[k];
    gap = minimum - maximum - offset;
  }
};

// The largest motion of one corner while the others rest: the first test of a Gate.
template <class T>
struct Clearance {
  Vec3<T> toward;  // in which direction the corner closes the gap
  T gap, slack;    // along that direction [m]
  DIFFVBD_FN bool holds(const Vec3<T>& d, T fraction, T guard) const {
    const T wide = gap - guard;
    return T(0) < wide && dot(toward, d) <= slack + fraction * wide;
  }
};

// The exponent of a limit that keeps a vertex, `offset` from the center of its trust region, within the radius.
template <class T>
DIFFVBD_FN int limit_by_radius(const Vec3<T>& offset, const Vec3<T>& d, T trust_radius) {
  int exponent = 0;
  while (exponent < kNoMove) {
    const Vec3<T> end = offset + limit_of<T>(exponent) * d;
    if (dot(end, end) <= trust_radius * trust_radius) break;
    ++exponent;
  }
  return exponent;
}

// The hints of a listed pair: direction and size of the nearest gap around it, and its own gap, at the detection.
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

// Whether corners that move by d[k], each within its fraction of the gap, keep the sides apart along m, where these lie
// as in s. guard: uncertainty of the gap; bounded: no closer than `least`, or only slightly.
template <class T>
DIFFVBD_FN bool holds_along(int kind, const Vec3<T>& m, const Separation<T>& s, T guard, T least, const Vec3<T> (&d)[4],
                            const T (&fraction)[4], bool bounded, bool careful) {
  if (!(T(kTrusted) * guard < s.gap)) return false;
  const T wide = guard < s.gap ? s.gap - guard : T(0), rounded = T(kClosedGuards) * guard;
  const T some = T(careful && wide < T(kTight) * least ? kTightest : kStartLeast) * wide;
  for (int k = 0; k < 4; ++k) {
    const T toward = k < sides(kind) ? -dot(m, d[k]) : dot(m, d[k]);
    T allowance = fraction[k] * wide;
    if (bounded) {
      const T outside = fraction[k] * (wide - least);
      allowance = some < outside ? outside : some;
    }
    if (!(toward <= s.slack[k] + (allowance + rounded))) return false;
  }
  return true;
}

// One pair at its current positions, and the motions that it admits.
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

  // The same along m. careful: the motion does not minimise the barrier.
  DIFFVBD_FN bool holds(const Vec3<T>& m, const Vec3<T> (&d)[4], const T (&fraction)[4], bool careful, bool own) const {
    const Separation<T> s(kind, corners, m, constants.offset);
    const T wide = s.gap - guard;
    // a direction other than that of the closest points must keep small gaps
    const T near = hints.nearest < least() ? hints.nearest : least();
    if (!own && !(T(0.5) * near < wide)) return false;
    return holds_along(kind, m, s, guard, least(), d, fraction, careful || !own, careful);
  }
  DIFFVBD_FN bool holds(const Vec3<T> (&d)[4], const T (&fraction)[4], bool careful) const {
    if (holds(n, d, fraction, careful, true)) return true;
    if (kind == kPointPlane) return false;  // which ends nowhere
    return holds(hints.star, d, fraction, careful, false) || holds(across(kind, corners), d, fraction, careful, false);
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
  // as close as a start may bring it, and slightly closer where it is close already
  const T half = T(1 - kBothGapFraction) * wide, most = least < half ? half : least;
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
    // most pairs that come too close are too close at the end: one distance tells
    if (i == 0 && gap_at(T(1)) < keeps) return false;
    now = gap_at(time);
  }
  return false;
}

// An upper bound of how much the gap of a pair has shrunk since it was taken, by that of each vertex, bound [V] of its
// scene: most pairs need no other test. Infinity where a corner is of a collider, whose gap may be older.
template <class T>
T most_closed(const int32_t* record, int32_t vertices, const T* bound) {
  const int first = sides(record[4]);
  T most[2] = {T(0), T(0)};
  for (int k = 0; k < 4; ++k) {
    if (record[k] >= vertices) return std::numeric_limits<T>::infinity();
    T& side = most[k < first ? 0 : 1];
    side = side < bound[record[k]] ? bound[record[k]] : side;
  }
  return most[0] + most[1];
}

}  // namespace diffvbd::contact
