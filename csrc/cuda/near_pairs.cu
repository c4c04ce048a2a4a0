// The near pairs of a list (contact/pair_list.h), in memory for the whole: the host does not learn how many there are.
#include <cub/device/device_scan.cuh>

#include "common.cuh"
#include "contact.h"
#include "warp_reduce.cuh"

namespace diffvbd::cuda {
namespace {

using namespace contact;

constexpr int kThreads = 128, kWarp = 32;

// The gap of each pair, and what is left of the radii of each vertex.
template <class T>
__global__ void __launch_bounds__(kThreads)
    find_gaps(const __grid_constant__ NearInputs<T> in, int64_t rows, T* gaps, T* radius) {
  const int64_t i = own_item(kThreads);
  const auto left = [&](int64_t scene, int32_t v) { return in.radius_left(scene, v); };
  if (i < in.count) gaps[i] = near_gap(in, i, left);
  if (i < rows) radius[i] = in.radius_left(i / in.vertices, static_cast<int32_t>(i % in.vertices));
}
template <class T>
__global__ void __launch_bounds__(kThreads) flag_pairs(int64_t count, const T* gaps, int32_t* kept) {
  const int64_t i = own_item(kThreads);
  if (i <= count) kept[i] = i < count && is_near(gaps[i]) ? 1 : 0;
}
// Calls f(number(entry), index in the list of near pairs) for the entries of a corner point whose pairs stay, a warp
// for each corner. Returns how many there are.
template <class T, class Number, class F>
__device__ int32_t each_kept(const NearInputs<T>& in, const T* gaps, int64_t corner, const Number& number, const F& f) {
  constexpr int kAhead = 8;  // entries of a thread that are read at once: a corner of a collider may have thousands
  const unsigned lane = threadIdx.x % kWarp;
  const int32_t end = in.ptr[corner + 1];
  int32_t count = 0;
  for (int32_t first = in.ptr[corner]; first < end; first += kAhead * kWarp) {
    int32_t entries[kAhead], numbers[kAhead];  // -1: dropped
#pragma unroll
    for (int u = 0; u < kAhead; ++u) {
      const int32_t own = first + u * kWarp + static_cast<int32_t>(lane);
      entries[u] = own < end ? in.entry[own] : -1;
    }
#pragma unroll
    for (int u = 0; u < kAhead; ++u) {
      numbers[u] = entries[u] >= 0 && is_near(gaps[entries[u] >> 2]) ? number(entries[u]) : -1;
    }
#pragma unroll
    for (int u = 0; u < kAhead; ++u) {
      const unsigned found = __ballot_sync(kWholeWarp, numbers[u] >= 0);
      if (numbers[u] >= 0) f(numbers[u], count + __popc(found & ((1u << lane) - 1)));
      count += __popc(found);
    }
  }
  return count;
}
template <class T>
__device__ void count_entries_of(const NearInputs<T>& in, const T* gaps, int64_t corner, int32_t* counts) {
  if (corner > in.corners) return;
  const int32_t count = corner < in.corners
                            ? each_kept(
                                  in, gaps, corner, [](int32_t entry) { return entry; }, [](int32_t, int32_t) {})
                            : 0;
  if (threadIdx.x % kWarp == 0) counts[corner] = count;
}
template <class T>
__device__ void copy_entries_of(const NearInputs<T>& in, const T* gaps, const int32_t* kept, int64_t corner,
                                int32_t first, const NearList<T>& out) {
  int32_t* to = out.entry + first;
  each_kept(
      in, gaps, corner, [&](int32_t entry) { return 4 * kept[entry >> 2] + (entry & 3); },
      [&](int32_t entry, int32_t place) { to[place] = entry; });
}

template <class T>
__global__ void __launch_bounds__(kThreads)
    count_entries(const __grid_constant__ NearInputs<T> in, const T* gaps, int32_t* counts) {
  count_entries_of(in, gaps, own_item(kThreads) / kWarp, counts);
}
template <class T>
__global__ void __launch_bounds__(kThreads) copy_pairs(const __grid_constant__ NearInputs<T> in, const T* gaps,
                                                       const int32_t* kept, const __grid_constant__ NearList<T> out) {
  const int64_t i = own_item(kThreads);
  if (i >= in.count) return;
  if (is_near(gaps[i])) copy_pair(in, i, gaps[i], kept[i], out);
  if (kept[in.count] <= i) leave_empty(i, out);
}
template <class T>
__global__ void __launch_bounds__(kThreads) copy_entries(const __grid_constant__ NearInputs<T> in, const T* gaps,
                                                         const int32_t* kept, const __grid_constant__ NearList<T> out) {
  const int64_t i = own_item(kThreads) / kWarp;
  if (i < in.corners) copy_entries_of(in, gaps, kept, i, out.ptr[i], out);
}

// Short lists: each block sums what precedes its part itself, two launches in place of eight.
constexpr int64_t kFewPairs = 1 << 15, kFewCorners = 1 << 12;

template <class T>
bool are_few(const NearInputs<T>& in) {
  return in.count <= kFewPairs && in.corners <= kFewCorners;
}

struct Sums {
  int before, all;
};
// Sums over the threads of a block; all must call it.
__device__ Sums sums_of_block(Sums own) {
  __shared__ int before[kThreads / kWarp], all[kThreads / kWarp];
  const unsigned warp = threadIdx.x / kWarp;
  own = {__reduce_add_sync(kWholeWarp, own.before), __reduce_add_sync(kWholeWarp, own.all)};
  if (threadIdx.x % kWarp == 0) before[warp] = own.before, all[warp] = own.all;
  __syncthreads();
  Sums sum{0, 0};
  for (int i = 0; i < kThreads / kWarp; ++i) sum.before += before[i], sum.all += all[i];
  return sum;
}
// Sum of value(i) over i in [0, end), and over those below `first`.
template <class Value>
__device__ Sums sums_before(int64_t first, int64_t end, const Value& value) {
  Sums own{0, 0};
#pragma unroll 8
  for (int64_t i = threadIdx.x; i < end; i += kThreads) {
    const int one = value(i);
    own.all += one;
    if (i < first) own.before += one;
  }
  return sums_of_block(own);
}

// The first blocks copy pairs; the others count the entries that corner points keep.
template <class T>
__global__ void __launch_bounds__(kThreads)
    copy_few_pairs(const __grid_constant__ NearInputs<T> in, const T* gaps, unsigned blocks, int32_t* kept,
                   int32_t* counts, const __grid_constant__ NearList<T> out) {
  if (blockIdx.x >= blocks) {
    count_entries_of(in, gaps, (static_cast<int64_t>(blockIdx.x - blocks) * kThreads + threadIdx.x) / kWarp, counts);
    return;
  }
  __shared__ int of_warps[kThreads / kWarp];
  const int64_t i = own_item(kThreads), listed = in.ptr[in.corners] / 4;
  const unsigned lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
  const bool own = i < in.count && is_near(gaps[i]);
  const unsigned found = __ballot_sync(kWholeWarp, own);
  if (lane == 0) of_warps[warp] = __popc(found);
  const Sums sums = sums_before(static_cast<int64_t>(blockIdx.x) * kThreads, listed < in.count ? listed : in.count,
                                [&](int64_t pair) { return is_near(gaps[pair]) ? 1 : 0; });
  if (i >= in.count) return;
  int place = sums.before + __popc(found & ((1u << lane) - 1));
  for (unsigned k = 0; k < warp; ++k) place += of_warps[k];
  kept[i] = place;
  if (own) copy_pair(in, i, gaps[i], place, out);
  if (sums.all <= i) leave_empty(i, out);
}
template <class T>
__global__ void __launch_bounds__(kThreads)
    copy_few_entries(const __grid_constant__ NearInputs<T> in, const T* gaps, const int32_t* kept,
                     const int32_t* counts, const __grid_constant__ NearList<T> out) {
  const int64_t i = own_item(kThreads) / kWarp, first = static_cast<int64_t>(blockIdx.x) * (kThreads / kWarp);
  int before = sums_before(first, first, [&](int64_t corner) { return counts[corner]; }).all;
  if (i > in.corners) return;
  for (int64_t k = first; k < i; ++k) before += counts[k];
  if (threadIdx.x % kWarp == 0) out.ptr[i] = before;
  if (i < in.corners) copy_entries_of(in, gaps, kept, i, before, out);
}

template <class T>
size_t scan_bytes(const NearInputs<T>& in) {
  size_t of_pairs = 0, of_corners = 0;
  int32_t* none = nullptr;
  cub::DeviceScan::ExclusiveSum(nullptr, of_pairs, none, none, in.count + 1);
  cub::DeviceScan::ExclusiveSum(nullptr, of_corners, none, none, in.corners + 1);
  return of_pairs < of_corners ? of_corners : of_pairs;
}

// Parts of the workspace; without memory, its size.
template <class T>
struct NearWork {
  T* gaps;
  int32_t *kept, *counts = nullptr;
  uint8_t* scan = nullptr;
  size_t scanned = 0;
  int64_t bytes;
  NearWork(const NearInputs<T>& in, void* workspace) {
    Parts<16> take(workspace);
    take(gaps, in.count), take(kept, in.count + 1);
    if (are_few(in)) {
      take(counts, in.corners + 1);
    } else {
      scanned = scan_bytes(in), take(scan, static_cast<int64_t>(scanned));
    }
    bytes = static_cast<int64_t>(take.bytes);
  }
};

}  // namespace

template <class T>
int64_t near_workspace_bytes(const NearInputs<T>& in) {
  return NearWork<T>(in, nullptr).bytes;
}

template <class T>
cudaError_t find_near(const NearInputs<T>& in, int64_t scenes, T* radius, const NearList<T>& out, void* workspace,
                      cudaStream_t stream) {
  const NearWork<T> work(in, workspace);
  const T* gaps = work.gaps;
  int32_t* kept = work.kept;
  const int64_t rows = scenes * in.vertices;
  const unsigned of_corners = blocks_for((in.corners + 1) * kWarp, kThreads);
  if (const int64_t items = in.count < rows ? rows : in.count; items > 0) {
    find_gaps<T><<<blocks_for(items, kThreads), kThreads, 0, stream>>>(in, rows, work.gaps, radius);
  }
  if (are_few(in)) {
    const unsigned of_pairs = blocks_for(in.count, kThreads);
    copy_few_pairs<T><<<of_pairs + of_corners, kThreads, 0, stream>>>(in, gaps, of_pairs, kept, work.counts, out);
    copy_few_entries<T><<<of_corners, kThreads, 0, stream>>>(in, gaps, kept, work.counts, out);
    return cudaGetLastError();
  }
  size_t bytes = work.scanned;
  flag_pairs<T><<<blocks_for(in.count + 1, kThreads), kThreads, 0, stream>>>(in.count, gaps, kept);
  if (auto error = cub::DeviceScan::ExclusiveSum(work.scan, bytes, kept, kept, in.count + 1, stream)) return error;
  count_entries<T><<<of_corners, kThreads, 0, stream>>>(in, gaps, out.ptr);
  if (auto error = cub::DeviceScan::ExclusiveSum(work.scan, bytes, out.ptr, out.ptr, in.corners + 1, stream)) {
    return error;
  }
  if (in.count > 0) copy_pairs<T><<<blocks_for(in.count, kThreads), kThreads, 0, stream>>>(in, gaps, kept, out);
  if (in.corners > 0) {
    copy_entries<T><<<blocks_for(in.corners * kWarp, kThreads), kThreads, 0, stream>>>(in, gaps, kept, out);
  }
  return cudaGetLastError();
}

DIFFVBD_INSTANTIATE(near_workspace_bytes)
DIFFVBD_INSTANTIATE(find_near)

}  // namespace diffvbd::cuda
