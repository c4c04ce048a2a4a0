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
  __device__ __forceinline__ Vec3<T> operator()(int v) const { return load_row(rows, __ldg(position + v)); }
};
// Of a color whose vertices have moved, as they were before.
template <class T>
struct RowsBefore {
  SweepRows<T> now;
  const T* before;
  int64_t first, last;  // positions of the color
  __device__ __forceinline__ bool goes(int v) const {
    const int position = __ldg(now.position + v);
    return first <= position && position < last;
  }
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
