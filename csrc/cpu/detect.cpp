#include "detect.h"

#include <torch/csrc/stable/ops.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <cmath>
#include <mutex>
#include <utility>
#include <vector>

#include "grain.h"

namespace diffvbd {
namespace {

using namespace contact;

constexpr int64_t kChunk = 256;                    // primitives of one piece of the search
constexpr int64_t kSearchGrain = 8;                // pieces that are worth one more thread: about 300 us
constexpr int32_t kGroup = 8;                      // neighbors in a tree that look for pairs together
constexpr int kDigitBits = 12, kShortSort = 2048;  // up to this many items a comparison sort is quicker

struct Keyed {
  uint64_t key;
  int32_t item;
};
uint64_t key_of(const Keyed& a) { return a.key; }
uint64_t key_of(uint64_t a) { return a; }
bool operator<(const Keyed& a, const Keyed& b) { return a.key != b.key ? a.key < b.key : a.item < b.item; }

// Stable sort by keys below 2^bits; the items of equal keys must come in ascending order.
template <class Item>
void sort_by_key(std::vector<Item>& items, std::vector<Item>& other, int bits) {
  if (items.size() <= kShortSort) return std::sort(items.begin(), items.end());
  other.resize(items.size());
  for (int shift = 0; shift < bits; shift += kDigitBits) {
    std::array<size_t, (size_t{1} << kDigitBits) + 1> start{};
    const auto digit = [&](const Item& a) { return key_of(a) >> shift & ((size_t{1} << kDigitBits) - 1); };
    for (const Item& a : items) ++start[digit(a) + 1];
    for (size_t d = 1; d < start.size(); ++d) start[d] += start[d - 1];
    for (const Item& a : items) other[start[digit(a)]++] = a;
    items.swap(other);
  }
}

int bits_of(uint64_t below) {
  int bits = 0;
  while (bits < 64 && below >> bits != 0) ++bits;
  return bits;
}

// f(i) for all i < n; within a parallel region, one thread does it all.
template <class F>
void for_each(int64_t n, const F& f) {
  torch::stable::parallel_for(0, n, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) f(i);
  });
}

struct Tree {
  int32_t leaves = kGroup;
  std::vector<Box> boxes, nodes;  // of the primitives in their order, and the tree's
  std::vector<Keyed> codes, scratch;

  // `bounds` cover all boxes that are not empty.
  void build(const Box& bounds) {
    const auto n = static_cast<int64_t>(boxes.size());
    codes.resize(n);
    for_each(n, [&](int64_t i) { codes[i] = {morton_code(boxes[i], bounds, kMostAxisBits), static_cast<int32_t>(i)}; });
    sort_by_key(codes, scratch, 3 * kMostAxisBits);
    leaves = std::max(kGroup, padded_leaves(n));
    nodes.resize(int64_t{2} * leaves);
    for_each(leaves, [&](int64_t k) { nodes[leaves + k] = k < n ? boxes[codes[k].item] : empty_box(); });
    for (int32_t i = leaves - 1; i >= kRoot; --i) nodes[i] = hull(nodes[2 * i], nodes[2 * i + 1]);
  }
  int32_t groups() const { return leaves / kGroup; }
};

// The near pair of a corner point: the smallest gap, then the smallest key.
template <class T>
struct Near {
  std::atomic<T> gap;
  uint64_t key;
};

// What a piece of the search finds.
template <class T>
struct Finds {
  std::vector<uint64_t> pairs;  // that the list needs
  int64_t touching = 0;
  uint64_t first_touching = kNoKey;
};

// A leaf near a group.
struct Met {
  Box box;
  int32_t node;
};

std::array<std::mutex, 256> locks;  // of near pairs; a lock is taken only where one improves

// Detection in one scene after the other, with the same memory.
template <class T>
class SceneDetection {
 public:
  explicit SceneDetection(const Surfaces<T>& in) : in_(in), near_(in.corners) {}

  void run(int64_t scene) {
    scene_ = scene, reach_ = reach_of(in_, scene);
    for (Near<T>& near : near_) near.gap.store(reach_, std::memory_order_relaxed), near.key = kNoKey;
    build_trees();
    constexpr int32_t each = kChunk / kGroup;
    const int32_t point_chunks = (points_.groups() + each - 1) / each,
                  edge_chunks = (edges_.groups() + each - 1) / each;
    finds_.resize(point_chunks + edge_chunks);
    torch::stable::parallel_for(0, point_chunks + edge_chunks, kSearchGrain, [&](int64_t begin, int64_t end) {
      std::vector<Met> met;
      for (int64_t c = begin; c < end; ++c) {
        Finds<T>& finds = finds_[c];
        finds.pairs.clear(), finds.touching = 0, finds.first_touching = kNoKey;
        const bool points = c < point_chunks;
        const auto first = static_cast<int32_t>((points ? c : c - point_chunks) * each);
        const int32_t last = std::min(first + each, points ? points_.groups() : edges_.groups());
        for (int32_t g = first; g < last; ++g) {
          points ? search<kPointTriangle>(points_, triangles_, g, met, finds)
                 : search<kEdgeEdge>(edges_, edges_, g, met, finds);
        }
      }
    });
    gather();
  }

  const std::vector<uint64_t>& listed() const { return listed_; }
  int64_t touching() const { return touching_; }
  uint64_t first_touching() const { return first_touching_; }

  void store_near(const Detected<T>& out) const {
    const int64_t row = scene_ * in_.corners;
    for_each(in_.corners, [&](int64_t i) {
      store_near_pair(in_, scene_, static_cast<int32_t>(i), near_[i].key, out.near_corners + kNearRow * (row + i),
                      out.near_values + kNearValues * (row + i));
    });
    T smallest = reach_;
    for (const Near<T>& near : near_) smallest = std::min(smallest, near.gap.load(std::memory_order_relaxed));
    out.smallest[scene_] = smallest;
  }

 private:
  void build_trees() {
    const Place<T> reference = reference_point(in_, scene_);
    Box bounds = empty_box();
    const auto fill = [&](Tree& tree, const int32_t* items, int64_t count, int corners) {
      tree.boxes.resize(count);
      for_each(count, [&](int64_t i) {
        tree.boxes[i] = primitive_box(in_, scene_, items + corners * i, corners, static_cast<int32_t>(i), reference);
      });
      for (const Box& box : tree.boxes) bounds = hull(bounds, box);
    };
    fill(triangles_, in_.triangles, in_.num_triangles, 3);
    fill(edges_, in_.edges, in_.num_edges, 2);
    fill(points_, in_.points, in_.num_points, 1);
    for (Tree* tree : {&triangles_, &edges_, &points_}) tree->build(bounds);
  }

  // Pairs of the primitives of group g of `tree`; of an edge, those with edges to the right of it: each pair once.
  template <int kind>
  void search(const Tree& tree, const Tree& others, int32_t g, std::vector<Met>& met, Finds<T>& finds) {
    const int32_t home = tree.groups() + g;
    const Box &around = tree.nodes[home], *nodes = others.nodes.data();
    const float reach2 = squared_reach(in_, scene_, around.group);
    met.clear();
    if (!is_empty(around)) {
      const auto skips = [&](int32_t group) { return in_.ignores(around.group, group); };
      each_leaf(nodes, others.leaves, kind == kEdgeEdge ? home : kRoot, kRoot, around, reach2, skips, [&](int32_t i) {
        met.push_back({nodes[i], i});
        return true;
      });
    }
    for (int32_t leaf = home * kGroup; leaf < (home + 1) * kGroup; ++leaf) {
      const Box& own = tree.nodes[leaf];
      if (!is_empty(own)) {
        for (const Met& other : met) {
          if ((kind == kEdgeEdge && other.node <= leaf) || !(distance2(other.box, own) <= reach2)) continue;
          examine(candidate(in_, scene_, kind, own.item, other.box.item), finds);
        }
      }
      if (kind == kPointTriangle) search_planes(own, finds);
    }
  }

  // A point that is not finite meets nothing: it counts as touching, so that nobody takes the scene for a good one.
  void search_planes(const Box& point, Finds<T>& finds) {
    if (point.item < 0) return;
    if (is_empty(point)) {
      ++finds.touching;
    } else if (point.group != in_.mesh_bodies) {
      for (int32_t p = 0; p < in_.num_planes; ++p) examine(candidate(in_, scene_, kPointPlane, point.item, p), finds);
    }
  }

  void examine(const Candidate& c, Finds<T>& finds) {
    if (!is_considered(in_, c)) return;
    const T gap = separation(c.kind, corners_of(in_, c)) - offset_of(in_, c);
    if (gap >= reach_) return;
    // near gaps only fall while the search goes on
    const auto improves = [&](int32_t v) { return gap <= near_[v].gap.load(std::memory_order_relaxed); };
    if (gap > T(0) && !is_listed(in_, c, gap, in_.dhat) && std::none_of(c.v, c.v + 4, improves)) return;
    const Constants<T> constants = constants_of(in_, c);
    if (!constants.admitted) return;
    const uint64_t key = contact::key_of(in_, c);
    if (!(gap > T(0))) ++finds.touching, finds.first_touching = std::min(finds.first_touching, key);
    if (std::isnan(gap)) return;
    for (const int32_t v : c.v) offer(near_[v], v, gap, key);
    if (is_listed(in_, c, gap, constants.dhat)) finds.pairs.push_back(key);
  }

  static void offer(Near<T>& near, int32_t v, T gap, uint64_t key) {
    if (gap > near.gap.load(std::memory_order_relaxed)) return;
    const std::lock_guard<std::mutex> lock(locks[v % locks.size()]);
    const T old = near.gap.load(std::memory_order_relaxed);
    if (gap > old || (gap == old && key >= near.key)) return;
    near.gap.store(gap, std::memory_order_relaxed), near.key = key;
  }

  // What the pieces have found, sorted.
  void gather() {
    listed_.clear(), touching_ = 0, first_touching_ = kNoKey;
    for (const Finds<T>& finds : finds_) {
      touching_ += finds.touching, first_touching_ = std::min(first_touching_, finds.first_touching);
      listed_.insert(listed_.end(), finds.pairs.begin(), finds.pairs.end());
    }
    sort_by_key(listed_, scratch_, bits_of(in_.keys()));
  }

  const Surfaces<T>& in_;
  int64_t scene_ = 0;
  Tree triangles_, edges_, points_;
  std::vector<Near<T>> near_;
  std::vector<Finds<T>> finds_;
  std::vector<uint64_t> listed_, scratch_;
  int64_t touching_ = 0;
  uint64_t first_touching_ = kNoKey;
  T reach_ = T(0);
};

// ptr and entry: a stable counting sort of the pairs' corners.
template <class T>
void store_entries(const Surfaces<T>& in, int64_t rows, const Detected<T>& out) {
  const int64_t corner_points = in.scenes * in.corners;
  const auto point_of = [&](int64_t e) {
    const int32_t* pair = out.pairs + e / 4 * kPairRow;
    return pair[kPairRow - 1] * int64_t{in.corners} + pair[e % 4];
  };
  std::fill(out.ptr, out.ptr + corner_points + 1, 0);
  for (int64_t e = 0; e < 4 * rows; ++e) ++out.ptr[point_of(e) + 1];
  for (int64_t i = 0; i < corner_points; ++i) out.ptr[i + 1] += out.ptr[i];
  std::vector<int32_t> next(out.ptr, out.ptr + corner_points);
  for (int64_t e = 0; e < 4 * rows; ++e) out.entry[next[point_of(e)]++] = static_cast<int32_t>(e);
  std::fill(out.entry + 4 * rows, out.entry + 4 * out.capacity, -1);
}

}  // namespace

template <class T>
void detect(const Surfaces<T>& in, const Detected<T>& out) {
  std::vector<std::vector<uint64_t>> lists(in.scenes);
  std::vector<int64_t> touching(in.scenes);
  std::vector<uint64_t> first_touching(in.scenes);
  const auto detect_scenes = [&](int64_t begin, int64_t end) {
    SceneDetection<T> detection(in);
    for (int64_t b = begin; b < end; ++b) {
      detection.run(b);
      detection.store_near(out);
      lists[b] = detection.listed();
      touching[b] = detection.touching(), first_touching[b] = detection.first_touching();
    }
  };
  // With few scenes, threads share each.
  if (in.scenes < torch::stable::get_num_threads()) {
    detect_scenes(0, in.scenes);
  } else {
    torch::stable::parallel_for(0, in.scenes, 1, detect_scenes);
  }

  std::vector<uint64_t> keys;
  int64_t touches = 0;
  uint64_t first = kNoKey;
  for (int64_t b = 0; b < in.scenes; ++b) {
    keys.insert(keys.end(), lists[b].begin(), lists[b].end());
    touches += touching[b], first = std::min(first, first_touching[b]);
  }
  const auto needed = static_cast<int64_t>(keys.size()), rows = std::min(needed, out.capacity);
  for_each(out.capacity, [&](int64_t i) {
    int32_t* pair = out.pairs + kPairRow * i;
    T* constants = out.constants + kConstants * i;
    store_listed_pair(in, i < rows ? keys[i] : kNoKey, pair, constants);
    store_hints(in, out, pair, constants);
  });
  store_entries(in, rows, out);
  out.counts[0] = needed, out.counts[1] = touches;
  out.counts[2] = first == kNoKey ? -1 : static_cast<int64_t>(first), out.counts[3] = 0;
}

template void detect<float>(const Surfaces<float>&, const Detected<float>&);
template void detect<double>(const Surfaces<double>&, const Detected<double>&);

}  // namespace diffvbd
