#include <algorithm>

#include "detect_list.cuh"
#include "detect_scan.cuh"

namespace diffvbd::cuda {
namespace {

template <class T>
__global__ void start_kernel(const Surfaces<T> in, Workspace<T> work, int64_t capacity) {
  const int64_t i = own_item();
  if (i < in.scenes * in.corners) work.near_gap[i] = ordered(reach_of(in, i / in.corners)), work.near_key[i] = kNoKey;
  if (i < capacity) work.keys[i] = in.keys();
  if (i < in.scenes) {
    work.smallest[i] = ordered(reach_of(in, i));
    clear_bounds(work.forest, i);
  }
  if (i == 0) {
    *work.listed = *work.found = work.touching[0] = 0, work.touching[1] = kNoKey;
    work.heavy_count[0] = work.heavy_count[1] = 0;
  }
}

// --- results
// ----------------------------------------------------------------------------------------------------------

// Rows of the list; the corner points of its pairs to be sorted.
template <class T>
__global__ void list_kernel(const Surfaces<T> in, Workspace<T> work, Detected<T> out) {
  const int64_t i = own_item();
  if (i >= out.capacity) return;
  const uint64_t key = work.sorted_keys[i];
  const bool used = key < in.keys();
  int32_t* pair = out.pairs + kPairRow * i;
  store_listed_pair(in, used ? key : kNoKey, pair, out.constants + kConstants * i);
  const int64_t rows = in.scenes * in.corners;
  for (int k = 0; k < 4; ++k) {
    const int64_t point = used ? pair[kPairRow - 1] * int64_t{in.corners} + pair[k] : rows;
    work.points[4 * i + k] = static_cast<uint32_t>(point);
    work.entries[4 * i + k] = used ? static_cast<int32_t>(4 * i + k) : -1;
  }
}

// The near pair of a corner point, and the smallest gap of its scene.
template <class T>
__device__ void store_corner(const Surfaces<T>& in, const Workspace<T>& work, const Detected<T>& out, int64_t point) {
  const int64_t scene = point / in.corners;
  store_near_pair(in, scene, static_cast<int32_t>(point - scene * in.corners), work.near_key[point],
                  out.near_corners + kNearRow * point, out.near_values + kNearValues * point);
  lower(work.smallest + scene, work.near_gap[point]);
}

// ptr, by bisection of the sorted corner points; near pairs; smallest gaps.
template <class T>
__global__ void corner_kernel(const Surfaces<T> in, Workspace<T> work, Detected<T> out) {
  const int64_t i = own_item(), rows = in.scenes * in.corners;
  if (i > rows) return;
  int64_t from = 0, to = 4 * out.capacity;
  while (from < to) {
    const int64_t middle = (from + to) / 2;
    if (work.sorted_points[middle] < i) {
      from = middle + 1;
    } else {
      to = middle;
    }
  }
  out.ptr[i] = static_cast<int32_t>(from);
  if (i < rows) store_corner(in, work, out, i);
}

// Of few pairs: what corner_kernel() does, and the entries, by a block for each corner point.
template <class T>
__global__ void __launch_bounds__(kThreads) entry_kernel(const Surfaces<T> in, Workspace<T> work, Detected<T> out) {
  const int64_t i = blockIdx.x;  // up to the number of points, which belongs to none
  list_entries(in, out, i, pairs_of(work, out));
  if (i < in.scenes * in.corners && threadIdx.x == 0) store_corner(in, work, out, i);
}

// What a pair's neighbourhood suggests, once the near pairs are there.
template <class T>
__global__ void hint_kernel(const Surfaces<T> in, Detected<T> out) {
  const int64_t i = own_item();
  if (i < out.capacity) store_hints(in, out, out.pairs + kPairRow * i, out.constants + kConstants * i);
}

template <class T>
__global__ void finish_kernel(int64_t scenes, Workspace<T> work, Detected<T> out) {
  const int64_t i = own_item();
  if (i < scenes) out.smallest[i] = value_of<T>(work.smallest[i]);
  if (i != 0) return;
  out.counts[0] = static_cast<int64_t>(*work.listed), out.counts[1] = static_cast<int64_t>(work.touching[0]);
  out.counts[2] = static_cast<int64_t>(work.touching[1]), out.counts[3] = 0;  // kNoKey is -1
}

// Rows and entries of many pairs, sorted; what each corner point has.
template <class T>
cudaError_t sort_list(const Surfaces<T>& in, const Workspace<T>& work, const Detected<T>& out, cudaStream_t stream) {
  const int64_t rows = in.scenes * in.corners, capacity = out.capacity;
  if (capacity > 0) {
    size_t bytes = work.sort_bytes;
    if (auto error = cub::DeviceRadixSort::SortKeys(work.sort, bytes, work.keys, work.sorted_keys, capacity, 0,
                                                    bits_of(in.keys()), stream))
      return error;
    list_kernel<<<blocks_for(capacity), kThreads, 0, stream>>>(in, work, out);
    bytes = work.sort_bytes;
    if (auto error =
            cub::DeviceRadixSort::SortPairs(work.sort, bytes, work.points, work.sorted_points, work.entries, out.entry,
                                            4 * capacity, 0, bits_of(static_cast<uint64_t>(rows)), stream))
      return error;
  }
  corner_kernel<<<blocks_for(rows + 1), kThreads, 0, stream>>>(in, work, out);
  return cudaSuccess;
}

}  // namespace

template <class T>
size_t detect_workspace_bytes(const Surfaces<T>& in, int64_t capacity) {
  return Workspace<T>(in, capacity, nullptr).bytes;
}

template <class T>
cudaError_t detect(const Surfaces<T>& in, const Detected<T>& out, void* memory, cudaStream_t stream) {
  Workspace<T> work(in, out.capacity, memory);
  const int64_t rows = in.scenes * in.corners, capacity = out.capacity;
  const int64_t most = rows > capacity ? rows : capacity;
  work.forest.sorted = !is_scanned(in);
  start_kernel<<<blocks_for((most > in.scenes ? most : in.scenes) + 1), kThreads, 0, stream>>>(in, work, capacity);
  if (auto error = build_forest(in, work.forest, work.sort, work.sort_bytes, stream)) return error;
  if (work.forest.sorted) {
    launch_search<T, false>(in, work, capacity, stream);
    launch_search<T, true>(in, work, capacity, stream);
  } else {
    launch_scan<T, false>(in, work, capacity, stream);
    launch_scan<T, true>(in, work, capacity, stream);
  }
  if (capacity > 0) settle_kernel<<<blocks_for(kCandidates * capacity), kThreads, 0, stream>>>(in, work, capacity);
  if (is_counted(in, capacity)) {
    const unsigned blocks = std::min(kRankBlocks, static_cast<unsigned>(blocks_for(kWarp * capacity)));
    rank_kernel<<<blocks, kThreads, 0, stream>>>(in, work, out);
    entry_kernel<<<static_cast<unsigned>(rows + 1), kThreads, 0, stream>>>(in, work, out);
  } else if (auto error = sort_list(in, work, out, stream)) {
    return error;
  }
  if (capacity > 0) hint_kernel<<<blocks_for(capacity), kThreads, 0, stream>>>(in, out);
  finish_kernel<<<blocks_for(in.scenes + 1), kThreads, 0, stream>>>(in.scenes, work, out);
  return cudaGetLastError();
}

#define DIFFVBD_INSTANTIATE(T)                                            \
  template size_t detect_workspace_bytes<T>(const Surfaces<T>&, int64_t); \
  template cudaError_t detect<T>(const Surfaces<T>&, const Detected<T>&, void*, cudaStream_t);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd::cuda
