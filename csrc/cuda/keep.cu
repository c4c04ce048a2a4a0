#include <cub/device/device_scan.cuh>

#include "exchange.cuh"
#include "keep.h"

namespace diffvbd::cuda {
namespace {

using namespace contact;

constexpr int kThreads = 128, kWarp = 32;

unsigned blocks_for(int64_t items) { return static_cast<unsigned>((items + kThreads - 1) / kThreads); }
__device__ __forceinline__ int64_t own_item() { return static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x; }

template <class T>
__global__ void __launch_bounds__(kThreads) flag_pairs(const __grid_constant__ KeepInputs<T> in, int32_t* kept) {
  const int64_t i = own_item();
  if (i <= in.count) kept[i] = i < in.count && stays(in, i) ? 1 : 0;
}
// Calls f(entry in the shorter list, its place) for the pairs of a corner point that stay; a warp for each. Returns how
// many there are.
template <class T, class F>
__device__ int32_t each_kept(const KeepInputs<T>& in, const int32_t* kept, int64_t corner, const F& f) {
  constexpr int kAhead = 8;  // entries of a thread that are read at once: a corner of a collider may have thousands
  const unsigned lane = threadIdx.x % kWarp;
  const int32_t end = in.ptr[corner + 1];
  int32_t count = 0;
  for (int32_t first = in.ptr[corner]; first < end; first += kAhead * kWarp) {
    int32_t entries[kAhead], places[kAhead];
#pragma unroll
    for (int u = 0; u < kAhead; ++u) {
      const int32_t own = first + u * kWarp + static_cast<int32_t>(lane);
      entries[u] = own < end ? in.entry[own] : -1;
    }
#pragma unroll
    for (int u = 0; u < kAhead; ++u) {
      places[u] = entries[u] >= 0 && in.keep[entries[u] >> 2] ? 4 * kept[entries[u] >> 2] + (entries[u] & 3) : -1;
    }
#pragma unroll
    for (int u = 0; u < kAhead; ++u) {
      const unsigned found = __ballot_sync(kWholeWarp, places[u] >= 0);
      if (places[u] >= 0) f(places[u], count + __popc(found & ((1u << lane) - 1)));
      count += __popc(found);
    }
  }
  return count;
}
template <class T>
__global__ void __launch_bounds__(kThreads)
    count_entries(const __grid_constant__ KeepInputs<T> in, const int32_t* kept, int32_t* counts) {
  const int64_t i = own_item() / kWarp;
  if (i > in.corners) return;
  const int32_t count = i < in.corners ? each_kept(in, kept, i, [](int32_t, int32_t) {}) : 0;
  if (threadIdx.x % kWarp == 0) counts[i] = count;
}
template <class T>
__global__ void __launch_bounds__(kThreads)
    copy_pairs(const __grid_constant__ KeepInputs<T> in, const int32_t* kept, const __grid_constant__ Kept<T> out) {
  const int64_t i = own_item();
  if (i >= in.count) return;
  if (stays(in, i)) copy_pair(in, i, kept[i], out);
  if (kept[in.count] <= i) leave_empty(i, out);
}
template <class T>
__global__ void __launch_bounds__(kThreads)
    copy_entries(const __grid_constant__ KeepInputs<T> in, const int32_t* kept, const __grid_constant__ Kept<T> out) {
  const int64_t i = own_item() / kWarp;
  if (i >= in.corners) return;
  int32_t* to = out.entry + out.ptr[i];
  each_kept(in, kept, i, [&](int32_t entry, int32_t place) { to[place] = entry; });
}

constexpr int64_t aligned(int64_t bytes) { return (bytes + 255) / 256 * 256; }

template <class T>
size_t scan_bytes(const KeepInputs<T>& in) {
  size_t of_pairs = 0, of_corners = 0;
  int32_t* none = nullptr;
  cub::DeviceScan::ExclusiveSum(nullptr, of_pairs, none, none, in.count + 1);
  cub::DeviceScan::ExclusiveSum(nullptr, of_corners, none, none, in.corners + 1);
  return of_pairs < of_corners ? of_corners : of_pairs;
}

}  // namespace

template <class T>
int64_t keep_bytes(const KeepInputs<T>& in) {
  return aligned((in.count + 1) * sizeof(int32_t)) + aligned(static_cast<int64_t>(scan_bytes(in)));
}

template <class T>
cudaError_t keep(const KeepInputs<T>& in, const Kept<T>& out, void* workspace, cudaStream_t stream) {
  auto* kept = static_cast<int32_t*>(workspace);
  void* scan = static_cast<uint8_t*>(workspace) + aligned((in.count + 1) * sizeof(int32_t));
  size_t bytes = scan_bytes(in);
  flag_pairs<T><<<blocks_for(in.count + 1), kThreads, 0, stream>>>(in, kept);
  if (auto error = cub::DeviceScan::ExclusiveSum(scan, bytes, kept, kept, in.count + 1, stream)) return error;
  count_entries<T><<<blocks_for((in.corners + 1) * kWarp), kThreads, 0, stream>>>(in, kept, out.ptr);
  if (auto error = cub::DeviceScan::ExclusiveSum(scan, bytes, out.ptr, out.ptr, in.corners + 1, stream)) return error;
  if (in.count > 0) copy_pairs<T><<<blocks_for(in.count), kThreads, 0, stream>>>(in, kept, out);
  if (in.corners > 0) copy_entries<T><<<blocks_for(in.corners * kWarp), kThreads, 0, stream>>>(in, kept, out);
  return cudaGetLastError();
}

#define DIFFVBD_INSTANTIATE(T)                          \
  template int64_t keep_bytes<T>(const KeepInputs<T>&); \
  template cudaError_t keep<T>(const KeepInputs<T>&, const Kept<T>&, void*, cudaStream_t);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd::cuda
