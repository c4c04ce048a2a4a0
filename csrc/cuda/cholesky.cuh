// Cholesky factors of systems of rigid motions, by the threads of one block. The bits do not depend on other systems.
// Matrices consist of blocks of six rows, one for each pair of bodies; only the lower half is read.
#pragma once

#include <cstdint>

#include "../subspace/contact_rigid.h"

namespace diffvbd::cuda {

constexpr int kBlock = contact::kUnknowns;

// Shared memory of a factorization.
struct Pivots {
  double inverse[kBlock * contact::kMostCoupled];  // inverse diagonal of the factor
  uint8_t below[2][contact::kMostCoupled];         // nonzero blocks of a column, double-buffered
};

// Lower half of the block at a.
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

// Factor of a block, by one thread.
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

// Row x of a column of blocks times the inverse transpose of the pivot: x L^-T.
__device__ inline void over_pivot(int64_t size, const double* pivot, const double* inverse, double* row) {
  double x[kBlock];
#pragma unroll
  for (int c = 0; c < kBlock; ++c) x[c] = row[c];
#pragma unroll
  for (int c = 0; c < kBlock; ++c) {
    x[c] *= inverse[c];
#pragma unroll
    for (int d = c + 1; d < kBlock; ++d) x[d] -= x[c] * pivot[size * d + c];
    row[c] = x[c];
  }
}

// Factor L of a matrix of `count` blocks a side, in place, and L^-1 b in place of b. columns [count]: a bit for each
// nonzero block of a column of the factor below the diagonal, or null for dense. The last warp prepares the next pivot
// while the others update the rest.
template <int threads>
__device__ void factor_blocks(int32_t count, const uint64_t* columns, double* a, double* b, Pivots& pivots) {
  static_assert(threads > contact::kMostCoupled);
  const int64_t size = int64_t{kBlock} * count;
  const auto thread = static_cast<int32_t>(threadIdx.x);
  const int32_t lane = thread - (threads - 32);  // of the last warp
  const auto column_of = [&](int32_t k) {
    return columns ? columns[k] : ((uint64_t{1} << count) - 1) >> (k + 1) << (k + 1);
  };
  const auto prepare = [&](int32_t k) {  // by the last warp
    if (k == count) return;
    const uint64_t column = column_of(k);
    for (int32_t i = lane; i < contact::kMostCoupled; i += 32) {
      if (column >> i & 1) {
        pivots.below[k % 2][__popcll(column & ((uint64_t{1} << i) - 1))] = static_cast<uint8_t>(i);
      }
    }
    if (lane == 0) factor_block(size, a + (size + 1) * kBlock * k, pivots.inverse + kBlock * k);
  };
  if (lane >= 0) prepare(0);
  __syncthreads();
  for (int32_t k = 0; k < count; ++k) {
    const double* pivot = a + (size + 1) * kBlock * k;
    const uint64_t column = column_of(k);
    const uint8_t* below = pivots.below[k % 2];
    const int32_t left = __popcll(column);
    for (int32_t item = thread; item <= kBlock * left; item += threads) {
      double* row = item == kBlock * left  // the right-hand side is one more row
                        ? b + kBlock * k
                        : a + size * (kBlock * below[item / kBlock] + item % kBlock) + kBlock * k;
      over_pivot(size, pivot, pivots.inverse + kBlock * k, row);
    }
    __syncthreads();
    // Row i of block (below[r], below[c]), or of the right-hand side.
    const auto update = [&](int32_t r, int32_t c, int32_t i) {
      const double* row = a + size * i + kBlock * k;
      double x[kBlock];
#pragma unroll
      for (int e = 0; e < kBlock; ++e) x[e] = row[e];
      if (c == left) {
        double sum = b[i];
#pragma unroll
        for (int e = 0; e < kBlock; ++e) sum -= x[e] * b[kBlock * k + e];
        b[i] = sum;
        return;
      }
      const int32_t j = kBlock * below[c];
      const double* other = a + size * j + kBlock * k;
      double* to = a + size * i + j;
#pragma unroll
      for (int n = 0; n < kBlock; ++n) {
        double sum = to[n];
#pragma unroll
        for (int e = 0; e < kBlock; ++e) sum -= x[e] * other[size * n + e];
        to[n] = sum;
      }
    };
    const bool ahead = k + 1 < count && (column >> (k + 1) & 1);
    if (lane >= 0) {
      if (ahead && lane < kBlock) update(0, 0, kBlock * (k + 1) + lane);
      __syncwarp();
      prepare(k + 1);
    } else {
      for (int32_t item = thread; item < kBlock * left * (left + 1); item += threads - 32) {
        const int32_t r = item / (left + 1) / kBlock, c = item % (left + 1);
        if ((r < c && c < left) || (ahead && r == 0 && c == 0)) continue;
        update(r, c, kBlock * below[r] + item / (left + 1) % kBlock);
      }
    }
    __syncthreads();
  }
}

// Inverses of the diagonal blocks of a factor, below their diagonals: m[block k + stride j + i] is at row i and column
// j.
struct Inverses {
  double* m;
  int64_t block, stride;
  const double* diagonal;

  // Stored in the upper halves of the blocks, which are not read otherwise.
  __device__ static Inverses within(int32_t count, double* a, const double* diagonal) {
    const int64_t size = int64_t{kBlock} * count;
    return {a, (size + 1) * kBlock, size, diagonal};
  }
};

// By all threads, one block each. The diagonals have been inverted.
template <int threads>
__device__ void invert_pivots(int32_t count, const double* a, const Inverses& to) {
  const int64_t size = int64_t{kBlock} * count;
  for (auto k = static_cast<int32_t>(threadIdx.x); k < count; k += threads) {
    const LowerBlock b(size, a + (size + 1) * kBlock * k);
    double inverse[kBlock][kBlock];
#pragma unroll
    for (int j = 0; j < kBlock; ++j) {
      inverse[j][j] = to.diagonal[kBlock * k + j];
#pragma unroll
      for (int i = j + 1; i < kBlock; ++i) {
        double sum = 0;
#pragma unroll
        for (int n = j; n < i; ++n) sum -= b.l[i][n] * inverse[n][j];
        inverse[i][j] = sum * to.diagonal[kBlock * k + i];
        to.m[to.block * k + to.stride * j + i] = inverse[i][j];
      }
    }
  }
  __syncthreads();
}

// Inverse of a diagonal block, or its transpose, times six numbers, in place, by the first warp.
template <bool turned>
__device__ void times_inverse(const Inverses& of, int32_t k, double* b) {
  const auto own = static_cast<int32_t>(threadIdx.x);
  if (own >= 32) return;
  double x = 0;
  if (own < kBlock) {
    const double* m = of.m + of.block * k;
    x = of.diagonal[kBlock * k + own] * b[own];
#pragma unroll
    for (int i = 0; i < kBlock; ++i) {
      if (turned ? own < i : i < own) x += (turned ? m[of.stride * own + i] : m[of.stride * i + own]) * b[i];
    }
  }
  __syncwarp();
  if (own < kBlock) b[own] = x;
}

// Forward substitution L^-1 b and backward substitution L^-T b, in place.
template <int threads>
__device__ void solve_forward(int32_t count, const double* a, const Inverses& inverses, double* b) {
  const int64_t size = int64_t{kBlock} * count;
  for (int32_t k = 0; k < count; ++k) {
    times_inverse<false>(inverses, k, b + kBlock * k);
    __syncthreads();
    for (auto i = static_cast<int32_t>(kBlock * (k + 1) + threadIdx.x); i < size; i += threads) {
      double sum = b[i];
#pragma unroll
      for (int c = 0; c < kBlock; ++c) sum -= a[size * i + kBlock * k + c] * b[kBlock * k + c];
      b[i] = sum;
    }
    __syncthreads();
  }
}
template <int threads>
__device__ void solve_backward(int32_t count, const double* a, const Inverses& inverses, double* b) {
  const int64_t size = int64_t{kBlock} * count;
  for (int32_t k = count - 1; k >= 0; --k) {
    times_inverse<true>(inverses, k, b + kBlock * k);
    __syncthreads();
    for (auto i = static_cast<int32_t>(threadIdx.x); i < kBlock * k; i += threads) {
      double sum = b[i];
#pragma unroll
      for (int c = 0; c < kBlock; ++c) sum -= a[size * (kBlock * k + c) + i] * b[kBlock * k + c];
      b[i] = sum;
    }
    __syncthreads();
  }
}

}  // namespace diffvbd::cuda
