// Sums over the lanes of a warp and the threads of a block.
#pragma once

#include <cuda_runtime.h>

namespace diffvbd::cuda {

constexpr unsigned kWholeWarp = 0xffffffffu;

// Adds to each of n numbers that of the lane at distance `offset` (exclusive or). All shuffles come first: they keep
// the written order, and each addition in between would wait. mask: has both lanes.
template <int n, class T>
__device__ __forceinline__ void add_from(T (&a)[n], int offset, unsigned mask = kWholeWarp) {
  T other[n];
#pragma unroll
  for (int k = 0; k < n; ++k) other[k] = __shfl_xor_sync(mask, a[k], offset);
#pragma unroll
  for (int k = 0; k < n; ++k) a[k] = a[k] + other[k];
}

// Makes part[0] the sum of part [threads] in a fixed order; thread 0 may read it.
template <int threads, class Term, class Add>
__device__ __forceinline__ void reduce_block(Term* part, const Add& add) {
  for (int half = threads / 2; half > 0; half /= 2) {
    __syncthreads();
    if (threadIdx.x < half) add(part[threadIdx.x], part[threadIdx.x + half]);
  }
}

// Sum over the threads of a block in a fixed order, valid at thread 0.
template <class Term, class Add>
__device__ Term block_sum(Term own, Term* part, const Add& add) {
  const unsigned t = threadIdx.x;
  part[t] = own;
  for (unsigned half = blockDim.x / 2; half > 0; half /= 2) {
    __syncthreads();
    if (t < half) add(part[t], part[t + half]);
  }
  __syncthreads();
  return part[0];
}

}  // namespace diffvbd::cuda
