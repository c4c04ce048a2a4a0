// Sums over the lanes of a warp and the threads of a block.
#pragma once

#include <cuda_runtime.h>

namespace diffvbd::cuda {

constexpr unsigned kWholeWarp = 0xffffffffu;

// Adds to each of n numbers that of the lane whose number differs in one bit, `offset`. All at once: shuffles stay in
// the order in which they are written, and with one number after another each round would wait for the one before.
// `mask` has, with each lane, the one that it adds from.
template <int n, class T>
__device__ __forceinline__ void add_from(T (&a)[n], int offset, unsigned mask = kWholeWarp) {
  T other[n];
#pragma unroll
  for (int k = 0; k < n; ++k) other[k] = __shfl_xor_sync(mask, a[k], offset);
#pragma unroll
  for (int k = 0; k < n; ++k) a[k] = a[k] + other[k];
}

// Makes part[0] the sum of part [threads] in a fixed order: of a block, thread 0 may read it then.
template <int threads, class Term, class Add>
__device__ __forceinline__ void reduce_block(Term* part, const Add& add) {
  for (int half = threads / 2; half > 0; half /= 2) {
    __syncthreads();
    if (threadIdx.x < half) add(part[threadIdx.x], part[threadIdx.x + half]);
  }
}

// Sum of what the threads of a block have, at thread 0, always in the same order.
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
