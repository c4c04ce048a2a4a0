#include <type_traits>

#include "detect.h"
#include "tree.cuh"

namespace diffvbd::cuda {
namespace {

using namespace contact;

constexpr size_t kAlignment = 256;
constexpr int kMostHits = 192;       // leaves that one thread looks at for a query; a block takes over from there
constexpr int kHeavyBlocks = 512;    // that share the queries with more
constexpr int32_t kSubtrees = 4096;  // parts of a tree that the threads of such a block share
constexpr int64_t kCandidates = 2;   // kept by the first search for each pair that fits

// A query whose search goes on at `node`.
struct Heavy {
  int64_t query;
  int32_t node;
};

// Views of the workspace; without memory, its size.
template <class T>
struct Workspace {
  Forest forest{};
  Ordered<T>* near_gap;                    // [B N]
  unsigned long long* near_key;            // [B N]
  Ordered<T>* smallest;                    // [B]
  unsigned long long* listed;              // number of pairs that the list needs
  unsigned long long* touching;            // number of pairs that touch, and the first key of those
  unsigned long long *keys, *sorted_keys;  // [capacity]
  unsigned long long *found,
      *candidates;                   // how many pairs the first search found that may be listed; the first of them
  uint32_t *points, *sorted_points;  // [4 capacity] corner points of the list's pairs
  int32_t* entries;                  // [4 capacity]
  Heavy* heavy;                      // [queries], and how many, for each of the two searches
  unsigned* heavy_count;
  void* sort;
  size_t sort_bytes = 0, bytes = 0;

  Workspace(const Surfaces<T>& in, int64_t capacity, void* memory) {
    auto* at = static_cast<unsigned char*>(memory);
    const auto take = [&](auto*& pointer, int64_t items) {
      pointer = reinterpret_cast<std::remove_reference_t<decltype(pointer)>>(at + bytes);
      bytes += (items * sizeof(*pointer) + kAlignment - 1) / kAlignment * kAlignment;
    };
    forest.lay_out(in, take);
    const int64_t rows = in.scenes * in.corners;
    take(near_gap, rows), take(near_key, rows), take(smallest, in.scenes), take(listed, 1), take(touching, 2);
    take(keys, capacity), take(sorted_keys, capacity);
    take(found, 1), take(candidates, kCandidates * capacity);
    take(points, 4 * capacity), take(sorted_points, 4 * capacity), take(entries, 4 * capacity);
    take(heavy, in.scenes * (int64_t{in.num_points} + in.num_edges)), take(heavy_count, 2);
    size_t of_pairs = 0, of_points = 0;
    cub::DeviceRadixSort::SortKeys(nullptr, of_pairs, keys, sorted_keys, capacity);
    cub::DeviceRadixSort::SortPairs(nullptr, of_points, points, sorted_points, entries, entries, 4 * capacity);
    sort_bytes = forest.sort_bytes();
    sort_bytes = sort_bytes > of_pairs ? sort_bytes : of_pairs;
    sort_bytes = sort_bytes > of_points ? sort_bytes : of_points;
    sort = at + bytes;
    bytes += sort_bytes;
  }
};

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

// --- search
// -----------------------------------------------------------------------------------------------------------

// Whether the first search has kept all candidates: then the second need not search.
template <class T>
__device__ bool kept_all(const Workspace<T>& work, int64_t capacity) {
  return *work.found <= static_cast<unsigned long long>(kCandidates * capacity);
}

// Puts a key into a list of `room`. One addition for all threads that are here together.
__device__ void append(unsigned long long* count, unsigned long long* list, int64_t room, uint64_t key) {
  const unsigned together = __activemask(), lane = threadIdx.x % 32;
  const int leader = __ffs(static_cast<int>(together)) - 1;
  unsigned long long first = 0;
  if (static_cast<int>(lane) == leader) first = atomicAdd(count, static_cast<unsigned long long>(__popc(together)));
  const unsigned long long place = __shfl_sync(together, first, leader) + __popc(together & ((1U << lane) - 1));
  if (place < static_cast<unsigned long long>(room)) list[place] = key;
}

// One of two searches: for the near gaps of all corner points, and, when they are known, for the near pairs; that one
// lists.
template <class T, bool listing>
struct Search {
  const Surfaces<T>& in;
  const Workspace<T>& work;
  int64_t capacity;

  __device__ void touch(uint64_t key) const {
    atomicAdd(&work.touching[0], 1ULL);
    lower(&work.touching[1], static_cast<unsigned long long>(key));
  }

  __device__ T gap_of(const Candidate& c) const { return separation(c.kind, corners_of(in, c)) - offset_of(in, c); }

  __device__ void examine(const Candidate& c) const {
    if (!is_considered(in, c)) return;
    const T gap = gap_of(c);
    if (gap >= reach_of(in, c.scene) || (gap > T(0) && !is_listed(in, c, gap, in.dhat))) return;
    if constexpr (listing) {
      settle(c, gap);
    } else {
      append(work.found, work.candidates, kCandidates * capacity, key_of(in, c));
      const Ordered<T> bits = ordered(gap);
      bool matters = !(gap > T(0));
      Ordered<T>* rows = work.near_gap + c.scene * in.corners;
      for (int k = 0; k < 4; ++k) matters = matters || bits < *static_cast<volatile Ordered<T>*>(rows + c.v[k]);
      if (!matters || gap != gap || !constants_of(in, c).admitted) return;
      for (int k = 0; k < 4; ++k) lower(rows + c.v[k], bits);
    }
  }

  // Of a pair that may be listed.
  __device__ void settle(const Candidate& c, T gap) const {
    const Constants<T> constants = constants_of(in, c);
    if (!constants.admitted) return;
    const uint64_t key = key_of(in, c);
    if (!(gap > T(0))) touch(key);
    if (gap != gap) return;
    const Ordered<T> bits = ordered(gap);
    for (int k = 0; k < 4; ++k) {
      const int64_t row = c.scene * in.corners + c.v[k];
      if (work.near_gap[row] == bits) lower(work.near_key + row, static_cast<unsigned long long>(key));
    }
    if (is_listed(in, c, gap, constants.dhat)) append(work.listed, work.keys, capacity, key);
  }

  // What query q looks for: those of points come first, in the order of their Morton codes.
  struct Query {
    Box box;
    int64_t scene;
    int kind;
    int32_t leaf;  // of an edge: its own
  };
  __device__ Query query(int64_t q) const {
    const Forest& forest = work.forest;
    const int64_t point_queries = in.scenes * in.num_points;
    if (q < point_queries) {
      const int64_t scene = q / in.num_points;
      return {box_of(in, 2, scene, forest.sorted_items[forest.first(2) + q], reference_point(in, scene)), scene,
              kPointTriangle, 0};
    }
    const int64_t scene = (q - point_queries) / in.num_edges;
    const auto leaf = static_cast<int32_t>(q - point_queries - scene * in.num_edges) + forest.leaves[1];
    return {forest.tree(1, scene)[leaf], scene, kEdgeEdge, leaf};
  }

  // Nodes from..end of the tree, leaves from `first` on; stops at the leaf where visit(leaf) says so.
  template <class Visit>
  __device__ void walk(const Query& q, int32_t from, int32_t end, int32_t first, const Visit& visit) const {
    const Box* nodes = work.forest.tree(q.kind, q.scene);
    const Reach<T> reach = squared_reach(in, q.scene, q.box.group);
    const auto hits = [&](const Box& node) {
      return distance2(node, q.box) <= reach.to(node.group) && !in.ignores(q.box.group, node.group);
    };
    each_leaf(nodes, work.forest.leaves[q.kind], from, end, hits, [&](int32_t leaf) {
      if (leaf < first) return true;
      if (!visit(leaf)) return false;
      examine(candidate(in, q.scene, q.kind, q.box.item, nodes[leaf].item));
      return true;
    });
  }
};

template <class T, bool listing>
__global__ void search_kernel(const Surfaces<T> in, Workspace<T> work, int64_t capacity, int64_t queries) {
  const int64_t i = own_item();
  if (i >= queries || (listing && kept_all(work, capacity))) return;
  const Search<T, listing> search{in, work, capacity};
  const auto q = search.query(i);
  if (is_empty(q.box)) {
    // A point that is not finite meets nothing: it counts as touching, so that nobody takes the scene for a good one.
    if (!listing && q.kind == kPointTriangle) atomicAdd(&work.touching[0], 1ULL);
    return;
  }
  if (q.kind == kPointTriangle && q.box.group != in.mesh_bodies) {
    for (int32_t p = 0; p < in.num_planes; ++p) search.examine(candidate(in, q.scene, kPointPlane, q.box.item, p));
  }
  // Each pair of edges once: an edge looks to the right of it in the tree.
  const int32_t from = q.kind == kEdgeEdge ? next_node(q.leaf) : kRoot;
  if (q.kind == kEdgeEdge && from == kRoot) return;
  int hits = 0;
  search.walk(q, from, kRoot, 0, [&](int32_t leaf) {
    if (++hits <= kMostHits) return true;
    work.heavy[atomicAdd(&work.heavy_count[listing], 1U)] = {i, leaf};
    return false;
  });
}

// The rest of the searches with many hits, a block for each: its threads share the tree.
template <class T, bool listing>
__global__ void heavy_kernel(const Surfaces<T> in, Workspace<T> work, int64_t capacity) {
  const Search<T, listing> search{in, work, capacity};
  for (unsigned h = blockIdx.x; h < work.heavy_count[listing]; h += gridDim.x) {
    const Heavy heavy = work.heavy[h];
    const auto q = search.query(heavy.query);
    const int32_t leaves = work.forest.leaves[q.kind], parts = leaves < kSubtrees ? leaves : kSubtrees;
    for (int32_t part = parts + static_cast<int32_t>(threadIdx.x); part < 2 * parts; part += kThreads) {
      const int32_t last = (part + 1) * (leaves / parts) - 1;
      if (last >= heavy.node) {
        search.walk(q, part, next_node(part), heavy.node, [](int32_t) { return true; });
      }
    }
  }
}

// The second search where the first has kept all candidates.
template <class T>
__global__ void settle_kernel(const Surfaces<T> in, Workspace<T> work, int64_t capacity) {
  const int64_t i = own_item();
  if (!kept_all(work, capacity) || i >= static_cast<int64_t>(*work.found)) return;
  const Search<T, true> search{in, work, capacity};
  const Candidate c = candidate_of_key(in, work.candidates[i]);
  search.settle(c, search.gap_of(c));
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
  if (i == rows) return;
  const int64_t scene = i / in.corners;
  store_near_pair(in, scene, static_cast<int32_t>(i - scene * in.corners), work.near_key[i],
                  out.near_corners + kNearRow * i, out.near_values + kNearValues * i);
  lower(work.smallest + scene, work.near_gap[i]);
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

template <class T, bool listing>
void launch_search(const Surfaces<T>& in, const Workspace<T>& work, int64_t capacity, cudaStream_t stream) {
  const int64_t queries = in.scenes * (int64_t{in.num_points} + in.num_edges);
  if (queries == 0) return;
  search_kernel<T, listing><<<blocks_for(queries), kThreads, 0, stream>>>(in, work, capacity, queries);
  heavy_kernel<T, listing><<<kHeavyBlocks, kThreads, 0, stream>>>(in, work, capacity);
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
  start_kernel<<<blocks_for((most > in.scenes ? most : in.scenes) + 1), kThreads, 0, stream>>>(in, work, capacity);
  if (auto error = build_forest(in, work.forest, work.sort, work.sort_bytes, stream)) return error;
  launch_search<T, false>(in, work, capacity, stream);
  launch_search<T, true>(in, work, capacity, stream);
  if (capacity > 0) {
    settle_kernel<<<blocks_for(kCandidates * capacity), kThreads, 0, stream>>>(in, work, capacity);
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
