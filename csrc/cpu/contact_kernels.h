// Barriers of pairs, kLanes of one kind at a time (contact/pairs.h): the same arithmetic for each as for one alone.
#pragma once

#include "../contact/limit.h"
#include "lanes.h"

namespace diffvbd {

// The input of a kernel: of each lane the rows of four scalars that hold its corners and, unless null, their origins;
// the
// pair's constants; the corner whose block it is and how many move together with it; in the reverse p and d_raw of that
// one, kLanes apart.
template <class T>
struct PairPack {
  const T *x[4][kLanes], *origin[4][kLanes];
  const T* constants[kLanes];
  T own[kLanes], together[kLanes];
  const T* turn[kLanes];
};
// The result for each lane, in rows of four scalars: g; H, in two rows; the Clearance of the corner: toward; then 1
// if the pair is active, else 0, and gap and slack. Or, in the reverse, the adjoints of the corners; then active and
// the adjoint of kappa.
constexpr int kPairResult = 5 * 4;
enum PairResult { kPairBlock = 0, kPairToward = 12, kPairActive = 16, kPairGap = 17, kPairSlack = 18, kPairKappa = 17 };

template <class T>
using PairKernel = void (*)(int kind, const PairPack<T>& pack, T kappa, T h2, T* const* out);

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

template <class T>
DIFFVBD_FN Vec3<Lanes<T>> gathered(const T* const (&rows)[kLanes]) {
  Row<T> r[kLanes];
  for (int l = 0; l < kLanes; ++l) r[l] = Row<T>::load(rows[l]);
  return to_lanes(r);
}
template <class T>
DIFFVBD_FN void store_row(const Vec3<Lanes<T>>& v, T* const* out, int at) {
  Row<T> r[kLanes];
  to_rows(v, r);
  for (int l = 0; l < kLanes; ++l) r[l].store(out[l] + at);
}

// A pack as the functions of pairs take it.
template <class T>
struct LanePairs {
  using R = Lanes<T>;
  contact::Corners<R> corners;
  Vec3<R> constants;
  LaneCorner<T> own;

  DIFFVBD_FN explicit LanePairs(const PairPack<T>& pack) : constants(gathered(pack.constants)), own{R::load(pack.own)} {
    const Vec3<R> x0 = gathered(pack.x[0]);
    corners.x[0] = zero3<R>();
    for (int k = 1; k < 4; ++k) corners.x[k] = gathered(pack.x[k]) - x0;
    if (pack.origin[0][0] == nullptr) return;
    const Vec3<R> o0 = gathered(pack.origin[0]);
    for (int k = 1; k < 4; ++k) corners.x[k] += gathered(pack.origin[k]) - o0;
  }
  DIFFVBD_FN contact::PairConstants<R> of_pairs() const { return {constants.x, constants.y, constants.z}; }
};

template <class M, class T>
DIFFVBD_FN Lanes<T> one_where(const M& active) {
  return select(active, Lanes<T>(T(1)), Lanes<T>(T(0)));
}

template <class T>
__attribute__((flatten)) void add_lanes(int kind, const PairPack<T>& pack, T kappa, T h2, T* const* out) {
  using R = Lanes<T>;
  const LanePairs<T> pairs(pack);
  const contact::PairConstants<R> constants = pairs.of_pairs();
  const contact::Distance<R> at = contact::distance(kind, pairs.corners);
  Vec3<R> g = zero3<R>();
  Sym3<R> H = diagonal(R(0));
  const auto active = contact::add_barrier(kind, pairs.corners, at, pairs.own, R::load(pack.together), constants,
                                           R(kappa), R(h2), g, H);
  const contact::Separation<R> s(kind, pairs.corners, at.n, constants.offset);
  const R side = select(pairs.own.own < R(T(contact::sides(kind)) - T(0.5)), R(T(-1)), R(T(1)));
  store_row(g, out, kPairBlock);
  store_row(Vec3<R>{H.xx, H.xy, H.xz}, out, kPairBlock + 4);
  store_row(Vec3<R>{H.yy, H.yz, H.zz}, out, kPairBlock + 8);
  store_row(side * at.n, out, kPairToward);
  store_row(Vec3<R>{one_where<decltype(active), T>(active), s.gap, of_corner(s.slack, pairs.own)}, out, kPairActive);
}

template <class T>
__attribute__((flatten)) void reverse_lanes(int kind, const PairPack<T>& pack, T kappa, T h2, T* const* out) {
  using R = Lanes<T>;
  const LanePairs<T> pairs(pack);
  R turn[6];
  for (int i = 0; i < 6; ++i) {
    for (int l = 0; l < kLanes; ++l) turn[i].v[l] = pack.turn[l][i * kLanes];
  }
  contact::PairAdjoint<R> bar{};
  const auto active =
      contact::reverse_barrier(kind, pairs.corners, pairs.own, R::load(pack.together), pairs.of_pairs(), R(kappa),
                               R(h2), Vec3<R>{turn[0], turn[1], turn[2]}, Vec3<R>{turn[3], turn[4], turn[5]}, bar);
  store_row(Vec3<R>{one_where<decltype(active), T>(active), bar.kappa, R(0)}, out, kPairActive);
  if (!any(active)) return;
  for (int k = 0; k < 4; ++k) store_row(bar.x[k], out, 4 * k);
}

}  // namespace DIFFVBD_SET

// Boxes of triangles compared with that of an edge, a pack at a time.

constexpr int kBoxLanes = 16;

// Rows of `stride` numbers, one for each box: lower corners x, y, z and upper ones; the triangles' vertices. They are
// filled up to whole packs.
struct BoxRows {
  const float* sides;
  const int32_t* corners;
  int64_t stride;
  int count;
};
// Numbers of the boxes that overlap another [lower, upper corner] and share no vertex with an edge; returns how many.
using OverlapKernel = int (*)(const BoxRows&, const float* box, const int32_t* ends, int32_t* out);

inline namespace DIFFVBD_SET {

inline int overlap_boxes(const BoxRows& in, const float* box, const int32_t* ends, int32_t* out) {
  using Floats = float __attribute__((vector_size(4 * kBoxLanes)));
  using Bits = int32_t __attribute__((vector_size(4 * kBoxLanes)));
  using Bytes = int8_t __attribute__((vector_size(kBoxLanes)));
  int found = 0;
  for (int first = 0; first < in.count; first += kBoxLanes) {
    Bits apart{};
    for (int k = 0; k < 3; ++k) {
      Floats lower, upper;
      Bits corner;
      std::memcpy(&lower, in.sides + k * in.stride + first, sizeof lower);
      std::memcpy(&upper, in.sides + (3 + k) * in.stride + first, sizeof upper);
      std::memcpy(&corner, in.corners + k * in.stride + first, sizeof corner);
      apart |= (lower > box[3 + k]) | (box[k] > upper) | (corner == ends[0]) | (corner == ends[1]);
    }
    const Bytes bytes = __builtin_convertvector(apart, Bytes);
    uint64_t halves[2];
    std::memcpy(halves, &bytes, sizeof halves);
    for (int half = 0; half < 2; ++half) {
      constexpr uint64_t each = 0x0101010101010101;
      for (uint64_t near = ~halves[half] & each; near != 0; near &= near - 1) {
        out[found++] = first + 8 * half + __builtin_ctzll(near) / 8;
      }
    }
  }
  return found;
}

}  // namespace DIFFVBD_SET

}  // namespace diffvbd
