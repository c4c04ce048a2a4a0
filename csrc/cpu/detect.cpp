// Detection and intersections on the CPU. Trees (contact/detection.h) are built for one scene after the other in the
// same memory.
#include "detect.h"

#include <torch/csrc/stable/ops.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <cmath>
#include <mutex>
#include <vector>

#include "../contact/detection.h"
#include "kernels.h"
#include "threads.h"

namespace diffvbd {

using namespace contact;

namespace {

constexpr int64_t kSearchGrain = 8;                // pieces of a search that are worth one more thread: about 300 us
constexpr int64_t kChunk = 256;                    // primitives of one piece
constexpr int32_t kGroup = 8;                      // neighbors in a tree that look for others together
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

// f(begin, end) for all scenes; with few scenes, threads share each.
template <class F>
void for_scenes(int64_t scenes, const F& f) {
  if (scenes < static_cast<int64_t>(torch::stable::get_num_threads())) return f(0, scenes);
  torch::stable::parallel_for(0, scenes, 1, f);
}

// Boxes of all corner points of a scene.
template <class T>
void fill_corner_boxes(const Surfaces<T>& in, int64_t scene, std::vector<Box>& boxes) {
  const Place<T> reference = reference_point(in, scene);
  boxes.resize(in.corners);
  for_each(in.corners, [&](int64_t i) { boxes[i] = corner_box(in, scene, static_cast<int32_t>(i), reference); });
}

struct Tree {
  int32_t leaves = kGroup;
  std::vector<Box> boxes, nodes;  // of the primitives in their order, and the tree's
  std::vector<Keyed> codes, scratch;

  // Boxes of `count` primitives with so many corners each, from those of all corner points.
  template <class T>
  void fill(const Surfaces<T>& in, const std::vector<Box>& corner_boxes, const int32_t* items, int64_t count,
            int corners) {
    boxes.resize(count);
    for_each(count, [&](int64_t i) {
      boxes[i] = primitive_box(in, items + corners * i, corners, static_cast<int32_t>(i),
                               [&](int32_t corner) { return corner_boxes[corner]; });
    });
  }
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

// The finds of a piece of the search.
template <class T>
struct Finds {
  std::vector<uint64_t> pairs;  // that the list needs
  int64_t touching = 0;
  uint64_t first_touching = kNoKey;
};

// A leaf near a group.
struct NearLeaf {
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
      std::vector<NearLeaf> met;
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
    T smallest = touching_ == 0 ? reach_ : std::min(reach_, T(0));
    for (const Near<T>& near : near_) smallest = std::min(smallest, near.gap.load(std::memory_order_relaxed));
    out.smallest[scene_] = smallest;
  }

 private:
  void build_trees() {
    fill_corner_boxes(in_, scene_, corner_boxes_);
    triangles_.fill(in_, corner_boxes_, in_.triangles, in_.num_triangles, 3);
    edges_.fill(in_, corner_boxes_, in_.edges, in_.num_edges, 2);
    points_.fill(in_, corner_boxes_, in_.points, in_.num_points, 1);
    Box bounds = empty_box();
    for (const Tree* tree : {&triangles_, &edges_, &points_}) {
      for (const Box& box : tree->boxes) bounds = hull(bounds, box);
    }
    for (Tree* tree : {&triangles_, &edges_, &points_}) tree->build(bounds);
  }

  // Pairs of the primitives of group g of `tree`; of an edge, those with edges to the right of it: each pair once.
  template <int kind>
  void search(const Tree& tree, const Tree& others, int32_t g, std::vector<NearLeaf>& met, Finds<T>& finds) {
    const int32_t home = tree.groups() + g;
    const Box &around = tree.nodes[home], *nodes = others.nodes.data();
    const Reach<T> reach = squared_reach(in_, scene_, around.group);
    met.clear();
    if (!is_empty(around)) {
      const auto hits = [&](const Box& node) {
        return distance2(node, around) <= reach.to(node.group) && !in_.ignores(around.group, node.group);
      };
      each_leaf(nodes, others.leaves, kind == kEdgeEdge ? home : kRoot, kRoot, hits, [&](int32_t i) {
        met.push_back({nodes[i], i});
        return true;
      });
    }
    for (int32_t leaf = home * kGroup; leaf < (home + 1) * kGroup; ++leaf) {
      const Box& own = tree.nodes[leaf];
      if (!is_empty(own)) {
        const Reach<T> from = squared_reach(in_, scene_, own.group);
        for (const NearLeaf& other : met) {
          if (kind == kEdgeEdge && other.node <= leaf) continue;
          if (!(distance2(other.box, own) <= from.to(other.box.group))) continue;
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
    const auto [gap, begins, least] = gap_of(in_, c);
    if (least >= reach_ || (gap > T(0) && !is_listed(in_, c, least, in_.dhat))) return;
    const Constants<T> constants = constants_of(in_, c);
    if (!constants.admitted) return;
    const uint64_t key = key_of(in_, c);
    if (!(gap > T(0) && begins > T(0))) ++finds.touching, finds.first_touching = std::min(finds.first_touching, key);
    if (std::isnan(gap)) return;
    for (const int32_t v : c.v) offer(near_[v], v, gap, key);
    if (is_listed(in_, c, least, constants.dhat)) finds.pairs.push_back(key);
  }

  static void offer(Near<T>& near, int32_t v, T gap, uint64_t key) {
    if (gap > near.gap.load(std::memory_order_relaxed)) return;
    const std::lock_guard<std::mutex> lock(locks[v % locks.size()]);
    const T old = near.gap.load(std::memory_order_relaxed);
    if (gap > old || (gap == old && key >= near.key)) return;
    near.gap.store(gap, std::memory_order_relaxed), near.key = key;
  }

  // Collects the finds, sorted.
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
  std::vector<Box> corner_boxes_;
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
std::vector<uint64_t> detect(const Surfaces<T>& in, const Detected<T>& out) {
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
  for_scenes(in.scenes, detect_scenes);

  std::vector<uint64_t> keys;
  int64_t touches = 0;
  uint64_t first = kNoKey;
  for (int64_t b = 0; b < in.scenes; ++b) {
    keys.insert(keys.end(), lists[b].begin(), lists[b].end());
    touches += touching[b], first = std::min(first, first_touching[b]);
  }
  out.counts[0] = static_cast<int64_t>(keys.size()), out.counts[1] = touches;
  out.counts[2] = first == kNoKey ? -1 : static_cast<int64_t>(first);
  return keys;
}

template <class T>
void store_list(const Surfaces<T>& in, const std::vector<uint64_t>& keys, const Detected<T>& out) {
  const auto rows = std::min(static_cast<int64_t>(keys.size()), out.capacity);
  for_each(out.capacity, [&](int64_t i) {
    int32_t* pair = out.pairs + kPairRow * i;
    T* constants = out.constants + kConstants * i;
    store_listed_pair(in, i < rows ? keys[i] : kNoKey, pair, constants);
    store_hints(in, out, pair, constants);
  });
  store_entries(in, rows, out);
}

#define DIFFVBD_INSTANTIATE(T)                                                      \
  template std::vector<uint64_t> detect<T>(const Surfaces<T>&, const Detected<T>&); \
  template void store_list<T>(const Surfaces<T>&, const std::vector<uint64_t>&, const Detected<T>&);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)

namespace {

// Triangles near a group of edges, in rows for the kernel that compares them with an edge.
class NearTriangles {
 public:
  void clear() { count_ = 0; }
  void add(const Box& box, const int32_t* corners) {
    if (count_ == stride_) grow();
    const float sides[] = {box.lo.x, box.lo.y, box.lo.z, box.hi.x, box.hi.y, box.hi.z};
    for (int k = 0; k < 6; ++k) sides_[k * stride_ + count_] = sides[k];
    for (int k = 0; k < 3; ++k) corners_[k * stride_ + count_] = corners[k];
    items_[count_++] = box.item;
  }
  // visit(triangle) for those whose boxes overlap that of an edge with which they share no vertex.
  template <class Visit>
  void each_near(const Box& own, const int32_t* ends, const Visit& visit) {
    const float box[] = {own.lo.x, own.lo.y, own.lo.z, own.hi.x, own.hi.y, own.hi.z};
    const int found = overlap_(BoxRows{sides_.data(), corners_.data(), stride_, count_}, box, ends, near_.data());
    for (int i = 0; i < found; ++i) visit(items_[near_[i]]);
  }
  // Up to a whole number of packs.
  void fill_up() {
    const int32_t none[] = {-1, -1, -1};
    while (count_ % kBoxLanes != 0) add(empty_box(), none);
  }

 private:
  void grow() {
    const int stride = stride_ == 0 ? 8 * kBoxLanes : 2 * stride_;
    const auto widen = [&](auto& rows, int count) {
      rows.resize(static_cast<size_t>(count) * stride);
      for (int k = count - 1; k > 0; --k) {
        std::copy_backward(rows.begin() + k * stride_, rows.begin() + (k + 1) * stride_,
                           rows.begin() + k * stride + stride_);
      }
    };
    widen(sides_, 6), widen(corners_, 3), widen(items_, 1), widen(near_, 1);
    stride_ = stride;
  }

  const OverlapKernel overlap_ = overlap_kernel();
  int stride_ = 0, count_ = 0;
  std::vector<float> sides_;
  std::vector<int32_t> corners_, items_, near_;
};

// The search in one scene after the other, with the same memory.
template <class T>
class SceneIntersections {
 public:
  explicit SceneIntersections(const Surfaces<T>& in) : in_(in) {}

  // Keys of all crossings, sorted; counts and the first of both kinds go to `out`.
  const std::vector<uint64_t>& run(int64_t scene, const Intersections& out) {
    build_trees(scene);
    constexpr int32_t each = kChunk / kGroup;
    const int32_t chunks = (edges_.groups() + each - 1) / each;
    finds_.resize(chunks);
    torch::stable::parallel_for(0, chunks, kSearchGrain, [&](int64_t begin, int64_t end) {
      NearTriangles met;
      for (int64_t c = begin; c < end; ++c) {
        finds_[c].clear();
        const auto first = static_cast<int32_t>(c) * each;
        for (int32_t g = first; g < std::min(first + each, edges_.groups()); ++g) search(scene, g, met, finds_[c]);
      }
    });
    keys_.clear();
    for (const auto& found : finds_) keys_.insert(keys_.end(), found.begin(), found.end());
    std::sort(keys_.begin(), keys_.end());

    int64_t behind = 0;
    uint64_t first_behind = kNoKey;
    for (int32_t i = 0; i < in_.num_points; ++i) {
      for (int32_t p = 0; p < in_.num_planes; ++p) {
        if (!is_behind(in_, scene, i, p)) continue;
        if (behind++ == 0) first_behind = behind_key(in_, i, p);
      }
    }
    out.counts[2 * scene] = static_cast<int64_t>(keys_.size()), out.counts[2 * scene + 1] = behind;
    store_first(in_, keys_.empty() ? kNoKey : keys_.front(), first_behind, out.first + 4 * scene);
    return keys_;
  }

 private:
  void build_trees(int64_t scene) {
    fill_corner_boxes(in_, scene, corner_boxes_);
    triangles_.fill(in_, corner_boxes_, in_.triangles, in_.num_triangles, 3);
    edges_.fill(in_, corner_boxes_, in_.edges, in_.num_edges, 2);
    Box bounds = empty_box();
    for (const Tree* tree : {&triangles_, &edges_}) {
      for (const Box& box : tree->boxes) bounds = hull(bounds, box);
    }
    triangles_.build(bounds), edges_.build(bounds);
  }

  // Crossings of the edges of group g.
  void search(int64_t scene, int32_t g, NearTriangles& met, std::vector<uint64_t>& found) const {
    const int32_t home = edges_.groups() + g;
    const Box &around = edges_.nodes[home], *nodes = triangles_.nodes.data();
    if (is_empty(around)) return;
    met.clear();
    const auto hits = [&](const Box& node) { return overlap(node, around) && !in_.ignores(around.group, node.group); };
    each_leaf(nodes, triangles_.leaves, kRoot, kRoot, hits, [&](int32_t i) {
      met.add(nodes[i], in_.triangles + int64_t{3} * nodes[i].item);
      return true;
    });
    met.fill_up();
    for (int32_t leaf = home * kGroup; leaf < (home + 1) * kGroup; ++leaf) {
      const Box& own = edges_.nodes[leaf];
      if (is_empty(own)) continue;
      met.each_near(own, in_.edges + int64_t{2} * own.item, [&](int32_t triangle) {
        if (is_crossing(in_, scene, own.item, triangle)) {
          found.push_back(crossing_key(in_, scene, own.item, triangle));
        }
      });
    }
  }

  const Surfaces<T>& in_;
  std::vector<Box> corner_boxes_;
  Tree triangles_, edges_;
  std::vector<std::vector<uint64_t>> finds_;
  std::vector<uint64_t> keys_;
};

}  // namespace

template <class T>
void find_intersections(const Surfaces<T>& in, const Intersections& out) {
  std::vector<std::vector<uint64_t>> lists(in.scenes);
  const auto search_scenes = [&](int64_t begin, int64_t end) {
    SceneIntersections<T> search(in);
    for (int64_t b = begin; b < end; ++b) lists[b] = search.run(b, out);
  };
  for_scenes(in.scenes, search_scenes);
  int64_t row = 0;
  for (const auto& keys : lists) {
    for (size_t k = 0; k < keys.size() && row < out.capacity; ++k) {
      store_crossing(in, keys[k], out.pairs + kCrossingRow * row++);
    }
  }
  for (; row < out.capacity; ++row) store_crossing(in, kNoKey, out.pairs + kCrossingRow * row);
}

template void find_intersections<float>(const Surfaces<float>&, const Intersections&);
template void find_intersections<double>(const Surfaces<double>&, const Intersections&);

}  // namespace diffvbd
