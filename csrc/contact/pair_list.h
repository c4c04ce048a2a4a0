// The part of a list of pairs that can matter within the trust regions of its corners, with current gaps.
#pragma once

#include <cstdint>

#include "detection.h"

namespace diffvbd::contact {

constexpr double kWithin = 1 + 1e-3;  // times dhat: pairs with so much more gap do not push, however it is rounded

template <class T>
struct NearInputs {
  const T *x, *origin;  // [B, V, 3]; origin may be null
  const T* collider;    // [B, Vc, 3]
  // Of the trust region of each vertex [B, V, 3] and [B, V], and of its deformation, or null.
  const T *center, *own_center, *trust_radius, *own_radius;
  const bool* pinned;                  // [V], where nothing is left of a radius
  const int32_t *pairs, *ptr, *entry;  // as Detected has them
  const T* constants;
  int64_t count, corners;  // pairs that the list has room for; corner points of all scenes
  int32_t vertices, colliders;

  DIFFVBD_FN Vec3<T> corner(int64_t scene, int32_t v) const {
    return v < vertices ? vector_at(x + 3 * (scene * vertices + v))
                        : vector_at(collider + 3 * (scene * colliders + v - vertices));
  }
  DIFFVBD_FN Vec3<T> origin_of(int64_t scene, int32_t v) const {
    return v < vertices && origin ? vector_at(origin + 3 * (scene * vertices + v)) : zero3<T>();
  }
  // What is left of the radii of a vertex.
  DIFFVBD_FN T radius_left(int64_t scene, int32_t v) const {
    if (vertices <= v || pinned[v]) return T(0);
    const int64_t row = scene * vertices + v;
    const auto left = [&](const T* radius, const T* middle) {
      const Vec3<T> off = vector_at(x + 3 * row) - vector_at(middle + 3 * row);
      return radius[row] - square_root(dot(off, off));
    };
    T most = left(trust_radius, center);
    if (own_radius) {
      const T own = left(own_radius, own_center);
      most = own < most ? own : most;
    }
    return T(0) < most ? most : T(0);
  }
};

// How far apart the boxes of two sides are along an axis: their distance is no smaller.
template <class T>
DIFFVBD_FN T box_gap(int kind, const Corners<T>& c) {
  T most = T(0);
  const auto along = [&](const auto& get) {
    T lo[2], hi[2];
    for (int k = 0; k < 4; ++k) {
      const int side = k < (kind == kEdgeEdge ? 2 : 1) ? 0 : 1;
      const bool first = k == 0 || k == (kind == kEdgeEdge ? 2 : 1);
      const T at = get(c.x[k]);
      lo[side] = first || at < lo[side] ? at : lo[side], hi[side] = first || hi[side] < at ? at : hi[side];
    }
    const T gap = lo[0] - hi[1] < lo[1] - hi[0] ? lo[1] - hi[0] : lo[0] - hi[1];
    most = most < gap ? gap : most;
  };
  along([](const Vec3<T>& p) { return p.x; });
  along([](const Vec3<T>& p) { return p.y; });
  along([](const Vec3<T>& p) { return p.z; });
  return most;
}

// The current gap of a pair, infinite where its sides stay out of reach, and in rows that no pair fills.
// left(scene, corner): radius_left().
template <class T, class Left>
DIFFVBD_FN T near_gap(const NearInputs<T>& in, int64_t pair, const Left& left) {
  constexpr T kFar = std::numeric_limits<T>::infinity();
  const int32_t* record = in.pairs + kPairRow * pair;
  const T* constants = in.constants + kConstants * pair;
  if (in.ptr[in.corners] / 4 <= pair || record[4] < 0) return kFar;
  const int64_t scene = record[5];
  const Vec3<T> first = in.corner(scene, record[0]), o = in.origin_of(scene, record[0]);
  Corners<T> c;
  T radius[2] = {T(0), T(0)};
  for (int k = 0; k < 4; ++k) {
    c.x[k] = (in.corner(scene, record[k]) - first) + (in.origin_of(scene, record[k]) - o);
    T& most = radius[k < (record[4] == kEdgeEdge ? 2 : 1) ? 0 : 1];
    const T own = left(scene, record[k]);
    most = most < own ? own : most;
  }
  const T reach = T(kWithin) * constants[0] + constants[1] + radius[0] + radius[1];
  if (record[4] != kPointPlane && reach < box_gap(record[4], c)) return kFar;  // as most are, if radii are small
  const T distance = separation(record[4], c);
  return distance < reach ? distance - constants[1] : kFar;
}
template <class T>
DIFFVBD_FN bool is_near(T gap) {
  return gap < std::numeric_limits<T>::infinity();
}

// The pairs that are near, of capacity `capacity`. Pairs keep their order, and so do those of each corner point.
template <class T>
struct NearList {
  int64_t* rows;  // [capacity]  which pair of the longer list each is, or -1
  int32_t *pairs, *ptr, *entry;
  T* constants;
  int64_t capacity;
};

template <class T>
DIFFVBD_FN void copy_pair(const NearInputs<T>& in, int64_t pair, T gap, int64_t to, const NearList<T>& out) {
  out.rows[to] = pair;
  for (int k = 0; k < kPairRow; ++k) out.pairs[kPairRow * to + k] = in.pairs[kPairRow * pair + k];
  for (int k = 0; k + 1 < kConstants; ++k) out.constants[kConstants * to + k] = in.constants[kConstants * pair + k];
  out.constants[kConstants * to + kConstants - 1] = gap;
}

// A row that no pair fills.
template <class T>
DIFFVBD_FN void leave_empty(int64_t row, const NearList<T>& out) {
  out.rows[row] = -1;
  for (int k = 0; k < kPairRow; ++k) out.pairs[kPairRow * row + k] = -1;
  for (int k = 0; k < kConstants; ++k) out.constants[kConstants * row + k] = T(0);
  for (int k = 0; k < 4; ++k) out.entry[4 * row + k] = -1;
}

}  // namespace diffvbd::contact
