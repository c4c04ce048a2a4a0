// Minimum and maximum of floating-point numbers by atomics of integers in the same order: their results do not depend
// on who comes first.
#pragma once

#include <cuda_runtime.h>

#include <cstdint>

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

// Looks first: most numbers change nothing, and reading is cheap where many threads share a place.
template <class U>
__device__ __forceinline__ void lower(U* place, U value) {
  if (value < *static_cast<volatile U*>(place)) atomicMin(place, value);
}
template <class U>
__device__ __forceinline__ void raise(U* place, U value) {
  if (value > *static_cast<volatile U*>(place)) atomicMax(place, value);
}

}  // namespace diffvbd::cuda
