// Systems of rigid motions, by the threads of one block: a system has the same bits alone and among others. Matrices
// are of blocks of six, one for each two bodies, and only their lower half is looked at.
#pragma once

#include <cstdint>

#include "../contact/groups.h"

namespace diffvbd::cuda {

constexpr int kBlock = contact::kUnknowns;

// Memory of a factorization, shared.
struct Pivots {
  double inverse[kBlock * contact::kMostCoupled];  // over the diagonal of the factor
  uint8_t below[2][contact::kMostCoupled];         // blocks of a column that are not zero, of two columns in turn
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

// A row x of a column of blocks over the pivot of that column: x L^-T.
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

// The factor L of a matrix of `count` blocks a side, over its lower half, and L^-1 b over b. columns [count]: a bit for
// each block of a column below the diagonal that is not zero, in the factor; or null, if none is. The last warp works
// on the next pivot while the others update the rest: that takes one thread as long.
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
      double* row = item == kBlock * left  // the right side is like one more row
                        ? b + kBlock * k
                        : a + size * (kBlock * below[item / kBlock] + item % kBlock) + kBlock * k;
      over_pivot(size, pivot, pivots.inverse + kBlock * k, row);
    }
    __syncthreads();
    // of a row of the block of below[r] and below[c], or of the right side
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

// x of L x = b, or of L' x = b, over b, by one thread; L the block that begins at a.
template <bool turned>
__device__ void solve_block(int64_t size, const double* a, const double* inverse, double* b) {
  const LowerBlock block(size, a);
  double x[kBlock];
#pragma unroll
  for (int i = 0; i < kBlock; ++i) x[i] = b[i];
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

// Over the diagonal of a factor, by all threads.
template <int threads>
__device__ void invert_diagonal(int32_t count, const double* a, double* inverse) {
  const int64_t size = int64_t{kBlock} * count;
  for (auto i = static_cast<int32_t>(threadIdx.x); i < size; i += threads) inverse[i] = 1 / a[(size + 1) * i];
  __syncthreads();
}

// L^-1 b over b, with such a factor L; then L^-T b.
template <int threads>
__device__ void solve_forward(int32_t count, const double* a, const double* inverse, double* b) {
  const int64_t size = int64_t{kBlock} * count;
  const auto thread = static_cast<int32_t>(threadIdx.x);
  for (int32_t k = 0; k < count; ++k) {
    const double* own = b + kBlock * k;
    if (thread == 0) solve_block<false>(size, a + (size + 1) * kBlock * k, inverse + kBlock * k, b + kBlock * k);
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
// By one warp, which has no need to wait for others. columns: as of factor_blocks().
__device__ inline void solve_backward(int32_t count, const uint64_t* columns, const double* a, const double* inverse,
                                      double* b) {
  constexpr unsigned all = 0xffffffffu;
  const int64_t size = int64_t{kBlock} * count;
  const auto lane = static_cast<int32_t>(threadIdx.x);
  if (lane < 32) {
    for (int32_t k = count - 1; k >= 0; --k) {
      const uint64_t column = columns ? columns[k] : ~uint64_t{0};
      double sum[kBlock] = {};
      for (int32_t i = kBlock * (k + 1) + lane; i < size; i += 32) {
        if (!(column >> (i / kBlock) & 1)) continue;
#pragma unroll
        for (int c = 0; c < kBlock; ++c) sum[c] += a[size * i + kBlock * k + c] * b[i];
      }
#pragma unroll
      for (int c = 0; c < kBlock; ++c) {
#pragma unroll
        for (int d = 16; d > 0; d /= 2) sum[c] += __shfl_xor_sync(all, sum[c], d);
      }
      if (lane == 0) {
        for (int c = 0; c < kBlock; ++c) b[kBlock * k + c] -= sum[c];
        solve_block<true>(size, a + (size + 1) * kBlock * k, inverse + kBlock * k, b + kBlock * k);
      }
      __syncwarp();
    }
  }
  __syncthreads();
}

}  // namespace diffvbd::cuda
