// Where the passes of contact find the vertices of a scene: what contact/passes.h asks of a backend.
#pragma once

#include "../contact/passes.h"
#include "group.cuh"

namespace diffvbd::cuda {
namespace {

// Of a sweep: vertices of colors that have moved are in other rows than the rest.
template <class T>
struct SweepRows {
  const T *rows, *moved;
  const int32_t* position;
  int64_t first, last;  // positions of the color whose turn it is
  __device__ __forceinline__ bool goes(int v) const {
    const int at = __ldg(position + v);
    return first <= at && at < last;
  }
  // of those of its turn
  __device__ __forceinline__ bool together(int v, int) const { return goes(v); }
  __device__ __forceinline__ Vec3<T> operator()(int v) const {
    const int at = __ldg(position + v);
    return load_row(at < first ? moved : rows, at);
  }
};
// Of a reversed sweep: the color whose turn it is as it was before its update, which the tape has.
template <class T>
struct TapeRows {
  SweepRows<T> now;  // all in the same rows
  const T* tape;     // of the scene and sweep, [., active]
  const int32_t* block_rank;
  int64_t active;
  __device__ __forceinline__ bool together(int v, int u) const { return now.together(v, u); }
  __device__ __forceinline__ Vec3<T> operator()(int v) const {
    const int at = __ldg(now.position + v);
    if (at < now.first || now.last <= at) return load_row(now.rows, at);
    const T* from = tape + (__ldg(block_rank + at / kSlice) + at % kSlice);
    return {__ldg(from), __ldg(from + active), __ldg(from + 2 * active)};
  }
};
template <class T>
struct UserRows {
  const T* x;
  __device__ __forceinline__ Vec3<T> operator()(int v) const { return vector_at(x + int64_t{3} * v); }
};

}  // namespace
}  // namespace diffvbd::cuda
