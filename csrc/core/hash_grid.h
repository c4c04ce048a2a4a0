// A uniform grid without bounds: cells are hashed to a table so that three neighbors along z stay adjacent.
//
// The hash is linear, bucket(X, Y, Z) = X kX + Y kY + Z modulo a power of two, so the 27 cells around a point are nine
// runs of three adjacent buckets. They never overlap, and what else falls into a bucket is told apart by its distance.
#pragma once

#include <cstdint>

#include "vec.h"

namespace diffvbd {

struct HashGrid {
  // Chosen by search among odd numbers: for tables of 2^8 to 2^28 buckets the shortest vector between two cells of one
  // bucket is at least 0.4 of the longest possible, in space and in each coordinate plane.
  static constexpr uint32_t kX = 0x0a37bc21, kY = 0x3e566d27, kScene = 0x9e3779b1;
  static constexpr int kMinBits = 8, kMaxBits = 27, kRuns = 9;

  double inverse_cell, period, inverse_period;  // period: the length after which cells repeat, 2^bits cells
  uint32_t mask;

  HashGrid(double radius, int64_t points) {
    int bits = kMinBits;
    while (bits < kMaxBits && (int64_t{1} << bits) < 2 * points) ++bits;
    // A little more than the radius: no rounding may put two points within it more than one cell apart.
    const double cell = radius * (1 + 0x1p-16);
    inverse_cell = 1 / cell;
    period = cell * static_cast<double>(int64_t{1} << bits);
    inverse_period = 1 / period;
    mask = (uint32_t{1} << bits) - 1;
  }

  DIFFVBD_FN uint32_t buckets() const { return mask + 1; }

  // Index of the cell modulo the number of buckets. The remainder of the period is exact to 2^-23 cells however far
  // away x is. Beyond 2^50 periods numbers are further apart than a cell, so that only equal ones are neighbors.
  DIFFVBD_FN uint32_t cell(double x) const {
    const double periods = std::floor(x * inverse_period);
    if (!(absolute(periods) < 0x1p50)) return 0;
    return static_cast<uint32_t>(static_cast<int64_t>(std::floor(std::fma(-periods, period, x) * inverse_cell)));
  }

  template <class T>
  DIFFVBD_FN uint32_t bucket(const T* p, uint32_t scene) const {
    return (cell(p[0]) * kX + cell(p[1]) * kY + cell(p[2]) + scene * kScene) & mask;
  }

  // First of the three buckets of run k around a bucket; the run goes on at 0 after the last bucket.
  DIFFVBD_FN uint32_t run(uint32_t home, int k) const {
    return (home + static_cast<uint32_t>(k / 3 - 1) * kX + static_cast<uint32_t>(k % 3 - 1) * kY - 1) & mask;
  }

  // visit(begin, end) for every range of points, sorted by bucket, that may lie within the radius of one in `home`.
  // start[b]: the first point of bucket b; start[buckets()]: the number of points.
  template <class F>
  DIFFVBD_FN void each_range(uint32_t home, const int32_t* start, const F& visit) const {
    for (int k = 0; k < kRuns; ++k) {
      const uint32_t first = run(home, k), last = first + 3;
      visit(start[first], start[last <= buckets() ? last : buckets()]);
      if (last > buckets()) visit(0, start[last - buckets()]);
    }
  }
};

// A point among those sorted by bucket. `row` counts points through all scenes.
template <class T>
struct alignas(16) GridPoint {
  T x, y, z;
  int32_t row;
};

// |p - q|^2 < radius^2, rounded alike on every device: products and sums are not contracted.
template <class T>
DIFFVBD_FN bool within(const GridPoint<T>& p, const GridPoint<T>& q, T squared_radius) {
  const T x = p.x - q.x, y = p.y - q.y, z = p.z - q.z;
#if defined(__CUDA_ARCH__)
  if constexpr (sizeof(T) == 8) {
    return __dadd_rn(__dadd_rn(__dmul_rn(x, x), __dmul_rn(y, y)), __dmul_rn(z, z)) < squared_radius;
  } else {
    return __fadd_rn(__fadd_rn(__fmul_rn(x, x), __fmul_rn(y, y)), __fmul_rn(z, z)) < squared_radius;
  }
#else
  return x * x + y * y + z * z < squared_radius;
#endif
}

}  // namespace diffvbd
