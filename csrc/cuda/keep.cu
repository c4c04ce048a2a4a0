#include <cub/device/device_scan.cuh>

#include "keep.h"

namespace diffvbd::cuda {
namespace {

using namespace contact;

constexpr int kThreads = 128;

unsigned blocks_for(int64_t items) { return static_cast<unsigned>((items + kThreads - 1) / kThreads); }
__device__ __forceinline__ int64_t own_item() { return static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x; }

template <class T>
__global__ void __launch_bounds__(kThreads) flag_pairs(const __grid_constant__ KeepInputs<T> in, int32_t* kept) {
  const int64_t i = own_item();
  if (i <= in.count) kept[i] = i < in.count && stays(in, i) ? 1 : 0;
}
template <class T>
__global__ void __launch_bounds__(kThreads)
    count_entries(const __grid_constant__ KeepInputs<T> in, const int32_t* kept, int32_t* counts) {
  const int64_t i = own_item();
  if (i > in.corners) return;
  int32_t count = 0;
  if (i < in.corners) each_entry(in, kept, i, [&](int32_t) { ++count; });
  counts[i] = count;
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
  const int64_t i = own_item();
  if (i >= in.corners) return;
  int32_t at = out.ptr[i];
  each_entry(in, kept, i, [&](int32_t entry) { out.entry[at++] = entry; });
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
  count_entries<T><<<blocks_for(in.corners + 1), kThreads, 0, stream>>>(in, kept, out.ptr);
  if (auto error = cub::DeviceScan::ExclusiveSum(scan, bytes, out.ptr, out.ptr, in.corners + 1, stream)) return error;
  if (in.count > 0) copy_pairs<T><<<blocks_for(in.count), kThreads, 0, stream>>>(in, kept, out);
  if (in.corners > 0) copy_entries<T><<<blocks_for(in.corners), kThreads, 0, stream>>>(in, kept, out);
  return cudaGetLastError();
}

#define DIFFVBD_INSTANTIATE(T)                          \
  template int64_t keep_bytes<T>(const KeepInputs<T>&); \
  template cudaError_t keep<T>(const KeepInputs<T>&, const Kept<T>&, void*, cudaStream_t);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd::cuda
