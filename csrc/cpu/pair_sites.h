// Where in a scene's rows the corners of a pair lie: found once for what is near, read in every sweep.
#pragma once

#include <algorithm>
#include <vector>

#include "../contact/passes.h"
#include "scene.h"

namespace diffvbd {

// One entry of a pair: 4 times the position in sweep order of each corner, or, of a corner point of colliders, what
// comes before 0 counted down; kind; the corner whose entry it is.
struct PairSite {
  int32_t at[4];
  uint8_t kind, own;
  uint8_t together;  // corners of its color, itself included (contact/pairs.h)
  bool is_first(int k) const { return k < contact::sides(kind); }
};

// Rows of four scalars of all corner points of a scene: positions, where the part started, and origins.
template <class T>
class PairRows {
 public:
  PairRows(const Plan& plan, const contact::ContactInputs<T>& in, int64_t scene, const int32_t* position, const T* x)
      : in_(in),
        position_(position),
        color_(plan.blocks, -1),
        x_(x),
        center_(4 * int64_t{plan.blocks} * kLanes),
        origin_(in.origin.data ? 4 * int64_t{plan.blocks} * kLanes : 0),
        collider_(4 * (in.corners - in.num_vertices), true),
        zero_(4, true) {
    for (int c = 0; c < plan.colors; ++c) {
      std::fill(color_.begin() + plan.color_block[c], color_.begin() + plan.color_block[c + 1], c);
    }
    for (int v = 0; v < in.num_vertices; ++v) {
      put(center_.get() + 4 * position[v], in.center_of(scene, v));
      if (in.origin.data) {
        put(origin_.get() + 4 * position[v],
            contact::vector_at(in.origin.data + scene * in.origin.scene + int64_t{3} * v));
      }
    }
    for (int64_t i = 0; i < in.corners - in.num_vertices; ++i) {
      put(collider_.get() + 4 * i, contact::vector_at(in.collider.data + scene * in.collider.scene + 3 * i));
    }
  }

  PairSite site(int32_t entry) const {
    const int32_t* record = in_.listed.pairs + int64_t{contact::kPairRow} * (entry >> 2);
    PairSite out;
    for (int k = 0; k < 4; ++k) {
      out.at[k] = record[k] < in_.num_vertices ? 4 * position_[record[k]] : ~(4 * (record[k] - in_.num_vertices));
    }
    out.kind = static_cast<uint8_t>(record[4]), out.own = static_cast<uint8_t>(entry & 3);
    out.together = 1;
    for (int k = 0; k < 4 && out.at[out.own] >= 0; ++k) {
      out.together += k != out.own && record[k] < in_.num_vertices && are_together(record[k], record[out.own]);
    }
    return out;
  }

  // Whether two vertices are of one color.
  bool are_together(int v, int u) const { return color_[position_[v] / kLanes] == color_[position_[u] / kLanes]; }

  const T* x(int32_t at) const { return at < 0 ? collider_.get() + ~at : x_ + at; }
  const T* origin(int32_t at) const {
    if (!origin_.get()) return nullptr;
    return at < 0 ? zero_.get() : origin_.get() + at;
  }
  Vec3<T> moved(int32_t at) const {
    return at < 0 ? zero3<T>() : contact::vector_at(x_ + at) - contact::vector_at(center_.get() + at);
  }
  // As Source::is_far() says of the pair.
  bool is_far(const PairSite& site, const T* constants) const {
    return contact::is_above(
        site.kind, [&](int k) { return moved(site.at[k]); }, constants, contact::PairConstants<T>(constants).dhat);
  }

 private:
  static void put(T* row, const Vec3<T>& a) { row[0] = a.x, row[1] = a.y, row[2] = a.z, row[3] = T(0); }

  const contact::ContactInputs<T>& in_;
  const int32_t* position_;
  std::vector<int32_t> color_;  // of each block, -1 where nothing moves
  const T* x_;
  const Buffer<T> center_, origin_, collider_, zero_;
};

}  // namespace diffvbd
