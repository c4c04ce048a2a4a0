// Detection of near pairs: searches through trees or all boxes, and the list in a fixed order.
#include <algorithm>

#include "common.cuh"
#include "contact.h"
#include "tree.cuh"
#include "warp_reduce.cuh"

namespace diffvbd::cuda {
namespace {

using namespace contact;

constexpr int kWarp = 32;
// Leaves that one thread visits for a query before a block takes over. Few queries leave threads idle.
constexpr int kMostHits = 96, kMostHitsOfFew = 12;
constexpr int64_t kFewQueries = 65536;
constexpr int kStepsTogether = 8;    // steps of a traversal before the warp examines its leaves
constexpr int kHeavyBlocks = 512;    // blocks for the queries with more leaves
constexpr int32_t kSubtrees = 4096;  // parts of a tree for the threads of such a block
constexpr int64_t kCandidates = 2;   // candidates that the first search keeps, per pair of the capacity

// Query whose search continues at `node`.
struct Heavy {
  int64_t query;
  int32_t node;
};

// Parts of the workspace; without memory, its size.
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
  unsigned char* sort;
  size_t sort_bytes = 0, bytes = 0;

  Workspace(const Surfaces<T>& in, int64_t capacity, void* memory) {
    Parts<> take(memory);
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
    take(sort, sort_bytes);
    bytes = take.bytes;
  }
};

// Whether the first search has kept all candidates: then the second need not search.
template <class T>
__device__ bool kept_all(const Workspace<T>& work, int64_t capacity) {
  return *work.found <= static_cast<unsigned long long>(kCandidates * capacity);
}

// Appends a key to a list, with one atomic for all threads that are here together.
__device__ void append(unsigned long long* count, unsigned long long* list, int64_t capacity, uint64_t key) {
  const unsigned together = __activemask(), lane = threadIdx.x % 32;
  const int leader = __ffs(static_cast<int>(together)) - 1;
  unsigned long long first = 0;
  if (static_cast<int>(lane) == leader) first = atomicAdd(count, static_cast<unsigned long long>(__popc(together)));
  const unsigned long long place = __shfl_sync(together, first, leader) + __popc(together & ((1U << lane) - 1));
  if (place < static_cast<unsigned long long>(capacity)) list[place] = key;
}

// One of two searches: first for the near gaps of all corner points, then for the near pairs, which also lists.
template <class T, bool listing>
struct Search {
  const Surfaces<T>& in;
  const Workspace<T>& work;
  int64_t capacity;

  // A pair without a gap, or a point that is not finite, so that its scene is not taken for valid.
  __device__ void touch(int64_t scene, uint64_t key = kNoKey) const {
    atomicAdd(&work.touching[0], 1ULL);
    lower(&work.touching[1], static_cast<unsigned long long>(key));
    lower(work.smallest + scene, ordered(T(0)));
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

  // Second search of a pair that may be listed.
  __device__ void settle(const Candidate& c, const PairGap<T>& of) const {
    const auto [gap, begins, least] = of;
    const Constants<T> constants = constants_of(in, c);
    if (!constants.admitted) return;
    const uint64_t key = key_of(in, c);
    if (!(gap > T(0) && begins > T(0))) touch(c.scene, key);
    if (gap != gap) return;
    const Ordered<T> bits = ordered(gap);
    for (int k = 0; k < 4; ++k) {
      const int64_t row = c.scene * in.corners + c.v[k];
      if (work.near_gap[row] == bits) lower(work.near_key + row, static_cast<unsigned long long>(key));
    }
    if (is_listed(in, c, least, constants.dhat)) append(work.listed, work.keys, capacity, key);
  }

  // Query q: first those of points, then those of edges, in the order of the forest.
  struct Query {
    Box box;
    int64_t scene;
    int kind;
    int32_t leaf;  // own leaf of an edge
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

  // Nodes [from, end) of the tree, leaves from `first` on.
  __device__ void walk(const Query& q, int32_t from, int32_t end, int32_t first) const {
    const Near near(*this, q);
    each_leaf(near.nodes, work.forest.leaves[q.kind], from, end, near, [&](int32_t leaf) {
      if (leaf >= first) examine_leaf(q.scene, q.kind, q.box.item, leaf);
      return true;
    });
  }

  // Whether a node may contain a candidate.
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
      const float square = distance2(node, box);  // rejects most nodes
      return square <= reach.any && square <= reach.to(node.group) && !in.ignores(box.group, node.group);
    }
  };
};

// Leaves that a warp has found and not yet examined, and their finders.
struct Finds {
  int32_t leaf[2 * kWarp], item[kWarp], scene[kWarp];
  uint8_t finder[2 * kWarp], kind[kWarp];
};

// A thread for each query. Threads find leaves at different times, so a warp collects them and examines as many as it
// has threads.
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
    if (!listing && q.kind == kPointTriangle) search.touch(q.scene);
    walks = false;
  }
  // Each pair of edges once: an edge looks to its right in the tree.
  int32_t node = q.kind == kEdgeEdge ? next_node(q.leaf) : kRoot;
  walks = walks && !(q.kind == kEdgeEdge && node == kRoot);
  finds.item[lane] = q.box.item, finds.scene[lane] = static_cast<int32_t>(q.scene);
  finds.kind[lane] = static_cast<uint8_t>(q.kind);
  const typename Search<T, listing>::Near near(search, q);
  const int32_t leaves = work.forest.leaves[q.kind];
  int hits = 0, count = 0;  // count: of the warp
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

// Rest of the searches with many leaves, a block for each.
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

// Points and planes, a thread for each point; separate, because the other searches would need more registers with it.
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
  planes_kernel<T, listing><<<blocks_for(points, kThreads), kThreads, 0, stream>>>(in, work, capacity, points);
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
  search_kernel<T, listing>
      <<<blocks_for(queries, kThreads), kThreads, 0, stream>>>(in, work, capacity, queries, most_hits);
  heavy_kernel<T, listing><<<kHeavyBlocks, kThreads, 0, stream>>>(in, work, capacity);
  launch_planes<T, listing>(in, work, capacity, stream);
}

constexpr int64_t kMostCompared = int64_t{1} << 23;  // comparisons of all scenes
constexpr int32_t kMostScanned = 2048;               // comparisons of a query

template <class T>
bool is_scanned(const Surfaces<T>& in) {
  const int64_t edges = in.num_edges, triangles = in.num_triangles, points = in.num_points;
  return edges <= kMostScanned && triangles <= kMostScanned &&
         in.scenes * (points * (triangles + kWarp) + edges * (edges / 2 + kWarp)) <=
             kMostCompared;  // at least a warp each
}

// A warp for each query: it examines leaves as soon as each of its threads has one.
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
    if (!listing && q.kind == kPointTriangle && lane == 0) search.touch(q.scene);
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
  scan_kernel<T, listing><<<blocks_for(kWarp * queries, kThreads), kThreads, 0, stream>>>(in, work, capacity, queries);
  launch_planes<T, listing>(in, work, capacity, stream);
}

constexpr int64_t kMostCounted = 20480;  // capacity, mostly twice the number of pairs
constexpr int64_t kMostPoints = 2048;    // corner points of all scenes
constexpr unsigned kRankBlocks = 264;

template <class T>
bool is_counted(const Surfaces<T>& in, int64_t capacity) {
  return 0 < capacity && capacity <= kMostCounted && in.scenes * in.corners <= kMostPoints;
}

// Pairs in the list.
template <class T>
__device__ int32_t pairs_of(const Workspace<T>& work, const Detected<T>& out) {
  const auto needed = static_cast<int64_t>(*work.listed);
  return static_cast<int32_t>(needed < out.capacity ? needed : out.capacity);
}

// Rows of the list, a warp for each key.
template <class T>
__global__ void __launch_bounds__(kThreads) rank_kernel(const Surfaces<T> in, Workspace<T> work, Detected<T> out) {
  const int32_t count = pairs_of(work, out), lane = threadIdx.x % kWarp;
  const auto first = static_cast<int32_t>(own_item()), threads = static_cast<int32_t>(gridDim.x * kThreads);
  for (int32_t i = first / kWarp; i < count; i += threads / kWarp) {
    const unsigned long long key = work.keys[i];
    unsigned rank = 0;
#pragma unroll 8
    for (int32_t other = lane; other < count; other += kWarp) rank += work.keys[other] < key ? 1 : 0;
    rank = __reduce_add_sync(kWholeWarp, rank);
    if (lane == 0) store_listed_pair(in, key, out.pairs + kPairRow * rank, out.constants + kConstants * rank);
  }
  for (int64_t i = count + first; i < out.capacity; i += threads) {
    store_listed_pair(in, kNoKey, out.pairs + kPairRow * i, out.constants + kConstants * i);
    for (int k = 0; k < 4; ++k) out.entry[4 * i + k] = -1;
  }
}

// Calls f(pair, four corner points among those of all scenes) for the pairs [first, last), one for each lane of a warp;
// -1 where a lane has none.
template <class T, class F>
__device__ void each_pair(const Surfaces<T>& in, const Detected<T>& out, int32_t first, int32_t last, const F& f) {
  const int32_t lane = threadIdx.x % kWarp;
  for (; first < last; first += kWarp) {
    const int32_t pair = first + lane;
    const int32_t* row = out.pairs + kPairRow * pair;
    int64_t points[4] = {-1, -1, -1, -1};
    for (int k = 0; k < 4 && pair < last; ++k) points[k] = row[kPairRow - 1] * int64_t{in.corners} + row[k];
    f(pair, points);
  }
}

// ptr and entries of a corner point, by a block whose warps search one part of the list each: number of entries of
// earlier points, and own entries.
template <class T>
__device__ void list_entries(const Surfaces<T>& in, const Detected<T>& out, int64_t point, int32_t count) {
  constexpr int warps = kThreads / kWarp;
  __shared__ unsigned before[warps], own[warps];
  const int warp = static_cast<int>(threadIdx.x) / kWarp;
  const int32_t part = (count + kThreads - 1) / kThreads * kWarp;
  const int32_t first = part * warp, end = first + part, last = end < count ? end : count;
  unsigned less = 0, equal = 0;
  each_pair(in, out, first, last, [&](int32_t, const int64_t* points) {
    for (int k = 0; k < 4; ++k) {
      less += 0 <= points[k] && points[k] < point ? 1 : 0;
      equal += points[k] == point ? 1 : 0;
    }
  });
  less = __reduce_add_sync(kWholeWarp, less), equal = __reduce_add_sync(kWholeWarp, equal);
  const unsigned lane = threadIdx.x % kWarp, lanes_before = (1u << lane) - 1;
  if (lane == 0) before[warp] = less, own[warp] = equal;
  __syncthreads();
  unsigned begin = 0, skipped = 0;
  for (int w = 0; w < warps; ++w) begin += before[w], skipped += w < warp ? own[w] : 0;
  if (threadIdx.x == 0) out.ptr[point] = static_cast<int32_t>(begin);
  if (equal == 0) return;
  int32_t* to = out.entry + begin + skipped;
  each_pair(in, out, first, last, [&](int32_t pair, const int64_t* points) {
    int place = 0, found = 0;
    for (int k = 0; k < 4; ++k) {
      const unsigned has = __ballot_sync(kWholeWarp, points[k] == point);
      place += __popc(has & lanes_before), found += __popc(has);
    }
    for (int k = 0; k < 4; ++k) {
      if (points[k] == point) to[place++] = 4 * pair + k;
    }
    to += found;
  });
}

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

// --- results ---

// Rows of the list, and their corner points for the sort.
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

// Near pair of a corner point, and smallest gap of its scene.
template <class T>
__device__ void store_corner(const Surfaces<T>& in, const Workspace<T>& work, const Detected<T>& out, int64_t point) {
  const int64_t scene = point / in.corners;
  store_near_pair(in, scene, static_cast<int32_t>(point - scene * in.corners), work.near_key[point],
                  out.near_corners + kNearRow * point, out.near_values + kNearValues * point);
  lower(work.smallest + scene, work.near_gap[point]);
}

// ptr by bisection of the sorted corner points, near pairs, and smallest gaps.
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

// The same and the entries for few pairs, a block for each corner point.
template <class T>
__global__ void __launch_bounds__(kThreads) entry_kernel(const Surfaces<T> in, Workspace<T> work, Detected<T> out) {
  const int64_t i = blockIdx.x;  // the last block only closes ptr
  list_entries(in, out, i, pairs_of(work, out));
  if (i < in.scenes * in.corners && threadIdx.x == 0) store_corner(in, work, out, i);
}

// Hints from the neighbourhood of a pair, once near pairs are known.
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
  out.counts[2] = static_cast<int64_t>(work.touching[1]);  // kNoKey is -1
}

// Sorted rows and entries of many pairs, and ptr.
template <class T>
cudaError_t sort_list(const Surfaces<T>& in, const Workspace<T>& work, const Detected<T>& out, cudaStream_t stream) {
  const int64_t rows = in.scenes * in.corners, capacity = out.capacity;
  if (capacity > 0) {
    size_t bytes = work.sort_bytes;
    if (auto error = cub::DeviceRadixSort::SortKeys(work.sort, bytes, work.keys, work.sorted_keys, capacity, 0,
                                                    bits_of(in.keys()), stream))
      return error;
    list_kernel<<<blocks_for(capacity, kThreads), kThreads, 0, stream>>>(in, work, out);
    bytes = work.sort_bytes;
    if (auto error =
            cub::DeviceRadixSort::SortPairs(work.sort, bytes, work.points, work.sorted_points, work.entries, out.entry,
                                            4 * capacity, 0, bits_of(static_cast<uint64_t>(rows)), stream))
      return error;
  }
  corner_kernel<<<blocks_for(rows + 1, kThreads), kThreads, 0, stream>>>(in, work, out);
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
  start_kernel<<<blocks_for((most > in.scenes ? most : in.scenes) + 1, kThreads), kThreads, 0, stream>>>(in, work,
                                                                                                         capacity);
  if (auto error = build_forest(in, work.forest, work.sort, work.sort_bytes, stream)) return error;
  if (work.forest.sorted) {
    launch_search<T, false>(in, work, capacity, stream);
    launch_search<T, true>(in, work, capacity, stream);
  } else {
    launch_scan<T, false>(in, work, capacity, stream);
    launch_scan<T, true>(in, work, capacity, stream);
  }
  if (capacity > 0)
    settle_kernel<<<blocks_for(kCandidates * capacity, kThreads), kThreads, 0, stream>>>(in, work, capacity);
  if (is_counted(in, capacity)) {
    const unsigned blocks = std::min(kRankBlocks, static_cast<unsigned>(blocks_for(kWarp * capacity, kThreads)));
    rank_kernel<<<blocks, kThreads, 0, stream>>>(in, work, out);
    entry_kernel<<<static_cast<unsigned>(rows + 1), kThreads, 0, stream>>>(in, work, out);
  } else if (auto error = sort_list(in, work, out, stream)) {
    return error;
  }
  if (capacity > 0) hint_kernel<<<blocks_for(capacity, kThreads), kThreads, 0, stream>>>(in, out);
  finish_kernel<<<blocks_for(in.scenes + 1, kThreads), kThreads, 0, stream>>>(in.scenes, work, out);
  return cudaGetLastError();
}

DIFFVBD_INSTANTIATE(detect_workspace_bytes)
DIFFVBD_INSTANTIATE(detect)

}  // namespace diffvbd::cuda
