// Sets of items that threads join at once; in the end the root of each set is its smallest item.
#pragma once

#include <cstdint>

namespace diffvbd::cuda {

__device__ inline int32_t root_of(const int32_t* label, int32_t i) {
  const volatile int32_t* parent = label;
  while (parent[i] != i) i = parent[i];
  return i;
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
