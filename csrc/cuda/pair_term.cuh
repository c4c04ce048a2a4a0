// What pairs bring to an update, and the meeting of the warps of a block that share a vertex: the first has its star
// and solves, the others its pairs (contact_sweep.cuh).
#pragma once

#include "../sweep/block.h"
#include "step.h"

namespace diffvbd::cuda {

constexpr int kRoles = 3, kAmongWarps = 1 + kRoles;

// All warps of such a block come here, from different places in the code.
__device__ __forceinline__ void meet_among() {
  asm volatile("barrier.sync 1, %0;" ::"n"(kAmongWarps * kSlice) : "memory");
}

template <class T>
struct PairTerm {
  const T* at = nullptr;  // [count, kContactScalars]
  int count = 0;
  const T* bar = nullptr;  // [3]  in the reverse, or null: what pairs have sent
  bool meets = false;      // it is there once the block has met
  __device__ __forceinline__ void meet() {
    if (meets) meet_among();
    meets = false;
  }
  __device__ __forceinline__ ContactTerm<T> sum() {
    meet();
    ContactTerm<T> out{zero3<T>(), diagonal(T(0))};
    for (int i = 0; i < count; ++i) {
      const T* a = at + i * kContactScalars;
      out.g += Vec3<T>{a[0], a[1], a[2]};
      out.H += Sym3<T>{a[3], a[4], a[5], a[6], a[7], a[8]};
    }
    return out;
  }
  __device__ __forceinline__ Vec3<T> sent() {
    meet();
    return bar ? Vec3<T>{bar[0], bar[1], bar[2]} : zero3<T>();
  }
};

}  // namespace diffvbd::cuda
