// Systems of rigid motions, by the threads of one block: a system has the same bits alone and among others. Matrices
// are of blocks of six, one for each two bodies, and only their lower half is looked at.
#pragma once

#include <cstdint>

#include "../contact/groups.h"

namespace diffvbd::cuda {

constexpr int kBlock = contact::kUnknowns;

// Memory of a factorization, shared.
struct Pivots {
  double inverse[kBlock];
  uint8_t below[contact::kMostCoupled];  // blocks of a column that are not zero
};

// The lower half of the block that begins at a.
struct LowerBlock {
  double l[kBlock][kBlock];
  __device__ LowerBlock(int64_t size, const double* a) {
#pragma unroll
    for (int i = 0; i < kBlock; ++i) {
#pragma unroll
      for (int j = 0; j <= i; ++j) l[i][j] = a[size * i + j];
    }
  }
};

// Its factor, by one thread.
__device__ inline void factor_block(int64_t size, double* a, double* inverse) {
  LowerBlock b(size, a);
#pragma unroll
  for (int j = 0; j < kBlock; ++j) {
    const double over = rsqrt(b.l[j][j]);
    inverse[j] = over;
    b.l[j][j] *= over;
#pragma unroll
    for (int i = j + 1; i < kBlock; ++i) {
      b.l[i][j] *= over;
#pragma unroll
      for (int k = j + 1; k <= i; ++k) b.l[i][k] -= b.l[i][j] * b.l[k][j];
    }
  }
#pragma unroll
  for (int i = 0; i < kBlock; ++i) {
#pragma unroll
    for (int j = 0; j <= i; ++j) a[size * i + j] = b.l[i][j];
  }
}

// The factor L of a matrix of `count` blocks a side, over its lower half, and L^-1 b over b. columns [count]: a bit for
// each block of a column below the diagonal that is not zero, in the factor; or null, if none is.
template <int threads>
__device__ void factor_blocks(int32_t count, const uint64_t* columns, double* a, double* b, Pivots& pivots) {
  static_assert(threads > contact::kMostCoupled);
  const int64_t size = int64_t{kBlock} * count;
  const auto thread = static_cast<int32_t>(threadIdx.x);
  for (int32_t k = 0; k < count; ++k) {
    const double* pivot = a + (size + 1) * kBlock * k;
    const uint64_t column = columns ? columns[k] : ((uint64_t{1} << count) - 1) >> (k + 1) << (k + 1);
    const int32_t left = __popcll(column);
    if (thread == threads - 1) factor_block(size, a + (size + 1) * kBlock * k, pivots.inverse);
    if (thread < contact::kMostCoupled && (column >> thread & 1)) {
      pivots.below[__popcll(column & ((uint64_t{1} << thread) - 1))] = static_cast<uint8_t>(thread);
    }
    __syncthreads();
    for (int32_t item = thread; item <= kBlock * left; item += threads) {
      double* row = item == kBlock * left  // the right side is like one more row
                        ? b + kBlock * k
                        : a + size * (kBlock * pivots.below[item / kBlock] + item % kBlock) + kBlock * k;
      double x[kBlock];
#pragma unroll
      for (int c = 0; c < kBlock; ++c) x[c] = row[c];
#pragma unroll
      for (int c = 0; c < kBlock; ++c) {
        x[c] *= pivots.inverse[c];
#pragma unroll
        for (int d = c + 1; d < kBlock; ++d) x[d] -= x[c] * pivot[size * d + c];
        row[c] = x[c];
      }
    }
    __syncthreads();
    for (int32_t item = thread; item < kBlock * left * (left + 1); item += threads) {
      const int32_t r = item / (left + 1) / kBlock, c = item % (left + 1);
      if (r < c && c < left) continue;
      const int32_t i = kBlock * pivots.below[r] + item / (left + 1) % kBlock;
      const double* row = a + size * i + kBlock * k;
      double x[kBlock];
#pragma unroll
      for (int e = 0; e < kBlock; ++e) x[e] = row[e];
      if (c == left) {
        double sum = b[i];
#pragma unroll
        for (int e = 0; e < kBlock; ++e) sum -= x[e] * b[kBlock * k + e];
        b[i] = sum;
        continue;
      }
      const int32_t j = kBlock * pivots.below[c];
      const double* other = a + size * j + kBlock * k;
      double* to = a + size * i + j;
#pragma unroll
      for (int n = 0; n < kBlock; ++n) {
        double sum = to[n];
#pragma unroll
        for (int e = 0; e < kBlock; ++e) sum -= x[e] * other[size * n + e];
        to[n] = sum;
      }
    }
    __syncthreads();
  }
}

// The solution of a part of a system, whose factor is the block that begins at a, by one thread: of L x = b, or of
// L' x = b.
template <bool turned>
__device__ void solve_block(int64_t size, const double* a, double* b) {
  const LowerBlock block(size, a);
  double x[kBlock], inverse[kBlock];
#pragma unroll
  for (int i = 0; i < kBlock; ++i) x[i] = b[i], inverse[i] = 1 / block.l[i][i];
#pragma unroll
  for (int step = 0; step < kBlock; ++step) {
    const int i = turned ? kBlock - 1 - step : step;
    x[i] *= inverse[i];
#pragma unroll
    for (int j = 0; j < kBlock; ++j) {
      if (turned ? j < i : i < j) x[j] -= x[i] * (turned ? block.l[i][j] : block.l[j][i]);
    }
  }
#pragma unroll
  for (int i = 0; i < kBlock; ++i) b[i] = x[i];
}

// L^-1 b over b, with such a factor L; then L^-T b.
template <int threads>
__device__ void solve_forward(int32_t count, const double* a, double* b) {
  const int64_t size = int64_t{kBlock} * count;
  const auto thread = static_cast<int32_t>(threadIdx.x);
  for (int32_t k = 0; k < count; ++k) {
    const double* own = b + kBlock * k;
    if (thread == 0) solve_block<false>(size, a + (size + 1) * kBlock * k, b + kBlock * k);
    __syncthreads();
    for (auto i = static_cast<int32_t>(kBlock * (k + 1)) + thread; i < size; i += threads) {
      double sum = b[i];
#pragma unroll
      for (int c = 0; c < kBlock; ++c) sum -= a[size * i + kBlock * k + c] * own[c];
      b[i] = sum;
    }
    __syncthreads();
  }
}
template <int threads>
__device__ void solve_backward(int32_t count, const double* a, double* b) {
  const int64_t size = int64_t{kBlock} * count;
  const auto thread = static_cast<int32_t>(threadIdx.x);
  for (int32_t k = count - 1; k >= 0; --k) {
    const double* own = b + kBlock * k;
    if (thread == 0) solve_block<true>(size, a + (size + 1) * kBlock * k, b + kBlock * k);
    __syncthreads();
    for (int32_t i = thread; i < kBlock * k; i += threads) {
      double sum = b[i];
#pragma unroll
      for (int c = 0; c < kBlock; ++c) sum -= a[size * (kBlock * k + c) + i] * own[c];
      b[i] = sum;
    }
    __syncthreads();
  }
}

}  // namespace diffvbd::cuda
