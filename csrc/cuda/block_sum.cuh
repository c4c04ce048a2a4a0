// Sums by the threads of a block.
#pragma once

#include <cuda_runtime.h>

namespace diffvbd::cuda {

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
