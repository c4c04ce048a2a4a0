// Minimum, maximum and union of sets by atomics: results that do not depend on the order of threads.
#pragma once

#include <cuda_runtime.h>

#include <cstdint>
#include <cuda/atomic>

namespace diffvbd::cuda {

template <class T>
struct OrderedBits;
template <>
struct OrderedBits<float> {
  using Type = unsigned;
};
template <>
struct OrderedBits<double> {
  using Type = unsigned long long;
};
template <class T>
using Ordered = typename OrderedBits<T>::Type;

template <class T>
__device__ __forceinline__ Ordered<T> ordered(T value) {
  constexpr Ordered<T> sign = Ordered<T>{1} << (8 * sizeof(T) - 1);
  Ordered<T> bits;
  memcpy(&bits, &value, sizeof bits);
  return bits & sign ? ~bits : bits | sign;
}

template <class T>
__device__ __forceinline__ T value_of(Ordered<T> bits) {
  constexpr Ordered<T> sign = Ordered<T>{1} << (8 * sizeof(T) - 1);
  bits = bits & sign ? bits & ~sign : ~bits;
  T value;
  memcpy(&value, &bits, sizeof value);
  return value;
}

// Reads first: most numbers change nothing, and reads of a shared location are cheap.
template <class U>
__device__ __forceinline__ void lower(U* place, U value) {
  if (value < *static_cast<volatile U*>(place)) atomicMin(place, value);
}
template <class U>
__device__ __forceinline__ void raise(U* place, U value) {
  if (value > *static_cast<volatile U*>(place)) atomicMax(place, value);
}

// Labels may change while they are read; every value read is an item of the same set.
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

// Makes the larger of two roots a child of the smaller.
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
