// Barriers of pairs, kLanes of one kind at a time (contact/pairs.h): the same arithmetic for each as for one alone.
#pragma once

#include "../contact/pairs.h"
#include "lanes.h"

namespace diffvbd {

// Rows of kLanes scalars that a kernel takes: corners 1 to 3 less corner 0, dhat, offset, threshold, the corner whose
// block it is; in the reverse also p and d_raw of that one. What it gives: whether the pair is active (0 or 1), then
// g, H; or the adjoints of the corners and of kappa.
constexpr int kPairGiven = 13, kTurnGiven = kPairGiven + 6, kPairBlock = 1 + 9, kPairBars = 1 + 13;

template <class T>
using PairKernel = void (*)(int kind, const T* given, T kappa, T h2, T* out);

template <class T>
struct PairKernels {
  PairKernel<T> add, reverse;
};

inline namespace DIFFVBD_SET {

// The corner of each lane.
template <class T>
struct LaneCorner {
  Lanes<T> own;
};
template <class T>
DIFFVBD_FN auto is_corner(const LaneCorner<T>& i, int k) {
  const Lanes<T> off = i.own - Lanes<T>(T(k));
  return off * off < Lanes<T>(T(0.5));
}
template <class T, class A>
DIFFVBD_FN A of_corner(const A (&a)[4], const LaneCorner<T>& i) {
  A out = a[0];
  for (int k = 1; k < 4; ++k) out = select(is_corner(i, k), a[k], out);
  return out;
}

// The rows of `given` as the functions of pairs take them.
template <class T>
struct LanePairs {
  using R = Lanes<T>;
  contact::Corners<R> corners;
  contact::PairConstants<R> constants;
  LaneCorner<T> own;

  DIFFVBD_FN static R row(const T* given, int i) { return R::load(given + i * kLanes); }
  DIFFVBD_FN static Vec3<R> rows(const T* given, int i) {
    return {row(given, i), row(given, i + 1), row(given, i + 2)};
  }
  DIFFVBD_FN explicit LanePairs(const T* given)
      : corners{{zero3<R>(), rows(given, 0), rows(given, 3), rows(given, 6)}},
        constants(row(given, 9), row(given, 10), row(given, 11)),
        own{row(given, 12)} {}
};

template <class M, class T>
DIFFVBD_FN void store_active(const M& active, T* out) {
  select(active, Lanes<T>(T(1)), Lanes<T>(T(0))).store(out);
}

template <class T>
__attribute__((flatten)) void add_lanes(int kind, const T* given, T kappa, T h2, T* out) {
  using R = Lanes<T>;
  const LanePairs<T> pairs(given);
  Vec3<R> g = zero3<R>();
  Sym3<R> H = diagonal(R(0));
  const auto active = contact::add_barrier(kind, pairs.corners, pairs.own, pairs.constants, R(kappa), R(h2), g, H);
  store_active(active, out);
  const R values[] = {g.x, g.y, g.z, H.xx, H.xy, H.xz, H.yy, H.yz, H.zz};
  for (int i = 0; i < 9; ++i) values[i].store(out + (1 + i) * kLanes);
}

template <class T>
__attribute__((flatten)) void reverse_lanes(int kind, const T* given, T kappa, T h2, T* out) {
  using R = Lanes<T>;
  const LanePairs<T> pairs(given);
  contact::PairAdjoint<R> bar{};
  const auto active = contact::reverse_barrier(kind, pairs.corners, pairs.own, pairs.constants, R(kappa), R(h2),
                                               pairs.rows(given, kPairGiven), pairs.rows(given, kPairGiven + 3), bar);
  store_active(active, out);
  if (!any(active)) return;
  for (int k = 0; k < 4; ++k) {
    const R values[] = {bar.x[k].x, bar.x[k].y, bar.x[k].z};
    for (int i = 0; i < 3; ++i) values[i].store(out + (1 + 3 * k + i) * kLanes);
  }
  bar.kappa.store(out + 13 * kLanes);
}

}  // namespace DIFFVBD_SET
}  // namespace diffvbd
