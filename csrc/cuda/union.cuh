// Sets of items that threads join at once; in the end the root of each set is its smallest item.
#pragma once

#include <cstdint>
#include <cuda/atomic>

namespace diffvbd::cuda {

// Labels are read and shortened while others join them: whatever is read is an item of the same set.
__device__ inline ::cuda::atomic_ref<int32_t, ::cuda::thread_scope_device> shared_label(const int32_t* label,
                                                                                        int32_t i) {
  return ::cuda::atomic_ref<int32_t, ::cuda::thread_scope_device>(const_cast<int32_t*>(label)[i]);
}

__device__ inline int32_t root_of(const int32_t* label, int32_t i) {
  for (;;) {
    const int32_t parent = shared_label(label, i).load(::cuda::std::memory_order_relaxed);
    if (parent == i) return i;
    i = parent;
  }
}

// Hangs the larger of two roots under the smaller.
__device__ inline void unite(int32_t* label, int32_t a, int32_t b) {
  for (;;) {
    a = root_of(label, a), b = root_of(label, b);
    if (a == b) return;
    const int32_t low = a < b ? a : b, high = a < b ? b : a;
    const int32_t before = atomicMin(label + high, low);
    if (before == high) return;
    a = before, b = low;
  }
}

}  // namespace diffvbd::cuda
