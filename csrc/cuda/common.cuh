// Launch sizes, workspaces and template instances, as all kernels need them.
#pragma once

#include <cuda_runtime.h>

#include <cstdint>

#include "../core/parts.h"

namespace diffvbd::cuda {

inline unsigned blocks_for(int64_t items, int threads) {
  return static_cast<unsigned>((items + threads - 1) / threads);
}

// Number of a thread in the grid; threads: of a block, where that is a constant.
__device__ __forceinline__ int64_t own_item() { return static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x; }
__device__ __forceinline__ int64_t own_item(int threads) {
  return static_cast<int64_t>(blockIdx.x) * threads + threadIdx.x;
}

}  // namespace diffvbd::cuda

// The instances of a function template that has no overloads; an object of a generated law has one.
#ifdef DIFFVBD_SCALAR
#define DIFFVBD_INSTANTIATE(f) template decltype(f<DIFFVBD_SCALAR>) f<DIFFVBD_SCALAR>;
#else
#define DIFFVBD_INSTANTIATE(f)          \
  template decltype(f<float>) f<float>; \
  template decltype(f<double>) f<double>;
#endif
