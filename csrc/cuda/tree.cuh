// Bounding-volume trees of all scenes (contact/tree.h): triangles, edges and points of every scene are sorted along its
// Morton curve by one radix sort, and boxes are built from the leaves up. Small scenes have leaves only.
#pragma once

#include <cub/device/device_radix_sort.cuh>

#include "../contact/detection.h"
#include "atomics.cuh"
#include "common.cuh"
#include "warp_reduce.cuh"

namespace diffvbd::cuda {

constexpr int kThreads = 256;

// Bits of numbers up to `most`, at least one.
inline int bits_of(uint64_t most) {
  int bits = 1;
  while (bits < 64 && most >> bits != 0) ++bits;
  return bits;
}

// Trees, and the order of primitives if they are sorted: triangles of all scenes, then edges, then points.
struct Forest {
  int64_t scenes;
  int32_t count[3], leaves[2];  // primitives of a scene; leaves of its trees of triangles and of edges
  int axis_bits;
  uint64_t *keys, *sorted_keys;
  int32_t *items, *sorted_items;  // index of a primitive in its scene
  bool sorted = true;             // false: leaves in the order of primitives, without a tree
  contact::Box* nodes[2];         // [scenes, 2 leaves]
  unsigned (*bounds)[6];          // of each scene, as ordered bits

  // Sizes and memory.
  template <class T, class Take>
  void lay_out(const contact::Surfaces<T>& in, Take& take) {
    scenes = in.scenes;
    count[0] = in.num_triangles, count[1] = in.num_edges, count[2] = in.num_points;
    const int room = (64 - bits_of(static_cast<uint64_t>(3 * in.scenes))) / 3;
    axis_bits = room < contact::kMostAxisBits ? room : contact::kMostAxisBits;
    const int64_t n = size();
    take(bounds, in.scenes);
    take(keys, n), take(sorted_keys, n), take(items, n), take(sorted_items, n);
    for (int kind = 0; kind < 2; ++kind) {
      leaves[kind] = contact::padded_leaves(count[kind]);
      take(nodes[kind], in.scenes * 2 * leaves[kind]);
    }
  }
  // Bytes of workspace of the sort.
  size_t sort_bytes() const {
    size_t bytes = 0;
    cub::DeviceRadixSort::SortPairs(nullptr, bytes, keys, sorted_keys, items, sorted_items, size());
    return bytes;
  }

  DIFFVBD_FN int64_t first(int kind) const {
    return scenes * ((kind > 0 ? int64_t{count[0]} : 0) + (kind > 1 ? int64_t{count[1]} : 0));
  }
  DIFFVBD_FN int64_t size() const { return first(2) + scenes * count[2]; }
  // k-th primitive of a kind in a scene.
  DIFFVBD_FN int32_t item(int kind, int64_t scene, int32_t k) const {
    return sorted ? sorted_items[first(kind) + scene * count[kind] + k] : k;
  }
  DIFFVBD_FN contact::Box* tree(int kind, int64_t scene) const { return nodes[kind] + scene * 2 * leaves[kind]; }
  int key_bits() const { return 3 * axis_bits + bits_of(static_cast<uint64_t>(3 * scenes)); }
};

// Empty bounds.
__device__ __forceinline__ void clear_bounds(const Forest& forest, int64_t scene) {
  const float far = std::numeric_limits<float>::infinity();
  for (int k = 0; k < 6; ++k) forest.bounds[scene][k] = ordered(k < 3 ? far : -far);
}

template <class T>
__device__ __forceinline__ contact::Box box_of(const contact::Surfaces<T>& in, int kind, int64_t scene, int32_t item,
                                               const contact::Place<T>& reference) {
  const int corners = kind == 0 ? 3 : kind == 1 ? 2 : 1;
  const int32_t* list = kind == 0 ? in.triangles : kind == 1 ? in.edges : in.points;
  const auto corner = [&](int32_t i) { return contact::corner_box(in, scene, i, reference); };
  return contact::primitive_box(in, list + int64_t{corners} * item, corners, item, corner);
}

// Bounds of the points of each scene. A warp within one scene reduces before it writes.
template <class T>
__global__ void bounds_kernel(const contact::Surfaces<T> in, Forest forest) {
  const int64_t i = own_item(), all = in.scenes * in.num_points;
  const int64_t scene = (i < all ? i : all - 1) / in.num_points;
  contact::Box box = contact::empty_box();
  if (i < all) box = box_of(in, 2, scene, static_cast<int32_t>(i - scene * in.num_points), reference_point(in, scene));
  unsigned lo[3] = {ordered(box.lo.x), ordered(box.lo.y), ordered(box.lo.z)};
  unsigned hi[3] = {ordered(box.hi.x), ordered(box.hi.y), ordered(box.hi.z)};
  bool writes = !contact::is_empty(box);
  if (__all_sync(kWholeWarp, scene == __shfl_sync(kWholeWarp, scene, 0))) {
    for (int k = 0; k < 3; ++k) {
      lo[k] = __reduce_min_sync(kWholeWarp, lo[k]);
      hi[k] = __reduce_max_sync(kWholeWarp, hi[k]);
    }
    writes = threadIdx.x % 32 == 0;
  }
  for (int k = 0; writes && k < 3; ++k) {
    lower(&forest.bounds[scene][k], lo[k]);
    raise(&forest.bounds[scene][3 + k], hi[k]);
  }
}

__device__ __forceinline__ contact::Box bounds_of(const Forest& forest, int64_t scene) {
  const unsigned* b = forest.bounds[scene];
  return {{value_of<float>(b[0]), value_of<float>(b[1]), value_of<float>(b[2])},
          contact::kMixed,
          {value_of<float>(b[3]), value_of<float>(b[4]), value_of<float>(b[5])},
          -1};
}

template <class T>
__global__ void codes_kernel(const contact::Surfaces<T> in, Forest forest) {
  const int64_t i = own_item();
  if (i >= forest.size()) return;
  const int kind = i >= forest.first(2) ? 2 : i >= forest.first(1) ? 1 : 0;
  const int64_t within = i - forest.first(kind), scene = within / forest.count[kind];
  const auto item = static_cast<int32_t>(within - scene * forest.count[kind]);
  const contact::Box box = box_of(in, kind, scene, item, reference_point(in, scene));
  const auto segment = static_cast<uint64_t>(kind * in.scenes + scene);
  forest.keys[i] = segment << (3 * forest.axis_bits) | morton_code(box, bounds_of(forest, scene), forest.axis_bits);
  forest.items[i] = item;
}

template <class T>
__global__ void leaves_kernel(const contact::Surfaces<T> in, Forest forest, int kind) {
  const int64_t i = own_item(), leaves = forest.leaves[kind];
  if (i >= in.scenes * leaves) return;
  const int64_t scene = i / leaves;
  const auto leaf = static_cast<int32_t>(i - scene * leaves);
  contact::Box box = contact::empty_box();
  if (leaf < forest.count[kind]) {
    box = box_of(in, kind, scene, forest.item(kind, scene, leaf), reference_point(in, scene));
  }
  forest.tree(kind, scene)[leaves + leaf] = box;
}

// Parents of a level of `width` nodes in each tree, `steps` levels up; a block starts from 2 kThreads nodes, maybe of
// several trees.
static __global__ void fold_kernel(Forest forest, int kind, int32_t width, int steps) {
  __shared__ contact::Box part[kThreads];
  const int t = static_cast<int>(threadIdx.x);
  for (int step = 0; step < steps; ++step, width /= 2) {
    const int64_t active = kThreads >> step, i = blockIdx.x * active + t, parents = width / 2;
    const bool works = t < active && i < forest.scenes * parents;
    contact::Box box;
    if (works) {
      const int64_t scene = i / parents, k = i - scene * parents;
      contact::Box* nodes = forest.tree(kind, scene);
      box = step == 0 ? hull(nodes[width + 2 * k], nodes[width + 2 * k + 1]) : hull(part[2 * t], part[2 * t + 1]);
      nodes[parents + k] = box;
    }
    __syncthreads();
    if (works) part[t] = box;
    __syncthreads();
  }
}

template <class T>
cudaError_t build_forest(const contact::Surfaces<T>& in, const Forest& forest, void* sort, size_t sort_bytes,
                         cudaStream_t stream) {
  if (forest.sorted && in.scenes * in.num_points > 0) {
    bounds_kernel<<<blocks_for(in.scenes * in.num_points, kThreads), kThreads, 0, stream>>>(in, forest);
  }
  const int64_t n = forest.size();
  if (forest.sorted && n > 0) {
    codes_kernel<<<blocks_for(n, kThreads), kThreads, 0, stream>>>(in, forest);
    if (auto error = cub::DeviceRadixSort::SortPairs(sort, sort_bytes, forest.keys, forest.sorted_keys, forest.items,
                                                     forest.sorted_items, n, 0, forest.key_bits(), stream))
      return error;
  }
  for (int kind = 0; kind < 2 && in.scenes > 0; ++kind) {
    leaves_kernel<<<blocks_for(in.scenes * forest.leaves[kind], kThreads), kThreads, 0, stream>>>(in, forest, kind);
    for (int32_t width = forest.leaves[kind]; forest.sorted && width > 1;) {
      int steps = 0;
      while (steps < 9 && width >> steps > 1) ++steps;
      fold_kernel<<<blocks_for(in.scenes * width / 2, kThreads), kThreads, 0, stream>>>(forest, kind, width, steps);
      width >>= steps;
    }
  }
  return cudaGetLastError();
}

}  // namespace diffvbd::cuda
