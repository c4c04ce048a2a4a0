// The searches of detection: a workspace, and what a thread, a warp and a block look for in the trees.
#pragma once

#include <type_traits>

#include "detect.h"
#include "exchange.cuh"
#include "tree.cuh"

namespace diffvbd::cuda {
namespace {

using namespace contact;

constexpr size_t kAlignment = 256;
constexpr int kWarp = 32;
// Leaves that one thread finds for a query; a block takes over from there. Few queries leave threads idle.
constexpr int kMostHits = 96, kMostHitsOfFew = 12;
constexpr int64_t kFewQueries = 65536;
constexpr int kStepsTogether = 8;    // of a traversal, before the threads of a warp look at what they have found
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

  __device__ void look_at(const Candidate& c, const PairGap<T>& of) const {
    const auto [gap, begins, least] = of;
    if (least >= reach_of(in, c.scene) || (gap > T(0) && !is_listed(in, c, least, in.dhat))) return;
    if constexpr (listing) {
      settle(c, of);
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
  __device__ void settle(const Candidate& c, const PairGap<T>& of) const {
    const auto [gap, begins, least] = of;
    const Constants<T> constants = constants_of(in, c);
    if (!constants.admitted) return;
    const uint64_t key = key_of(in, c);
    if (!(gap > T(0) && begins > T(0))) touch(key);
    if (gap != gap) return;
    const Ordered<T> bits = ordered(gap);
    for (int k = 0; k < 4; ++k) {
      const int64_t row = c.scene * in.corners + c.v[k];
      if (work.near_gap[row] == bits) lower(work.near_key + row, static_cast<unsigned long long>(key));
    }
    if (is_listed(in, c, least, constants.dhat)) append(work.listed, work.keys, capacity, key);
  }

  // Of a point that is not finite: it counts as touching, so that nobody takes the scene for a good one.
  __device__ void meet_nothing() const { atomicAdd(&work.touching[0], 1ULL); }

  // What query q looks for: those of points come first, in the order of the forest.
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
      const int32_t item = forest.item(2, scene, static_cast<int32_t>(q - scene * in.num_points));
      return {box_of(in, 2, scene, item, reference_point(in, scene)), scene, kPointTriangle, 0};
    }
    const int64_t scene = (q - point_queries) / in.num_edges;
    const auto leaf = static_cast<int32_t>(q - point_queries - scene * in.num_edges) + forest.leaves[1];
    return {forest.tree(1, scene)[leaf], scene, kEdgeEdge, leaf};
  }

  __device__ void examine_leaf(int64_t scene, int kind, int32_t item, int32_t leaf) const {
    const Candidate c = candidate(in, scene, kind, item, work.forest.tree(kind, scene)[leaf].item);
    if (!is_considered(in, c)) return;
    const T gap = gap_of_surfaces(in, c);
    look_at(c, {gap, gap, gap});
  }

  // The planes of colliders.
  __device__ void examine_planes(const Query& q) const {
    if (q.box.group == in.mesh_bodies) return;
    for (int32_t p = 0; p < in.num_planes; ++p) {
      const Candidate c = candidate(in, q.scene, kPointPlane, q.box.item, p);
      if (!is_considered(in, c)) continue;
      look_at(c, gap_of_plane(in, c));
    }
  }

  // Nodes from..end of the tree, leaves from `first` on.
  __device__ void walk(const Query& q, int32_t from, int32_t end, int32_t first) const {
    const Near near(*this, q);
    each_leaf(near.nodes, work.forest.leaves[q.kind], from, end, near, [&](int32_t leaf) {
      if (leaf >= first) examine_leaf(q.scene, q.kind, q.box.item, leaf);
      return true;
    });
  }

  // Whether a node may hold what the query looks for.
  struct Near {
    const Surfaces<T>& in;
    const Box* nodes;
    Box box;
    Reach<T> reach;
    __device__ Near(const Search& search, const Query& q)
        : in(search.in),
          nodes(search.work.forest.tree(q.kind, q.scene)),
          box(q.box),
          reach(squared_reach(search.in, q.scene, q.box.group)) {}
    __device__ bool operator()(const Box& node) const {
      const float square = distance2(node, box);  // most are out of any reach
      return square <= reach.any && square <= reach.to(node.group) && !in.ignores(box.group, node.group);
    }
  };
};

// Leaves that the threads of a warp have found and not yet looked at, and whose they are.
struct Finds {
  int32_t leaf[2 * kWarp], item[kWarp], scene[kWarp];
  uint8_t finder[2 * kWarp], kind[kWarp];
};

// A thread for each query. Threads that walk through a tree find leaves at different times, and few at once: a warp
// collects them, and looks at as many as it has threads.
template <class T, bool listing>
__global__ void __launch_bounds__(kThreads)
    search_kernel(const Surfaces<T> in, Workspace<T> work, int64_t capacity, int64_t queries, int most_hits) {
  __shared__ Finds all[kThreads / kWarp];
  if (listing && kept_all(work, capacity)) return;
  Finds& finds = all[threadIdx.x / kWarp];
  const unsigned lane = threadIdx.x % kWarp;
  const int64_t i = own_item();
  const Search<T, listing> search{in, work, capacity};
  const auto q = search.query(i < queries ? i : queries - 1);
  bool walks = i < queries;
  if (walks && is_empty(q.box)) {
    if (!listing && q.kind == kPointTriangle) search.meet_nothing();
    walks = false;
  }
  // Each pair of edges once: an edge looks to the right of it in the tree.
  int32_t node = q.kind == kEdgeEdge ? next_node(q.leaf) : kRoot;
  walks = walks && !(q.kind == kEdgeEdge && node == kRoot);
  finds.item[lane] = q.box.item, finds.scene[lane] = static_cast<int32_t>(q.scene);
  finds.kind[lane] = static_cast<uint8_t>(q.kind);
  const typename Search<T, listing>::Near near(search, q);
  const int32_t leaves = work.forest.leaves[q.kind];
  int hits = 0, count = 0;  // count: of all threads of the warp
  for (bool goes_on = true; goes_on || count > 0;) {
    int32_t leaf = -1;
    for (int step = 0; step < kStepsTogether && walks && leaf < 0; ++step) {
      const Box& box = near.nodes[node];
      const bool hit = near(box), is_leaf = node >= leaves;
      if (hit && is_leaf && !is_empty(box)) leaf = node;
      node = hit && !is_leaf ? 2 * node : next_node(node);
      walks = node != kRoot;
    }
    if (leaf >= 0 && ++hits > most_hits) {
      work.heavy[atomicAdd(&work.heavy_count[listing], 1U)] = {i, leaf};
      leaf = -1, walks = false;
    }
    const unsigned found = __ballot_sync(kWholeWarp, leaf >= 0);
    if (leaf >= 0) {
      const int place = count + __popc(found & ((1U << lane) - 1));
      finds.leaf[place] = leaf, finds.finder[place] = static_cast<uint8_t>(lane);
    }
    count += __popc(found);
    goes_on = __any_sync(kWholeWarp, walks) != 0;
    if (count < kWarp && goes_on) continue;
    __syncwarp();
    const int taken = count < kWarp ? count : kWarp;
    if (static_cast<int>(lane) < taken) {
      const int place = count - taken + static_cast<int>(lane), finder = finds.finder[place];
      search.examine_leaf(finds.scene[finder], finds.kind[finder], finds.item[finder], finds.leaf[place]);
    }
    count -= taken;
    __syncwarp();
  }
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
        search.walk(q, part, next_node(part), heavy.node);
      }
    }
  }
}

// Points and planes, a thread for each point. Apart from the other searches, which would take more registers with it.
template <class T, bool listing>
__global__ void __launch_bounds__(kThreads)
    planes_kernel(const Surfaces<T> in, Workspace<T> work, int64_t capacity, int64_t points) {
  const int64_t i = own_item();
  if (i >= points || (listing && kept_all(work, capacity))) return;
  const Search<T, listing> search{in, work, capacity};
  const auto q = search.query(i);
  if (!is_empty(q.box)) search.examine_planes(q);
}

template <class T, bool listing>
void launch_planes(const Surfaces<T>& in, const Workspace<T>& work, int64_t capacity, cudaStream_t stream) {
  const int64_t points = in.scenes * int64_t{in.num_points};
  if (points == 0 || in.num_planes == 0) return;
  planes_kernel<T, listing><<<blocks_for(points), kThreads, 0, stream>>>(in, work, capacity, points);
}

// The second search where the first has kept all candidates.
template <class T>
__global__ void settle_kernel(const Surfaces<T> in, Workspace<T> work, int64_t capacity) {
  const int64_t i = own_item();
  if (!kept_all(work, capacity) || i >= static_cast<int64_t>(*work.found)) return;
  const Search<T, true> search{in, work, capacity};
  const Candidate c = candidate_of_key(in, work.candidates[i]);
  search.settle(c, gap_of(in, c));
}

template <class T, bool listing>
void launch_search(const Surfaces<T>& in, const Workspace<T>& work, int64_t capacity, cudaStream_t stream) {
  const int64_t queries = in.scenes * (int64_t{in.num_points} + in.num_edges);
  if (queries == 0) return;
  const int most_hits = queries < kFewQueries ? kMostHitsOfFew : kMostHits;
  search_kernel<T, listing><<<blocks_for(queries), kThreads, 0, stream>>>(in, work, capacity, queries, most_hits);
  heavy_kernel<T, listing><<<kHeavyBlocks, kThreads, 0, stream>>>(in, work, capacity);
  launch_planes<T, listing>(in, work, capacity, stream);
}

}  // namespace
}  // namespace diffvbd::cuda
