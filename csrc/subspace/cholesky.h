// Cholesky factors of symmetric matrices of 6 x 6 blocks, of which most are zero, by a team of threads. Matrices are
// dense, [6 count, 6 count] by rows; only the lower half is read and written. blocks [count]: for each block column a
// bit for each block below the diagonal that is not zero.
#pragma once

#include <cstdint>

#include "../core/vec.h"

namespace diffvbd::cholesky {

constexpr int kBlock = 6;

// The number of the k-th bit that is set.
DIFFVBD_FN int32_t nth_bit(uint64_t bits, int32_t k) {
  for (; k > 0; --k) bits &= bits - 1;
#if defined(__CUDA_ARCH__)
  return __ffsll(static_cast<long long>(bits)) - 1;
#else
  return __builtin_ctzll(bits);
#endif
}
DIFFVBD_FN int32_t count_bits(uint64_t bits) {
#if defined(__CUDA_ARCH__)
  return __popcll(bits);
#else
  return __builtin_popcountll(bits);
#endif
}

// The blocks of the factor, from those of the matrix.
DIFFVBD_FN void fill_in(int32_t count, uint64_t* blocks) {
  for (int32_t k = 0; k < count; ++k) {
    for (uint64_t rest = blocks[k]; rest != 0; rest &= rest - 1) {
      const int32_t next = nth_bit(rest, 0);
      blocks[next] |= rest & (rest - 1);
    }
  }
}

// The factor of a block on the diagonal; what is no number says that it is not positive definite.
DIFFVBD_FN void factor_pivot(int64_t size, double* a) {
  for (int j = 0; j < kBlock; ++j) {
    for (int i = j; i < kBlock; ++i) {
      double sum = a[size * i + j];
      for (int k = 0; k < j; ++k) sum -= a[size * i + k] * a[size * j + k];
      a[size * i + j] = i == j ? square_root(sum) : sum / a[size * j + j];
    }
  }
}
// row L^-T of a row of six, L the factor of a block.
DIFFVBD_FN void over_pivot(int64_t size, const double* pivot, double* row) {
  for (int j = 0; j < kBlock; ++j) {
    double sum = row[j];
    for (int k = 0; k < j; ++k) sum -= row[k] * pivot[size * j + k];
    row[j] = sum / pivot[size * j + j];
  }
}

// Factors a matrix in place. blocks: of the matrix, then of the factor.
template <class Team>
DIFFVBD_FN void factor(const Team& team, int32_t count, double* a, uint64_t* blocks) {
  const int64_t size = int64_t{kBlock} * count;
  if (team.leads()) fill_in(count, blocks);
  for (int32_t k = 0; k < count; ++k) {
    double* pivot = a + kBlock * (size + 1) * k;
    if (team.leads()) factor_pivot(size, pivot);
    team.meet();
    const uint64_t below = blocks[k];
    const int32_t rows = count_bits(below);
    const auto row_of = [&](int32_t i) { return a + size * kBlock * nth_bit(below, i); };
    team.each(kBlock * rows,
              [&](int32_t i) { over_pivot(size, pivot, row_of(i / kBlock) + size * (i % kBlock) + kBlock * k); });
    team.meet();
    team.each(rows * rows * kBlock, [&](int32_t i) {
      const int32_t r = i / kBlock / rows, c = i / kBlock % rows, own = i % kBlock;
      if (c > r) return;
      double* to = row_of(r) + size * own + int64_t{kBlock} * nth_bit(below, c);
      const double *x = row_of(r) + size * own + kBlock * k, *y = row_of(c) + kBlock * k;
      for (int j = 0; j < (c < r ? kBlock : own + 1); ++j) {
        double sum = to[j];
        for (int e = 0; e < kBlock; ++e) sum -= x[e] * y[size * j + e];
        to[j] = sum;
      }
    });
    team.meet();
  }
}

// b = factor^-T factor^-1 b
template <class Team>
DIFFVBD_FN void solve(const Team& team, int32_t count, const double* a, const uint64_t* blocks, double* b) {
  const int64_t size = int64_t{kBlock} * count;
  for (int32_t k = 0; k < count; ++k) {
    double* own = b + kBlock * k;
    if (team.leads()) over_pivot(size, a + kBlock * (size + 1) * k, own);
    team.meet();
    team.each(kBlock * count_bits(blocks[k]), [&](int32_t i) {
      const int64_t row = kBlock * nth_bit(blocks[k], i / kBlock) + i % kBlock;
      double sum = b[row];
      for (int e = 0; e < kBlock; ++e) sum -= a[size * row + kBlock * k + e] * own[e];
      b[row] = sum;
    });
    team.meet();
  }
  for (int32_t k = count - 1; k >= 0; --k) {
    double* own = b + kBlock * k;
    const double* pivot = a + kBlock * (size + 1) * k;
    double sum[kBlock];
    team.template sum<kBlock>(kBlock * count_bits(blocks[k]), sum, [&](int32_t i, double* to) {
      const int64_t row = kBlock * nth_bit(blocks[k], i / kBlock) + i % kBlock;
      for (int e = 0; e < kBlock; ++e) to[e] += a[size * row + kBlock * k + e] * b[row];
    });
    for (int j = kBlock - 1; team.leads() && j >= 0; --j) {
      double rest = own[j] - sum[j];
      for (int i = j + 1; i < kBlock; ++i) rest -= pivot[size * i + j] * own[i];
      own[j] = rest / pivot[size * j + j];
    }
    team.meet();
  }
}

}  // namespace diffvbd::cholesky
