// Loads and stores of threads, and the layout of the threads of a vertex in a warp.
#pragma once

#include "../core/vec.h"
#include "step.h"
#include "warp_reduce.cuh"

namespace diffvbd::cuda {

// 16 bytes, the widest load.
template <class T>
struct alignas(16) Pack {
  static constexpr int size = 16 / sizeof(T);
  T v[size];
};

// Vector type of a Pack for loads; a Pack that contains it would live on the stack.
template <class T>
using Wide = std::conditional_t<sizeof(T) == sizeof(double), double2, float4>;
__device__ __forceinline__ Pack<double> pack(const double2& a) { return {a.x, a.y}; }
__device__ __forceinline__ Pack<float> pack(const float4& a) { return {a.x, a.y, a.z, a.w}; }

// Values that other multiprocessors may write during the launch come from the L2 cache. A block that has its scene to
// itself (`own`) uses the L1 cache.
template <class T>
__device__ __forceinline__ Pack<T> load_state(const T* p, bool own) {
  const auto* from = reinterpret_cast<const Wide<T>*>(p);
  return own ? pack(*from) : pack(__ldcg(from));
}
template <class T>
__device__ __forceinline__ Pack<T> load_constant(const T* p) {
  return pack(__ldg(reinterpret_cast<const Wide<T>*>(p)));
}
__device__ __forceinline__ void store(double* p, const Pack<double>& a) {
  *reinterpret_cast<double2*>(p) = {a.v[0], a.v[1]};
}
__device__ __forceinline__ void store(float* p, const Pack<float>& a) {
  *reinterpret_cast<float4*>(p) = {a.v[0], a.v[1], a.v[2], a.v[3]};
}

// Rows of x, y, z and one unused scalar.
template <class T>
__device__ __forceinline__ Vec3<T> load_row(const T* rows, int64_t row, bool own = false) {
  const T* p = rows + kRow * row;
  const Pack<T> a = load_state(p, own);
  if constexpr (Pack<T>::size == 4) {
    return {a.v[0], a.v[1], a.v[2]};
  } else {
    return {a.v[0], a.v[1], load_state(p + 2, own).v[0]};
  }
}
template <class T>
__device__ __forceinline__ void store_row(T* rows, int64_t row, const Vec3<T>& a) {
  T* p = rows + kRow * row;
  if constexpr (Pack<T>::size == 4) {
    store(p, Pack<T>{a.x, a.y, a.z, T(0)});
  } else {
    store(p, Pack<T>{a.x, a.y});
    store(p + 2, Pack<T>{a.z, T(0)});
  }
}
// Packed vectors [blocks, 3, kSlice].
template <class T>
__device__ __forceinline__ Vec3<T> load3(const T* p, int block, int v) {
  const T* a = p + static_cast<int64_t>(block) * 3 * kSlice + v;
  return {__ldg(a), __ldg(a + kSlice), __ldg(a + 2 * kSlice)};
}
template <class T>
__device__ __forceinline__ void store3(T* p, int block, int v, const Vec3<T>& b) {
  T* a = p + static_cast<int64_t>(block) * 3 * kSlice + v;
  a[0] = b.x;
  a[kSlice] = b.y;
  a[2 * kSlice] = b.z;
}
// One that only this thread writes, so that it may change during the launch.
template <class T>
__device__ __forceinline__ Vec3<T> load_own3(const T* p, int block, int v) {
  const T* a = p + static_cast<int64_t>(block) * 3 * kSlice + v;
  return {a[0], a[kSlice], a[2 * kSlice]};
}

// Calls f(number) for the numbers of a value.
template <class T, class F>
__device__ __forceinline__ void each_number(T& a, const F& f) {
  f(a);
}
template <class T, class F>
__device__ __forceinline__ void each_number(Vec3<T>& a, const F& f) {
  f(a.x), f(a.y), f(a.z);
}
template <class T, class F>
__device__ __forceinline__ void each_number(Sym3<T>& a, const F& f) {
  f(a.xx), f(a.xy), f(a.xz), f(a.yy), f(a.yz), f(a.zz);
}
template <class T, int n, class F>
__device__ __forceinline__ void each_number(T (&a)[n], const F& f) {
#pragma unroll
  for (int k = 0; k < n; ++k) f(a[k]);
}
// Calls f(array) with the numbers of type T of some values, and stores the array back.
template <class T, class F, class... R>
__device__ __forceinline__ void change_numbers(const F& f, R&... values) {
  T all[(sizeof(R) + ...) / sizeof(T)];
  int k = 0;
  (each_number(values, [&](T& a) { all[k++] = a; }), ...);
  f(all);
  k = 0;
  (each_number(values, [&](T& a) { a = all[k++]; }), ...);
}

// Number of a thread's warp. The first lane broadcasts it, so that the compiler keeps it and its consequences in
// uniform registers.
__device__ __forceinline__ int warp_of_block() {
  return __shfl_sync(kWholeWarp, static_cast<int>(threadIdx.x) / kSlice, 0);
}

// Begin and end of a block's part of an array. The load is volatile: the compiler would delay each load, and their
// latencies would add up.
struct Span {
  int begin, end;
};
__device__ __forceinline__ Span span_of(const int32_t* starts, int block) {
  Span out;
  asm volatile("ld.global.nc.s32 %0, [%1];" : "=r"(out.begin) : "l"(starts + block));
  asm volatile("ld.global.nc.s32 %0, [%1];" : "=r"(out.end) : "l"(starts + block + 1));
  return out;
}
// Spans of a block's vertices: slots of their pairs, edges to their neighbours.
struct StarSpans {
  Span slots, edges;
};
__device__ __forceinline__ StarSpans spans_of(const GroupPlan& plan, int block) {
  return {span_of(plan.block_slot, block), span_of(plan.block_edge, block)};
}

// Layout of a thread: vertex `v` of a block and lane among its `lanes` threads. Neighbouring threads have neighbouring
// vertices, so that their loads coalesce.
template <int lanes_>
struct LaneLayout {
  static constexpr int lanes = threads_of(lanes_), groups = kSlice / lanes;  // vertices of a warp
  int64_t scene;
  int block, v, group, lane;
  __device__ __forceinline__ LaneLayout(int64_t scene, int block, int part)
      : scene(scene), block(block), group(threadIdx.x % groups), lane(threadIdx.x % kSlice / groups) {
    v = part * groups + group;
  }
  // Sums over the threads of a vertex of numbers of type T, vectors, matrices and arrays of these.
  template <class T, class... R>
  __device__ __forceinline__ static void sum(R&... values) {
    change_numbers<T>(
        [](auto& all) {
#pragma unroll
          for (int offset = groups; offset < kSlice; offset *= 2) add_from(all, offset);
        },
        values...);
  }
};

}  // namespace diffvbd::cuda
