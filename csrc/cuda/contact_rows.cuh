// Where the passes of contact find the vertices of a scene: what contact/passes.h asks of a backend.
#pragma once

#include "../contact/passes.h"
#include "group.cuh"

namespace diffvbd::cuda {
namespace {

template <class T>
struct SweepRows {
  const T* rows;
  const int32_t* position;
  int64_t first, last;  // positions of the color whose turn it is
  __device__ __forceinline__ bool goes(int v) const {
    const int at = __ldg(position + v);
    return first <= at && at < last;
  }
  // of those of its turn
  __device__ __forceinline__ bool together(int v, int) const { return goes(v); }
  __device__ __forceinline__ Vec3<T> operator()(int v) const { return load_row(rows, __ldg(position + v)); }
};
// Of a color whose vertices have moved, as they were before.
template <class T>
struct RowsBefore {
  SweepRows<T> now;
  const T* before;
  __device__ __forceinline__ bool goes(int v) const { return now.goes(v); }
  __device__ __forceinline__ Vec3<T> operator()(int v) const {
    return load_row(goes(v) ? before : now.rows, __ldg(now.position + v));
  }
};
template <class T>
struct UserRows {
  const T* x;
  __device__ __forceinline__ Vec3<T> operator()(int v) const { return contact::vector_at(x + int64_t{3} * v); }
};

}  // namespace
}  // namespace diffvbd::cuda
