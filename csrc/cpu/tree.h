// Bounding-volume trees on the CPU (contact/tree.h), one scene after the other in the same memory.
#pragma once

#include <torch/csrc/stable/ops.h>

#include <algorithm>
#include <array>
#include <vector>

#include "../contact/candidates.h"
#include "grain.h"

namespace diffvbd {

constexpr int64_t kSearchGrain = 8;                // pieces of a search that are worth one more thread: about 300 us
constexpr int64_t kChunk = 256;                    // primitives of one piece
constexpr int32_t kGroup = 8;                      // neighbors in a tree that look for others together
constexpr int kDigitBits = 12, kShortSort = 2048;  // up to this many items a comparison sort is quicker

struct Keyed {
  uint64_t key;
  int32_t item;
};
inline uint64_t key_of(const Keyed& a) { return a.key; }
inline uint64_t key_of(uint64_t a) { return a; }
inline bool operator<(const Keyed& a, const Keyed& b) { return a.key != b.key ? a.key < b.key : a.item < b.item; }

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

inline int bits_of(uint64_t below) {
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

// Boxes of all corner points of a scene.
template <class T>
void fill_corner_boxes(const contact::Surfaces<T>& in, int64_t scene, std::vector<contact::Box>& boxes) {
  const contact::Place<T> reference = contact::reference_point(in, scene);
  boxes.resize(in.corners);
  for_each(in.corners,
           [&](int64_t i) { boxes[i] = contact::corner_box(in, scene, static_cast<int32_t>(i), reference); });
}

struct Tree {
  int32_t leaves = kGroup;
  std::vector<contact::Box> boxes, nodes;  // of the primitives in their order, and the tree's
  std::vector<Keyed> codes, scratch;

  // Boxes of `count` primitives with so many corners each, from those of all corner points.
  template <class T>
  void fill(const contact::Surfaces<T>& in, const std::vector<contact::Box>& corner_boxes, const int32_t* items,
            int64_t count, int corners) {
    boxes.resize(count);
    for_each(count, [&](int64_t i) {
      boxes[i] = contact::primitive_box(in, items + corners * i, corners, static_cast<int32_t>(i),
                                        [&](int32_t corner) { return corner_boxes[corner]; });
    });
  }
  // `bounds` cover all boxes that are not empty.
  void build(const contact::Box& bounds) {
    const auto n = static_cast<int64_t>(boxes.size());
    codes.resize(n);
    for_each(n, [&](int64_t i) {
      codes[i] = {contact::morton_code(boxes[i], bounds, contact::kMostAxisBits), static_cast<int32_t>(i)};
    });
    sort_by_key(codes, scratch, 3 * contact::kMostAxisBits);
    leaves = std::max(kGroup, contact::padded_leaves(n));
    nodes.resize(int64_t{2} * leaves);
    for_each(leaves, [&](int64_t k) { nodes[leaves + k] = k < n ? boxes[codes[k].item] : contact::empty_box(); });
    for (int32_t i = leaves - 1; i >= contact::kRoot; --i) nodes[i] = hull(nodes[2 * i], nodes[2 * i + 1]);
  }
  int32_t groups() const { return leaves / kGroup; }
};

}  // namespace diffvbd
