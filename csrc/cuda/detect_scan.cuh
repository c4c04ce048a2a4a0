// The searches of small scenes: each box is compared with all others, which takes less time than to sort them, to build
// trees and to walk through these.
#pragma once

#include "detect_search.cuh"

namespace diffvbd::cuda {
namespace {

constexpr int64_t kMostCompared = int64_t{1} << 23;  // boxes, of all scenes
constexpr int32_t kMostScanned = 2048;               // that one query is compared with

template <class T>
bool is_scanned(const Surfaces<T>& in) {
  const int64_t edges = in.num_edges, triangles = in.num_triangles, points = in.num_points;
  return edges <= kMostScanned && triangles <= kMostScanned &&
         in.scenes * (points * (triangles + kWarp) + edges * (edges / 2 + kWarp)) <= kMostCompared;  // a warp at least
}

// A warp for each query: it looks at what it finds as soon as there is some for each of its threads.
template <class T, bool listing>
__global__ void __launch_bounds__(kThreads)
    scan_kernel(const Surfaces<T> in, Workspace<T> work, int64_t capacity, int64_t queries) {
  __shared__ int32_t all[kThreads / kWarp][2 * kWarp];
  if (listing && kept_all(work, capacity)) return;
  const int64_t i = own_item() / kWarp;
  if (i >= queries) return;
  const auto lane = static_cast<int>(threadIdx.x % kWarp);
  int32_t* found = all[threadIdx.x / kWarp];
  const Search<T, listing> search{in, work, capacity};
  const auto q = search.query(i);
  if (is_empty(q.box)) {
    if (!listing && q.kind == kPointTriangle && lane == 0) search.meet_nothing();
    return;
  }
  const typename Search<T, listing>::Near near(search, q);
  const int32_t leaves = work.forest.leaves[q.kind], end = leaves + work.forest.count[q.kind];
  const auto examine = [&](int32_t leaf) { search.examine_leaf(q.scene, q.kind, q.box.item, leaf); };
  int count = 0;
  for (int32_t first = q.kind == kEdgeEdge ? q.leaf + 1 : leaves; first < end; first += kWarp) {
    const int32_t leaf = first + lane;
    const bool hit = leaf < end && near(near.nodes[leaf]) && !is_empty(near.nodes[leaf]);
    const unsigned hits = __ballot_sync(kWholeWarp, hit);
    if (hit) found[count + __popc(hits & ((1U << lane) - 1))] = leaf;
    count += __popc(hits);
    __syncwarp();
    if (count < kWarp) continue;
    count -= kWarp;
    examine(found[count + lane]);
    __syncwarp();
  }
  if (lane < count) examine(found[lane]);
}

template <class T, bool listing>
void launch_scan(const Surfaces<T>& in, const Workspace<T>& work, int64_t capacity, cudaStream_t stream) {
  const int64_t queries = in.scenes * (int64_t{in.num_points} + in.num_edges);
  if (queries == 0) return;
  scan_kernel<T, listing><<<blocks_for(kWarp * queries), kThreads, 0, stream>>>(in, work, capacity, queries);
  launch_planes<T, listing>(in, work, capacity, stream);
}

}  // namespace
}  // namespace diffvbd::cuda
