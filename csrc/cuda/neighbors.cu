#include <cub/device/device_scan.cuh>

#include "../core/hash_grid.h"
#include "common.cuh"
#include "neighbors.h"

namespace diffvbd::cuda {
namespace {

constexpr int kThreads = 128;
constexpr int kShortList = 24;  // neighbors of a point that a thread sorts in its own memory

// Parts of the workspace; without memory, its size.
template <class T>
struct Workspace {
  int32_t* start;  // of each bucket
  int64_t* first;  // of the pairs of each row; before the sum, their number
  int32_t* rank;   // of each row among those of its bucket
  uint32_t* bucket;
  GridPoint<T>* sorted;
  int32_t* infinite;  // whether a coordinate is not finite
  unsigned char* scan;
  size_t scan_bytes = 0, bytes = 0;

  Workspace(const HashGrid& grid, int64_t rows, void* memory) {
    Parts<> take(memory);
    take(start, int64_t{grid.buckets()} + 1);
    take(infinite, 1);
    take(first, rows + 1);
    take(rank, rows);
    take(bucket, rows);
    take(sorted, rows);
    size_t of_buckets = 0, of_rows = 0;
    cub::DeviceScan::ExclusiveSum(nullptr, of_buckets, start, start, int64_t{grid.buckets()} + 1);
    cub::DeviceScan::ExclusiveSum(nullptr, of_rows, first, first, rows + 1);
    scan_bytes = of_buckets > of_rows ? of_buckets : of_rows;
    take(scan, scan_bytes);
    bytes = take.bytes;
  }
};

template <class T>
__global__ void count_buckets(const T* points, int32_t n, int64_t rows, HashGrid grid, Workspace<T> work) {
  const int64_t row = own_item();
  if (row >= rows) return;
  const T p[3] = {points[3 * row], points[3 * row + 1], points[3 * row + 2]};
  if (!isfinite(p[0]) || !isfinite(p[1]) || !isfinite(p[2])) *work.infinite = 1;
  const uint32_t bucket = grid.bucket(p, static_cast<uint32_t>(row / n));
  work.bucket[row] = bucket;
  // In any order; the list of each point is sorted in the end.
  work.rank[row] = atomicAdd(&work.start[bucket], 1);
}

template <class T>
__global__ void sort_points(const T* points, int64_t rows, Workspace<T> work) {
  const int64_t row = own_item();
  if (row >= rows) return;
  const T* p = points + 3 * row;
  work.sorted[work.start[work.bucket[row]] + work.rank[row]] = {p[0], p[1], p[2], static_cast<int32_t>(row)};
}

// Calls visit(row) for each later neighbor of a point in its scene.
template <class T, class F>
__device__ __forceinline__ void each_later_neighbor(const GridPoint<T>& p, int32_t n, T squared, const HashGrid& grid,
                                                    const Workspace<T>& work, const F& visit) {
  const int32_t scene_end = (p.row / n + 1) * n;
  grid.each_range(work.bucket[p.row], work.start, [&](int32_t from, int32_t to) {
    for (int32_t q = from; q < to; ++q) {
      const GridPoint<T> other = work.sorted[q];
      if (other.row > p.row && other.row < scene_end && within(p, other, squared)) visit(other.row);
    }
  });
}

// A thread for each point in sorted order: neighboring threads read the same memory.
template <class T>
__global__ void count_pairs(int32_t n, int64_t rows, T squared, HashGrid grid, Workspace<T> work) {
  const int64_t at = own_item();
  if (at >= rows) return;
  const GridPoint<T> p = work.sorted[at];
  int32_t count = 0;
  each_later_neighbor(p, n, squared, grid, work, [&](int32_t) { ++count; });
  work.first[p.row] = count;
}

__global__ void report_count(const int64_t* total, const int32_t* infinite, int64_t* count) {
  *count = *infinite ? -1 : *total;
}

// Heapsort of list[0], list[3], list[6], ...
__device__ void sort_column(int32_t* list, int64_t size) {
  const auto sift = [&](int64_t root, int64_t end) {
    const int32_t value = list[3 * root];
    for (int64_t child = 2 * root + 1; child < end; child = 2 * root + 1) {
      if (child + 1 < end && list[3 * child] < list[3 * child + 3]) ++child;
      if (list[3 * child] <= value) break;
      list[3 * root] = list[3 * child];
      root = child;
    }
    list[3 * root] = value;
  };
  for (int64_t root = size / 2; root-- > 0;) sift(root, size);
  for (int64_t end = size; end-- > 1;) {
    const int32_t largest = list[0];
    list[0] = list[3 * end];
    list[3 * end] = largest;
    sift(0, end);
  }
}

template <class T>
__global__ void write_pairs(int32_t n, int64_t rows, T squared, HashGrid grid, Workspace<T> work, const int64_t* count,
                            int64_t max_pairs, int32_t* pairs) {
  const int64_t at = own_item();
  if (at >= rows || *count < 0 || *count > max_pairs) return;
  const GridPoint<T> p = work.sorted[at];
  const int64_t begin = work.first[p.row], size = work.first[p.row + 1] - begin;
  if (size == 0) return;
  const int32_t scene = p.row / n, base = scene * n;
  int32_t* out = pairs + 3 * begin;
  int64_t found = 0;
  if (size <= kShortList) {
    int32_t list[kShortList];
    each_later_neighbor(p, n, squared, grid, work, [&](int32_t row) { list[found++] = row; });
    for (int64_t k = 0; k < size; ++k) {
      const int32_t row = list[k];
      int64_t to = k;
      for (; to > 0 && list[to - 1] > row; --to) list[to] = list[to - 1];
      list[to] = row;
    }
    for (int64_t k = 0; k < size; ++k) out[3 * k + 2] = list[k] - base;
  } else {
    each_later_neighbor(p, n, squared, grid, work, [&](int32_t row) { out[3 * found++ + 2] = row - base; });
    sort_column(out + 2, size);
  }
  for (int64_t k = 0; k < size; ++k) out[3 * k] = scene, out[3 * k + 1] = p.row - base;
}

}  // namespace

template <class T>
size_t neighbor_workspace_bytes(int64_t points) {
  return Workspace<T>(HashGrid(1.0, points), points, nullptr).bytes;
}

template <class T>
cudaError_t neighbor_pairs(const T* points, int64_t scenes, int64_t n, double radius, int32_t* pairs, int64_t max_pairs,
                           int64_t* count, void* workspace, cudaStream_t stream) {
  const int64_t rows = scenes * n;
  const auto of_scene = static_cast<int32_t>(n);  // rows fit, and 32-bit division is faster
  const HashGrid grid(radius, rows);
  Workspace<T> work(grid, rows, workspace);
  const T squared = static_cast<T>(radius) * static_cast<T>(radius);
  const int64_t starts = int64_t{grid.buckets()} + 1;
  if (max_pairs > 0) {
    if (auto error = cudaMemsetAsync(pairs, 0xff, 3 * max_pairs * sizeof(int32_t), stream)) return error;  // -1
  }
  if (rows == 0) return cudaMemsetAsync(count, 0, sizeof(int64_t), stream);
  if (auto error = cudaMemsetAsync(work.start, 0, starts * sizeof(int32_t), stream)) return error;
  if (auto error = cudaMemsetAsync(work.infinite, 0, sizeof(int32_t), stream)) return error;
  if (auto error = cudaMemsetAsync(work.first + rows, 0, sizeof(int64_t), stream)) return error;
  count_buckets<<<blocks_for(rows, kThreads), kThreads, 0, stream>>>(points, of_scene, rows, grid, work);
  size_t bytes = work.scan_bytes;
  if (auto error = cub::DeviceScan::ExclusiveSum(work.scan, bytes, work.start, work.start, starts, stream))
    return error;
  sort_points<<<blocks_for(rows, kThreads), kThreads, 0, stream>>>(points, rows, work);
  count_pairs<<<blocks_for(rows, kThreads), kThreads, 0, stream>>>(of_scene, rows, squared, grid, work);
  bytes = work.scan_bytes;
  if (auto error = cub::DeviceScan::ExclusiveSum(work.scan, bytes, work.first, work.first, rows + 1, stream))
    return error;
  report_count<<<1, 1, 0, stream>>>(work.first + rows, work.infinite, count);
  write_pairs<<<blocks_for(rows, kThreads), kThreads, 0, stream>>>(of_scene, rows, squared, grid, work, count,
                                                                   max_pairs, pairs);
  return cudaGetLastError();
}

DIFFVBD_INSTANTIATE(neighbor_workspace_bytes)
DIFFVBD_INSTANTIATE(neighbor_pairs)

}  // namespace diffvbd::cuda
