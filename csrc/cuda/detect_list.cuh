// The list of few pairs, in order without a sort: each key counts the keys before it, and each corner point looks for
// its pairs.
#pragma once

#include "detect_search.cuh"

namespace diffvbd::cuda {
namespace {

constexpr int64_t kMostCounted = 20480;  // pairs that fit, mostly twice as many as there are
constexpr int64_t kMostPoints = 2048;    // corner points of all scenes
constexpr unsigned kRankBlocks = 264;

template <class T>
bool is_counted(const Surfaces<T>& in, int64_t capacity) {
  return 0 < capacity && capacity <= kMostCounted && in.scenes * in.corners <= kMostPoints;
}

// Pairs in the list, of those that it needs.
template <class T>
__device__ int32_t pairs_of(const Workspace<T>& work, const Detected<T>& out) {
  const auto needed = static_cast<int64_t>(*work.listed);
  return static_cast<int32_t>(needed < out.capacity ? needed : out.capacity);
}

// Rows of the list: a warp for each key.
template <class T>
__global__ void __launch_bounds__(kThreads) rank_kernel(const Surfaces<T> in, Workspace<T> work, Detected<T> out) {
  const int32_t count = pairs_of(work, out), lane = threadIdx.x % kWarp;
  const auto first = static_cast<int32_t>(own_item()), threads = static_cast<int32_t>(gridDim.x * kThreads);
  for (int32_t i = first / kWarp; i < count; i += threads / kWarp) {
    const unsigned long long key = work.keys[i];
    unsigned rank = 0;
#pragma unroll 8
    for (int32_t other = lane; other < count; other += kWarp) rank += work.keys[other] < key ? 1 : 0;
    rank = __reduce_add_sync(kWholeWarp, rank);
    if (lane == 0) store_listed_pair(in, key, out.pairs + kPairRow * rank, out.constants + kConstants * rank);
  }
  for (int64_t i = count + first; i < out.capacity; i += threads) {
    store_listed_pair(in, kNoKey, out.pairs + kPairRow * i, out.constants + kConstants * i);
    for (int k = 0; k < 4; ++k) out.entry[4 * i + k] = -1;
  }
}

// Calls f(pair, its four corner points among those of all scenes) for the pairs [first, last), one for each lane of a
// warp; the points are -1 where a lane has none.
template <class T, class F>
__device__ void each_pair(const Surfaces<T>& in, const Detected<T>& out, int32_t first, int32_t last, const F& f) {
  const int32_t lane = threadIdx.x % kWarp;
  for (; first < last; first += kWarp) {
    const int32_t pair = first + lane;
    const int32_t* row = out.pairs + kPairRow * pair;
    int64_t points[4] = {-1, -1, -1, -1};
    for (int k = 0; k < 4 && pair < last; ++k) points[k] = row[kPairRow - 1] * int64_t{in.corners} + row[k];
    f(pair, points);
  }
}

// ptr and entries of a corner point, by a block, each warp of which looks at a part of the list: how many entries those
// before it have, and its own.
template <class T>
__device__ void list_entries(const Surfaces<T>& in, const Detected<T>& out, int64_t point, int32_t count) {
  constexpr int warps = kThreads / kWarp;
  __shared__ unsigned before[warps], own[warps];
  const int warp = static_cast<int>(threadIdx.x) / kWarp;
  const int32_t part = (count + kThreads - 1) / kThreads * kWarp;
  const int32_t first = part * warp, end = first + part, last = end < count ? end : count;
  unsigned less = 0, equal = 0;
  each_pair(in, out, first, last, [&](int32_t, const int64_t* points) {
    for (int k = 0; k < 4; ++k) {
      less += 0 <= points[k] && points[k] < point ? 1 : 0;
      equal += points[k] == point ? 1 : 0;
    }
  });
  less = __reduce_add_sync(kWholeWarp, less), equal = __reduce_add_sync(kWholeWarp, equal);
  const unsigned lane = threadIdx.x % kWarp, lanes_before = (1u << lane) - 1;
  if (lane == 0) before[warp] = less, own[warp] = equal;
  __syncthreads();
  unsigned begin = 0, skipped = 0;
  for (int w = 0; w < warps; ++w) begin += before[w], skipped += w < warp ? own[w] : 0;
  if (threadIdx.x == 0) out.ptr[point] = static_cast<int32_t>(begin);
  if (equal == 0) return;
  int32_t* to = out.entry + begin + skipped;
  each_pair(in, out, first, last, [&](int32_t pair, const int64_t* points) {
    int place = 0, found = 0;
    for (int k = 0; k < 4; ++k) {
      const unsigned has = __ballot_sync(kWholeWarp, points[k] == point);
      place += __popc(has & lanes_before), found += __popc(has);
    }
    for (int k = 0; k < 4; ++k) {
      if (points[k] == point) to[place++] = 4 * pair + k;
    }
    to += found;
  });
}

}  // namespace
}  // namespace diffvbd::cuda
