// Sums over the lanes of a warp.
#pragma once

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

}  // namespace diffvbd::cuda
