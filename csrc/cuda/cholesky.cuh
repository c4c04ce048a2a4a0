// Systems of rigid motions, by the threads of one block: a system has the same bits alone and among others.
#pragma once

#include <cstdint>

namespace diffvbd::cuda {

constexpr int kSide = 16, kSquare = kSide * kSide;  // threads of the block

// The factor of a matrix, over its lower half. Column by column: a column is divided by the root of its pivot, and what
// stands right of it loses its outer product.
__device__ inline void cholesky_of(int64_t size, double* a) {
  const int64_t row = threadIdx.x / kSide, column = threadIdx.x % kSide;
  __shared__ double pivot;
  for (int64_t j = 0; j < size; ++j) {
    if (threadIdx.x == 0) pivot = sqrt(a[size * j + j]);
    __syncthreads();
    for (int64_t i = j + threadIdx.x; i < size; i += kSquare) {
      a[size * i + j] = i == j ? pivot : a[size * i + j] / pivot;
    }
    __syncthreads();
    for (int64_t i = j + 1 + row; i < size; i += kSide) {
      const double left = a[size * i + j];
      if (left == 0) continue;  // bodies touch few others
      for (int64_t k = j + 1 + column; k <= i; k += kSide) a[size * i + k] -= left * a[size * k + j];
    }
    __syncthreads();
  }
}

// The solution of a system with such a factor, over its right side b.
__device__ inline void solve_with(int64_t size, const double* a, double* b) {
  __shared__ double value;
  for (int64_t j = 0; j < size; ++j) {
    if (threadIdx.x == 0) b[j] = value = b[j] / a[size * j + j];
    __syncthreads();
    for (int64_t i = j + 1 + threadIdx.x; i < size; i += kSquare) b[i] -= a[size * i + j] * value;
    __syncthreads();
  }
  for (int64_t j = size - 1; j >= 0; --j) {
    if (threadIdx.x == 0) b[j] = value = b[j] / a[size * j + j];
    __syncthreads();
    for (int64_t k = threadIdx.x; k < j; k += kSquare) b[k] -= a[size * j + k] * value;
    __syncthreads();
  }
}

}  // namespace diffvbd::cuda
