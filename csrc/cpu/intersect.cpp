#include "intersect.h"

#include "kernels.h"
#include "tree.h"

namespace diffvbd {
namespace {

using namespace contact;

// Triangles near a group of edges, in rows for the kernel that compares them with an edge.
class Met {
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
    const int found = meet_(BoxRows{sides_.data(), corners_.data(), stride_, count_}, box, ends, near_.data());
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

  const MeetKernel meet_ = meet_kernel();
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
      Met met;
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
  void search(int64_t scene, int32_t g, Met& met, std::vector<uint64_t>& found) const {
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
  // With few scenes, threads share each.
  if (in.scenes < torch::stable::get_num_threads()) {
    search_scenes(0, in.scenes);
  } else {
    torch::stable::parallel_for(0, in.scenes, 1, search_scenes);
  }
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
