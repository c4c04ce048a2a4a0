// Launch sizes, workspaces and template instances, as all kernels need them.
#pragma once

#include <cuda_runtime.h>

#include <cstdint>

namespace diffvbd::cuda {

inline unsigned blocks_for(int64_t items, int threads) {
  return static_cast<unsigned>((items + threads - 1) / threads);
}

// Number of a thread in the grid; threads: of a block, where that is a constant.
__device__ __forceinline__ int64_t own_item() { return static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x; }
__device__ __forceinline__ int64_t own_item(int threads) {
  return static_cast<int64_t>(blockIdx.x) * threads + threadIdx.x;
}

// Hands out the parts of a workspace; without memory it counts their bytes.
template <size_t alignment = 256>
struct Parts {
  unsigned char* memory;
  size_t bytes = 0;
  explicit Parts(void* workspace) : memory(static_cast<unsigned char*>(workspace)) {}
  template <class U>
  void operator()(U*& pointer, int64_t items) {
    pointer = reinterpret_cast<U*>(memory + bytes);
    bytes += (items * sizeof(U) + alignment - 1) / alignment * alignment;
  }
};

}  // namespace diffvbd::cuda

// Both instances of a function template that has no overloads.
#define DIFFVBD_INSTANTIATE(f)          \
  template decltype(f<float>) f<float>; \
  template decltype(f<double>) f<double>;
