// Compact list of pairs (contact/pair_list.h): a part of a list in the memory of the whole; the host does not learn its
// size.
#include <cub/device/device_scan.cuh>

#include "common.cuh"
#include "contact.h"
#include "warp_reduce.cuh"

namespace diffvbd::cuda {
namespace {

using namespace contact;

constexpr int kThreads = 128, kWarp = 32;

template <class T>
__global__ void __launch_bounds__(kThreads) flag_pairs(const __grid_constant__ CompactInputs<T> in, int32_t* kept) {
  const int64_t i = own_item(kThreads);
  if (i <= in.count) kept[i] = i < in.count && stays(in, i) ? 1 : 0;
}
// Calls f(number(entry), index in the compact list) for the entries of a corner point whose pairs stay, a warp for each
// corner. Returns how many there are.
template <class T, class Number, class F>
__device__ int32_t each_kept(const CompactInputs<T>& in, int64_t corner, const Number& number, const F& f) {
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
      numbers[u] = entries[u] >= 0 && in.keep[entries[u] >> 2] ? number(entries[u]) : -1;
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
__device__ void count_entries_of(const CompactInputs<T>& in, int64_t corner, int32_t* counts) {
  if (corner > in.corners) return;
  const int32_t count =
      corner < in.corners ? each_kept(in, corner, [](int32_t entry) { return entry; }, [](int32_t, int32_t) {}) : 0;
  if (threadIdx.x % kWarp == 0) counts[corner] = count;
}
template <class T>
__device__ void copy_entries_of(const CompactInputs<T>& in, const int32_t* kept, int64_t corner, int32_t first,
                                const CompactList<T>& out) {
  int32_t* to = out.entry + first;
  each_kept(
      in, corner, [&](int32_t entry) { return 4 * kept[entry >> 2] + (entry & 3); },
      [&](int32_t entry, int32_t place) { to[place] = entry; });
}

template <class T>
__global__ void __launch_bounds__(kThreads)
    count_entries(const __grid_constant__ CompactInputs<T> in, int32_t* counts) {
  count_entries_of(in, own_item(kThreads) / kWarp, counts);
}
template <class T>
__global__ void __launch_bounds__(kThreads) copy_pairs(const __grid_constant__ CompactInputs<T> in, const int32_t* kept,
                                                       const __grid_constant__ CompactList<T> out) {
  const int64_t i = own_item(kThreads);
  if (i >= in.count) return;
  if (stays(in, i)) copy_pair(in, i, kept[i], out);
  if (kept[in.count] <= i) leave_empty(i, out);
}
template <class T>
__global__ void __launch_bounds__(kThreads)
    copy_entries(const __grid_constant__ CompactInputs<T> in, const int32_t* kept,
                 const __grid_constant__ CompactList<T> out) {
  const int64_t i = own_item(kThreads) / kWarp;
  if (i < in.corners) copy_entries_of(in, kept, i, out.ptr[i], out);
}

// Short lists: each block sums what precedes its part itself, two launches in place of eight.
constexpr int64_t kFewPairs = 1 << 15, kFewCorners = 1 << 12;

template <class T>
bool are_few(const CompactInputs<T>& in) {
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
    compact_few_pairs(const __grid_constant__ CompactInputs<T> in, unsigned blocks, int32_t* kept, int32_t* counts,
                      const __grid_constant__ CompactList<T> out) {
  if (blockIdx.x >= blocks) {
    count_entries_of(in, (static_cast<int64_t>(blockIdx.x - blocks) * kThreads + threadIdx.x) / kWarp, counts);
    return;
  }
  __shared__ int of_warps[kThreads / kWarp];
  const int64_t i = own_item(kThreads), listed = in.ptr[in.corners] / 4;
  const unsigned lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
  const bool own = i < in.count && stays(in, i);
  const unsigned found = __ballot_sync(kWholeWarp, own);
  if (lane == 0) of_warps[warp] = __popc(found);
  const Sums sums = sums_before(static_cast<int64_t>(blockIdx.x) * kThreads, listed < in.count ? listed : in.count,
                                [&](int64_t pair) { return in.keep[pair] ? 1 : 0; });
  if (i >= in.count) return;
  int place = sums.before + __popc(found & ((1u << lane) - 1));
  for (unsigned k = 0; k < warp; ++k) place += of_warps[k];
  kept[i] = place;
  if (own) copy_pair(in, i, place, out);
  if (sums.all <= i) leave_empty(i, out);
}
template <class T>
__global__ void __launch_bounds__(kThreads)
    compact_few_entries(const __grid_constant__ CompactInputs<T> in, const int32_t* kept, const int32_t* counts,
                        const __grid_constant__ CompactList<T> out) {
  const int64_t i = own_item(kThreads) / kWarp, first = static_cast<int64_t>(blockIdx.x) * (kThreads / kWarp);
  int before = sums_before(first, first, [&](int64_t corner) { return counts[corner]; }).all;
  if (i > in.corners) return;
  for (int64_t k = first; k < i; ++k) before += counts[k];
  if (threadIdx.x % kWarp == 0) out.ptr[i] = before;
  if (i < in.corners) copy_entries_of(in, kept, i, before, out);
}

constexpr int64_t aligned(int64_t bytes) { return (bytes + 255) / 256 * 256; }

template <class T>
size_t scan_bytes(const CompactInputs<T>& in) {
  size_t of_pairs = 0, of_corners = 0;
  int32_t* none = nullptr;
  cub::DeviceScan::ExclusiveSum(nullptr, of_pairs, none, none, in.count + 1);
  cub::DeviceScan::ExclusiveSum(nullptr, of_corners, none, none, in.corners + 1);
  return of_pairs < of_corners ? of_corners : of_pairs;
}

}  // namespace

template <class T>
int64_t compact_list_bytes(const CompactInputs<T>& in) {
  if (are_few(in)) return aligned(in.count * sizeof(int32_t)) + aligned((in.corners + 1) * sizeof(int32_t));
  return aligned((in.count + 1) * sizeof(int32_t)) + aligned(static_cast<int64_t>(scan_bytes(in)));
}

template <class T>
cudaError_t compact_list(const CompactInputs<T>& in, const CompactList<T>& out, void* workspace, cudaStream_t stream) {
  auto* kept = static_cast<int32_t*>(workspace);
  const unsigned of_corners = blocks_for((in.corners + 1) * kWarp, kThreads);
  if (are_few(in)) {
    auto* counts = reinterpret_cast<int32_t*>(static_cast<uint8_t*>(workspace) + aligned(in.count * sizeof(int32_t)));
    const unsigned of_pairs = blocks_for(in.count, kThreads);
    compact_few_pairs<T><<<of_pairs + of_corners, kThreads, 0, stream>>>(in, of_pairs, kept, counts, out);
    compact_few_entries<T><<<of_corners, kThreads, 0, stream>>>(in, kept, counts, out);
    return cudaGetLastError();
  }
  void* scan = static_cast<uint8_t*>(workspace) + aligned((in.count + 1) * sizeof(int32_t));
  size_t bytes = scan_bytes(in);
  flag_pairs<T><<<blocks_for(in.count + 1, kThreads), kThreads, 0, stream>>>(in, kept);
  if (auto error = cub::DeviceScan::ExclusiveSum(scan, bytes, kept, kept, in.count + 1, stream)) return error;
  count_entries<T><<<of_corners, kThreads, 0, stream>>>(in, out.ptr);
  if (auto error = cub::DeviceScan::ExclusiveSum(scan, bytes, out.ptr, out.ptr, in.corners + 1, stream)) return error;
  if (in.count > 0) copy_pairs<T><<<blocks_for(in.count, kThreads), kThreads, 0, stream>>>(in, kept, out);
  if (in.corners > 0) copy_entries<T><<<blocks_for(in.corners * kWarp, kThreads), kThreads, 0, stream>>>(in, kept, out);
  return cudaGetLastError();
}

DIFFVBD_INSTANTIATE(compact_list_bytes)
DIFFVBD_INSTANTIATE(compact_list)

}  // namespace diffvbd::cuda
