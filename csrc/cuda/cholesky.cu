// Factors and solutions of the systems of rigid motions: a block for each, so that a system has the same bits alone and
// among others.
#include "contact_rigid.cuh"

namespace diffvbd::cuda {
namespace {

constexpr int kSide = 16, kSquare = kSide * kSide;

// Column by column: a column is divided by the root of its pivot, and what stands right of it loses its outer product.
__global__ void __launch_bounds__(kSquare) cholesky_kernel(int64_t size, double* matrices, const uint8_t* state) {
  if (is_done(state, blockIdx.x)) return;
  double* a = matrices + size * size * blockIdx.x;
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

__global__ void __launch_bounds__(kSquare)
    solve_kernel(int64_t size, const double* factors, double* x, const uint8_t* state) {
  if (is_done(state, blockIdx.x)) return;
  const double* a = factors + size * size * blockIdx.x;
  double* b = x + size * blockIdx.x;
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

}  // namespace

cudaError_t cholesky(int64_t count, int64_t size, double* matrices, cudaStream_t stream, const uint8_t* state) {
  if (count > 0) cholesky_kernel<<<static_cast<unsigned>(count), kSquare, 0, stream>>>(size, matrices, state);
  return cudaGetLastError();
}

cudaError_t cholesky_solve(int64_t count, int64_t size, const double* factors, double* x, cudaStream_t stream,
                           const uint8_t* state) {
  if (count > 0) solve_kernel<<<static_cast<unsigned>(count), kSquare, 0, stream>>>(size, factors, x, state);
  return cudaGetLastError();
}

}  // namespace diffvbd::cuda
