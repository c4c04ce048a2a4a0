#include "common.cuh"
#include "contact.h"
#include "tree.cuh"

namespace diffvbd::cuda {
namespace {

using namespace contact;

// Parts of the workspace; without memory, its size.
struct Workspace {
  Forest forest{};
  unsigned long long (*first)[2];          // [B] smallest key of a crossing, and of a point behind a plane
  unsigned long long* listed;              // number of crossings of all scenes
  unsigned long long *keys, *sorted_keys;  // [capacity]
  unsigned char* sort;
  size_t sort_bytes = 0, bytes = 0;

  template <class T>
  Workspace(const Surfaces<T>& in, int64_t capacity, void* memory) {
    Parts<> take(memory);
    forest.lay_out(in, take);
    take(first, in.scenes), take(listed, 1), take(keys, capacity), take(sorted_keys, capacity);
    size_t of_keys = 0;
    cub::DeviceRadixSort::SortKeys(nullptr, of_keys, keys, sorted_keys, capacity);
    sort_bytes = forest.sort_bytes();
    sort_bytes = sort_bytes > of_keys ? sort_bytes : of_keys;
    take(sort, sort_bytes);
    bytes = take.bytes;
  }
};

__device__ __forceinline__ unsigned long long* count_of(const Intersections& out, int64_t scene, int kind) {
  return reinterpret_cast<unsigned long long*>(out.counts + 2 * scene + kind);
}

// unused: key of empty rows, above those of all crossings.
static __global__ void start_intersections(Workspace work, Intersections out, int64_t scenes, uint64_t unused) {
  const int64_t i = own_item();
  if (i < out.capacity) work.keys[i] = unused;
  if (i < scenes) {
    clear_bounds(work.forest, i);
    for (int kind = 0; kind < 2; ++kind) work.first[i][kind] = kNoKey, *count_of(out, i, kind) = 0;
  }
  if (i == 0) *work.listed = 0;
}

// One thread for each edge, in the order of the Morton curve, and each point.
template <class T>
__global__ void intersections_kernel(const Surfaces<T> in, Workspace work, Intersections out) {
  const Forest& forest = work.forest;
  const int64_t i = own_item(), edges = in.scenes * in.num_edges, points = in.scenes * in.num_points;
  if (i < edges) {
    const int64_t scene = i / in.num_edges;
    const int32_t edge = forest.sorted_items[forest.first(1) + i];
    const Box box = box_of(in, 1, scene, edge, reference_point(in, scene)), *nodes = forest.tree(0, scene);
    if (is_empty(box)) return;
    const auto hits = [&](const Box& node) { return overlap(node, box) && !in.ignores(box.group, node.group); };
    each_leaf(nodes, forest.leaves[0], kRoot, kRoot, hits, [&](int32_t leaf) {
      const int32_t triangle = nodes[leaf].item;
      if (!shares_vertex(in, edge, triangle) && is_crossing(in, scene, edge, triangle)) {
        const auto key = static_cast<unsigned long long>(crossing_key(in, scene, edge, triangle));
        atomicAdd(count_of(out, scene, 0), 1ULL);
        lower(&work.first[scene][0], key);
        const unsigned long long place = atomicAdd(work.listed, 1ULL);
        if (place < static_cast<unsigned long long>(out.capacity)) work.keys[place] = key;
      }
      return true;
    });
  } else if (i < edges + points) {
    const int64_t scene = (i - edges) / in.num_points;
    const auto point = static_cast<int32_t>(i - edges - scene * in.num_points);
    for (int32_t p = 0; p < in.num_planes; ++p) {
      if (!is_behind(in, scene, point, p)) continue;
      atomicAdd(count_of(out, scene, 1), 1ULL);
      lower(&work.first[scene][1], static_cast<unsigned long long>(behind_key(in, point, p)));
    }
  }
}

template <class T>
__global__ void store_intersections(const Surfaces<T> in, Workspace work, Intersections out, uint64_t unused) {
  const int64_t i = own_item();
  if (i < out.capacity) {
    const uint64_t key = work.sorted_keys[i];
    store_crossing(in, key < unused ? key : kNoKey, out.pairs + kCrossingRow * i);
  }
  if (i < in.scenes) store_first(in, work.first[i][0], work.first[i][1], out.first + 4 * i);
}

}  // namespace

template <class T>
size_t intersections_workspace_bytes(const Surfaces<T>& in, int64_t capacity) {
  return Workspace(in, capacity, nullptr).bytes;
}

template <class T>
cudaError_t find_intersections(const Surfaces<T>& in, const Intersections& out, void* memory, cudaStream_t stream) {
  const Workspace work(in, out.capacity, memory);
  const uint64_t unused = crossing_keys(in, in.scenes);
  const int64_t most = in.scenes > out.capacity ? in.scenes : out.capacity;
  start_intersections<<<blocks_for(most + 1, kThreads), kThreads, 0, stream>>>(work, out, in.scenes, unused);
  if (auto error = build_forest(in, work.forest, work.sort, work.sort_bytes, stream)) return error;
  const int64_t queries = in.scenes * (int64_t{in.num_edges} + in.num_points);
  if (queries > 0) {
    intersections_kernel<<<blocks_for(queries, kThreads), kThreads, 0, stream>>>(in, work, out);
  }
  if (out.capacity > 0) {
    size_t bytes = work.sort_bytes;
    if (auto error = cub::DeviceRadixSort::SortKeys(work.sort, bytes, work.keys, work.sorted_keys, out.capacity, 0,
                                                    bits_of(unused), stream))
      return error;
  }
  store_intersections<<<blocks_for(most + 1, kThreads), kThreads, 0, stream>>>(in, work, out, unused);
  return cudaGetLastError();
}

DIFFVBD_INSTANTIATE(intersections_workspace_bytes)
DIFFVBD_INSTANTIATE(find_intersections)

}  // namespace diffvbd::cuda
