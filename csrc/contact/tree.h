// Bounding-volume trees of detection. A tree is implicit: leaves sorted along the Morton curve and padded to a power of
// two, node i over nodes 2i and 2i + 1, leaf k at node leaves + k. Boxes are single precision whatever the scalar of a
// scene, relative to a point of the scene and rounded outward, so that they only ever find too much.
#pragma once

#include <cstdint>
#include <limits>

#include "../core/vec.h"

namespace diffvbd::contact {

// Whose primitives a node holds: a mesh body, `mesh_bodies` for any collider, several of them, or none.
constexpr int32_t kMixed = -1, kNobody = -2;

struct alignas(16) Box {
  Vec3<float> lo;
  int32_t group;
  Vec3<float> hi;
  int32_t item;  // of a leaf: index of the primitive
};

// Meets nothing; what padding and primitives that are not finite have.
DIFFVBD_FN Box empty_box() {
  const float far = std::numeric_limits<float>::infinity();
  return {{far, far, far}, kNobody, {-far, -far, -far}, -1};
}
DIFFVBD_FN bool is_empty(const Box& a) { return !(a.lo.x <= a.hi.x); }

DIFFVBD_FN float lesser(float a, float b) { return a < b ? a : b; }
DIFFVBD_FN float greater(float a, float b) { return a < b ? b : a; }

DIFFVBD_FN Box hull(const Box& a, const Box& b) {
  const int32_t group = a.group == kNobody || a.group == b.group ? b.group : b.group == kNobody ? a.group : kMixed;
  return {{lesser(a.lo.x, b.lo.x), lesser(a.lo.y, b.lo.y), lesser(a.lo.z, b.lo.z)},
          group,
          {greater(a.hi.x, b.hi.x), greater(a.hi.y, b.hi.y), greater(a.hi.z, b.hi.z)},
          -1};
}

DIFFVBD_FN void grow(Box& a, float r) {
  a.lo = a.lo - Vec3<float>{r, r, r};
  a.hi += Vec3<float>{r, r, r};
}

// Squared distance of two boxes [m^2].
DIFFVBD_FN float distance2(const Box& a, const Box& b) {
#if defined(__CUDACC__)
  const auto apart = [](float a_lo, float a_hi, float b_lo, float b_hi) {
    return greater(greater(a_lo - b_hi, b_lo - a_hi), 0.0F);
  };
  const float x = apart(a.lo.x, a.hi.x, b.lo.x, b.hi.x), y = apart(a.lo.y, a.hi.y, b.lo.y, b.hi.y);
  const float z = apart(a.lo.z, a.hi.z, b.lo.z, b.hi.z);
  return x * x + y * y + z * z;
#else
  // Without branches, which nobody could predict: half of all boxes of a search are hit.
  using Four = float __attribute__((vector_size(16)));
  using Bits = int32_t __attribute__((vector_size(16)));
  const auto four = [](const void* p) {
    Four out;
    __builtin_memcpy(&out, p, sizeof out);
    return out;
  };
  const Four under = four(&a.lo) - four(&b.hi), over = four(&b.lo) - four(&a.hi), most = under > over ? under : over;
  const Bits kept = (most > 0.0F) & Bits{-1, -1, -1, 0};  // the last of each four is an integer
  const Four apart = reinterpret_cast<Four>(reinterpret_cast<Bits>(most) & kept), square = apart * apart;
  return square[0] + square[1] + square[2];
#endif
}

// Whether boxes overlap; empty ones may.
DIFFVBD_FN bool overlap(const Box& a, const Box& b) {
#if defined(__CUDACC__)
  return a.lo.x <= b.hi.x && b.lo.x <= a.hi.x && a.lo.y <= b.hi.y && b.lo.y <= a.hi.y && a.lo.z <= b.hi.z &&
         b.lo.z <= a.hi.z;
#else
  using Four = float __attribute__((vector_size(16)));
  using Bits = int32_t __attribute__((vector_size(16)));
  using Halves = int64_t __attribute__((vector_size(16)));
  const auto four = [](const void* p) {
    Four out;
    __builtin_memcpy(&out, p, sizeof out);
    return out;
  };
  const Bits out = ((four(&a.lo) > four(&b.hi)) | (four(&b.lo) > four(&a.hi))) & Bits{-1, -1, -1, 0};
  const Halves halves = reinterpret_cast<Halves>(out);
  return (halves[0] | halves[1]) == 0;
#endif
}

// Every third bit of the result is one of the lowest 21 of x.
DIFFVBD_FN uint64_t spread_bits(uint64_t x) {
  x = (x | x << 32) & 0x001f00000000ffff;
  x = (x | x << 16) & 0x001f0000ff0000ff;
  x = (x | x << 8) & 0x100f00f00f00f00f;
  x = (x | x << 4) & 0x10c30c30c30c30c3;
  return (x | x << 2) & 0x1249249249249249;
}

constexpr int kMostAxisBits = 16;

// Place of a box's center in the bounds of its scene along the Morton curve, axis_bits <= 21 for each axis.
DIFFVBD_FN uint64_t morton_code(const Box& a, const Box& bounds, int axis_bits) {
  if (is_empty(a)) return 0;
  const float cells = static_cast<float>(1 << axis_bits);
  const auto cell = [&](float lo, float hi, float from, float to) {
    const float at = (0.5F * (lo + hi) - from) / (to - from) * cells;  // not a number where the bounds have no length
    return at > 0.0F ? static_cast<uint64_t>(lesser(at, cells - 1.0F)) : uint64_t{0};
  };
  const uint64_t x = cell(a.lo.x, a.hi.x, bounds.lo.x, bounds.hi.x);
  const uint64_t y = cell(a.lo.y, a.hi.y, bounds.lo.y, bounds.hi.y);
  const uint64_t z = cell(a.lo.z, a.hi.z, bounds.lo.z, bounds.hi.z);
  return spread_bits(x) << 2 | spread_bits(y) << 1 | spread_bits(z);
}

// Power of two that holds n leaves; at least two, so that the root, where a traversal ends, is none of them.
inline int32_t padded_leaves(int64_t n) {
  int32_t leaves = 2;
  while (leaves < n) leaves *= 2;
  return leaves;
}

constexpr int32_t kRoot = 1;  // also where a traversal of the whole tree ends

// The node that a traversal from left to right visits after the subtree of node i.
DIFFVBD_FN int32_t next_node(int32_t i) {
  while (i & 1) i /= 2;
  return i + 1;
}

// The first leaf node in a traversal from node i that the query hits, or `end`. Empty leaves are passed over: an
// infinite query is near them, too, because the distance of infinite boxes is not a number.
template <class Hits>
DIFFVBD_FN int32_t find_leaf(const Box* nodes, int32_t leaves, int32_t i, int32_t end, const Hits& hits) {
  do {
    const Box& node = nodes[i];
    const bool hit = hits(node), leaf = i >= leaves;
    if (hit && leaf && !is_empty(node)) return i;
    i = hit && !leaf ? 2 * i : next_node(i);
  } while (i != end);
  return end;
}

// visit(leaf node) for all leaves with hits(box) in a traversal from node i to `end`, until it returns false.
template <class Hits, class Visit>
DIFFVBD_FN void each_leaf(const Box* nodes, int32_t leaves, int32_t i, int32_t end, const Hits& hits,
                          const Visit& visit) {
  do {
    i = find_leaf(nodes, leaves, i, end, hits);
    if (i == end || !visit(i)) return;
    i = next_node(i);
  } while (i != end);
}

}  // namespace diffvbd::contact
