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
  uint8_t fills[contact::kMostCoupled];
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

// The factor of a matrix of `count` blocks a side, over its lower half.
template <int threads>
__device__ void factor_blocks(int32_t count, double* a, Pivots& pivots) {
  const int64_t size = int64_t{kBlock} * count;
  const auto thread = static_cast<int32_t>(threadIdx.x);
  for (int32_t k = 0; k < count; ++k) {
    const double* pivot = a + (size + 1) * kBlock * k;
    if (thread == 0) factor_block(size, a + (size + 1) * kBlock * k, pivots.inverse);
    for (int32_t i = k + 1 + thread; i < count; i += threads) pivots.fills[i] = 0;
    __syncthreads();
    for (auto i = static_cast<int32_t>(kBlock * (k + 1)) + thread; i < size; i += threads) {
      double* row = a + size * i + kBlock * k;
      double x[kBlock];
      bool any = false;
#pragma unroll
      for (int c = 0; c < kBlock; ++c) {
        x[c] = row[c];
        any = any || x[c] != 0;
      }
      if (!any) continue;  // bodies touch few others
#pragma unroll
      for (int c = 0; c < kBlock; ++c) {
        x[c] *= pivots.inverse[c];
#pragma unroll
        for (int d = c + 1; d < kBlock; ++d) x[d] -= x[c] * pivot[size * d + c];
        row[c] = x[c];
      }
      pivots.fills[i / kBlock] = 1;
    }
    __syncthreads();
    const int32_t left = count - k - 1;
    for (int32_t item = thread; item < kBlock * left * left; item += threads) {
      const int32_t i = kBlock * (k + 1) + item / left, column = k + 1 + item % left;
      if (column > i / kBlock || !pivots.fills[column] || !pivots.fills[i / kBlock]) continue;
      const double* row = a + size * i + kBlock * k;
      double x[kBlock];
#pragma unroll
      for (int c = 0; c < kBlock; ++c) x[c] = row[c];
      const double* other = a + size * kBlock * column + kBlock * k;
      double* to = a + size * i + kBlock * column;
#pragma unroll
      for (int j = 0; j < kBlock; ++j) {
        double sum = to[j];
#pragma unroll
        for (int c = 0; c < kBlock; ++c) sum -= x[c] * other[size * j + c];
        to[j] = sum;
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

// The solution of a system with such a factor, over its right side b.
template <int threads>
__device__ void solve_blocks(int32_t count, const double* a, double* b) {
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
