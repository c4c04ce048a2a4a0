// The near pairs of the vertices of a warp, shared by its threads: few listed pairs are near, and threads that work on
// their own vertex's alone would wait for each other.
#pragma once

#include "contact.h"
#include "group.cuh"

namespace diffvbd::cuda {
namespace {

// An entry of the list, and the thread of the warp that has found it.
struct Found {
  int entry, thread;  // entry < 0: none
  __device__ __forceinline__ bool there() const { return entry >= 0; }
  // The value that this thread has. All threads of the warp must call it.
  template <class U>
  __device__ __forceinline__ U of(U own) const {
    return __shfl_sync(kWholeWarp, own, thread);
  }
  template <class T>
  __device__ __forceinline__ Vec3<T> of(const Vec3<T>& own) const {
    return {of(own.x), of(own.y), of(own.z)};
  }
};
constexpr int kFound = 2 * kSlice;  // that a warp collects before it works on them

// Calls f(Found) for the entries of the warp's vertices that are near(entry), 32 at a time, those of a vertex in the
// order of its list. `share` threads have one vertex, `lane` says which of them this one is. All threads of the warp
// must call it, and call f together. `collected` [kFound] is the warp's, in shared memory.
template <int share, class Near, class F>
__device__ __forceinline__ void each_near(const contact::PairList::Entries& all, int lane, Found* collected,
                                          const Near& near, const F& f) {
  const auto thread = static_cast<int>(threadIdx.x % kSlice);
  int count = 0, first = 0;
  for (bool more = true; more || count > 0;) {
    more = __any_sync(kWholeWarp, first < all.count);
    if (more) {
      const int entry = first + lane < all.count ? all.first[first + lane] : -1;
      const bool is_near = entry >= 0 && near(entry);
      const unsigned threads = __ballot_sync(kWholeWarp, is_near);
      if (is_near) collected[count + __popc(threads & ((1u << thread) - 1))] = {entry, thread};
      count += __popc(threads), first += share;
      __syncwarp();
    }
    if (count == 0 || (more && count < kSlice)) continue;
    f(thread < count ? collected[thread] : Found{-1, thread});  // here alone: what it does is long
    count = count < kSlice ? 0 : count - kSlice;
    const Found left = collected[kSlice + thread];
    __syncwarp();
    if (thread < count) collected[thread] = left;
    __syncwarp();
  }
}

// Adds up gradients and Hessians of the warp's vertices that any of its threads have worked out, always in the same
// order. The threads of a vertex (Place<lanes>) keep its sum together, each some of the numbers.
template <int lanes, class T>
struct BlockSums {
  static constexpr int kGroups = kSlice / lanes, kOwn = (kContactScalars + lanes - 1) / lanes;
  T (*slots)[kContactScalars];  // [32] of the warp, in shared memory
  T own[kOwn] = {};
  // from: a thread of the vertex that g and H belong to. All threads of the warp must call it.
  __device__ __forceinline__ void add(const Vec3<T>& g, const Sym3<T>& H, int from) {
    T values[] = {g.x, g.y, g.z, H.xx, H.xy, H.xz, H.yy, H.yz, H.zz};
    if constexpr (lanes == kSlice) {
      add_of_one(values);
    } else {
      add_of_several(values, from);
    }
  }
  // Of the vertex of this thread.
  __device__ __forceinline__ void store(T* to) const {
    const int lane = threadIdx.x % kSlice / kGroups;
#pragma unroll
    for (int i = 0; i < kOwn; ++i) {
      if (lane + i * lanes < kContactScalars) to[lane + i * lanes] = own[i];
    }
  }

 private:
  // A warp with one vertex.
  __device__ __forceinline__ void add_of_one(T (&values)[kContactScalars]) {
    const int lane = threadIdx.x % kSlice;
#pragma unroll
    for (int offset = 1; offset < kSlice; offset *= 2) add_from(values, offset);
#pragma unroll
    for (int k = 0; k < kContactScalars; ++k) own[0] += lane == k ? values[k] : T(0);
  }
  __device__ __forceinline__ void add_of_several(const T (&values)[kContactScalars], int from) {
    const int thread = threadIdx.x % kSlice, group = thread % kGroups, lane = thread / kGroups;
    for (int k = 0; k < kContactScalars; ++k) slots[thread][k] = values[k];
    unsigned mine = 0;  // threads with something for the vertex of this one
    for (int g_of = 0; g_of < kGroups; ++g_of) {
      const unsigned threads = __ballot_sync(kWholeWarp, from % kGroups == g_of);
      if (group == g_of) mine = threads;
    }
    __syncwarp();
    constexpr int kAhead = 4;  // slots that are read at once
    while (mine) {
      T part[kAhead][kOwn] = {};
#pragma unroll
      for (int u = 0; u < kAhead; ++u, mine &= mine - 1) {
        const T* slot = slots[max(__ffs(static_cast<int>(mine)) - 1, 0)];
#pragma unroll
        for (int i = 0; i < kOwn; ++i) {
          if (mine && lane + i * lanes < kContactScalars) part[u][i] = slot[lane + i * lanes];
        }
      }
#pragma unroll
      for (int u = 0; u < kAhead; ++u) {
#pragma unroll
        for (int i = 0; i < kOwn; ++i) own[i] += part[u][i];
      }
    }
    __syncwarp();
  }
};

}  // namespace
}  // namespace diffvbd::cuda
