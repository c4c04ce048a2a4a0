// Updates of a list of pairs: gaps at the start of a substep, and a compact list of the pairs that stay.
#pragma once

#include <cstdint>

#include "detection.h"

namespace diffvbd::contact {

template <class T>
struct GapInputs {
  const T *x, *origin;    // [B, V, 3]; origin may be null
  const T* collider;      // [B, Vc, 3]
  const T* trust_radius;  // [B, V]
  const int32_t* pairs;   // [capacity, 6]
  const T* constants;     // [capacity, 8]
  int32_t vertices, colliders;

  DIFFVBD_FN Vec3<T> corner(int64_t scene, int32_t v) const {
    return v < vertices ? vector_at(x + 3 * (scene * vertices + v))
                        : vector_at(collider + 3 * (scene * colliders + v - vertices));
  }
  DIFFVBD_FN Vec3<T> origin_of(int64_t scene, int32_t v) const {
    return v < vertices && origin ? vector_at(origin + 3 * (scene * vertices + v)) : zero3<T>();
  }
  DIFFVBD_FN T trust_radius_of(int64_t scene, int32_t v) const {
    return v < vertices ? trust_radius[scene * vertices + v] : T(0);
  }
};

// The constants of a pair with its current gap, infinite where neither side can come within reach.
template <class T>
DIFFVBD_FN void refresh_gap(const GapInputs<T>& in, int64_t pair, T* out) {
  const int32_t* record = in.pairs + kPairRow * pair;
  const T* constants = in.constants + kConstants * pair;
  for (int k = 0; k < kConstants; ++k) out[k] = constants[k];
  if (record[4] < 0) return;
  const int64_t scene = record[5];
  const Vec3<T> first = in.corner(scene, record[0]), o = in.origin_of(scene, record[0]);
  Corners<T> c;
  T trust_radius[2] = {T(0), T(0)};
  for (int k = 0; k < 4; ++k) {
    c.x[k] = (in.corner(scene, record[k]) - first) + (in.origin_of(scene, record[k]) - o);
    T& most = trust_radius[k < (record[4] == kEdgeEdge ? 2 : 1) ? 0 : 1];
    const T own = in.trust_radius_of(scene, record[k]);
    most = most < own ? own : most;
  }
  const T gap = separation(record[4], c) - constants[1];
  out[kConstants - 1] =
      gap - trust_radius[0] - trust_radius[1] < constants[0] ? gap : std::numeric_limits<T>::infinity();
}

// A compact list. Pairs keep their order, and so do those of each corner point.

// kept [pairs + 1]: how many pairs before each are kept. Corners: of all scenes.
template <class T>
struct CompactInputs {
  const bool* keep;  // [pairs]
  const int32_t *pairs, *ptr, *entry;
  const T* constants;
  int64_t count, corners;  // pairs that the list has room for; corner points
};
// Of capacity `capacity`.
template <class T>
struct CompactList {
  int64_t* rows;  // [capacity]  which pair of the longer list each is, or -1
  int32_t *pairs, *ptr, *entry;
  T* constants;
  int64_t capacity;
};

// Whether a pair of the list stays; unused rows do not.
template <class T>
DIFFVBD_FN bool stays(const CompactInputs<T>& in, int64_t pair) {
  return pair < in.ptr[in.corners] / 4 && in.keep[pair];
}

template <class T>
DIFFVBD_FN void copy_pair(const CompactInputs<T>& in, int64_t pair, int64_t to, const CompactList<T>& out) {
  out.rows[to] = pair;
  for (int k = 0; k < kPairRow; ++k) out.pairs[kPairRow * to + k] = in.pairs[kPairRow * pair + k];
  for (int k = 0; k < kConstants; ++k) out.constants[kConstants * to + k] = in.constants[kConstants * pair + k];
}

// A row that no pair fills.
template <class T>
DIFFVBD_FN void leave_empty(int64_t row, const CompactList<T>& out) {
  out.rows[row] = -1;
  for (int k = 0; k < kPairRow; ++k) out.pairs[kPairRow * row + k] = -1;
  for (int k = 0; k < kConstants; ++k) out.constants[kConstants * row + k] = T(0);
  for (int k = 0; k < 4; ++k) out.entry[4 * row + k] = -1;
}

// Calls f(entry in the shorter list) for the pairs of a corner point that stay.
template <class T, class F>
DIFFVBD_FN void each_entry(const CompactInputs<T>& in, const int32_t* kept, int64_t corner, const F& f) {
  for (int32_t e = in.ptr[corner]; e < in.ptr[corner + 1]; ++e) {
    const int32_t entry = in.entry[e], pair = entry >> 2;
    if (in.keep[pair]) f(4 * kept[pair] + (entry & 3));
  }
}

}  // namespace diffvbd::contact
