// What of a list can still matter once all vertices are where a part starts: from there each goes no farther than its
// own room in the sweeps, so that most of what a long way has listed is out of reach.
#pragma once

#include <cstdint>

#include "detection.h"

namespace diffvbd::contact {

template <class T>
struct NarrowInputs {
  const T *x, *origin;   // [B, V, 3]; origin may be null
  const T* collider;     // [B, Vc, 3]
  const T* room;         // [B, V]
  const int32_t* pairs;  // [capacity, 6]
  const T* constants;    // [capacity, 8]
  int32_t vertices, colliders;

  DIFFVBD_FN Vec3<T> corner(int64_t scene, int32_t v) const {
    return v < vertices ? point_at(x, scene * vertices + v) : point_at(collider, scene * colliders + v - vertices);
  }
  DIFFVBD_FN Vec3<T> origin_of(int64_t scene, int32_t v) const {
    return v < vertices && origin ? point_at(origin, scene * vertices + v) : zero3<T>();
  }
  DIFFVBD_FN T room_of(int64_t scene, int32_t v) const { return v < vertices ? room[scene * vertices + v] : T(0); }
};

// The constants of a pair with its gap as it is now, infinite where neither side can come within reach.
template <class T>
DIFFVBD_FN void narrow_pair(const NarrowInputs<T>& in, int64_t pair, T* out) {
  const int32_t* record = in.pairs + kPairRow * pair;
  const T* constants = in.constants + kConstants * pair;
  for (int k = 0; k < kConstants; ++k) out[k] = constants[k];
  if (record[4] < 0) return;
  const int64_t scene = record[5];
  const Vec3<T> first = in.corner(scene, record[0]), o = in.origin_of(scene, record[0]);
  Corners<T> c;
  T room[2] = {T(0), T(0)};
  for (int k = 0; k < 4; ++k) {
    c.x[k] = (in.corner(scene, record[k]) - first) + (in.origin_of(scene, record[k]) - o);
    T& most = room[k < (record[4] == kEdgeEdge ? 2 : 1) ? 0 : 1];
    const T own = in.room_of(scene, record[k]);
    most = most < own ? own : most;
  }
  const T gap = separation(record[4], c) - constants[1];
  out[kConstants - 1] = gap - room[0] - room[1] < constants[0] ? gap : std::numeric_limits<T>::infinity();
}

// A part of a list of pairs: the same lists, shorter. Pairs keep their order, and so do those of each corner point.

// kept [pairs + 1]: how many pairs before each are kept. Corners: of all scenes.
template <class T>
struct KeepInputs {
  const bool* keep;  // [pairs]
  const int32_t *pairs, *ptr, *entry;
  const T* constants;
  int64_t count, corners;  // pairs that the list has room for; corner points
};
// Room for `capacity` pairs.
template <class T>
struct Kept {
  int64_t* rows;  // [capacity]  which pair of the longer list each is, or -1
  int32_t *pairs, *ptr, *entry;
  T* constants;
  int64_t capacity;
};

// Whether a pair of the list stays; what the list has room for beyond its pairs does not.
template <class T>
DIFFVBD_FN bool stays(const KeepInputs<T>& in, int64_t pair) {
  return pair < in.ptr[in.corners] / 4 && in.keep[pair];
}

template <class T>
DIFFVBD_FN void copy_pair(const KeepInputs<T>& in, int64_t pair, int64_t to, const Kept<T>& out) {
  out.rows[to] = pair;
  for (int k = 0; k < kPairRow; ++k) out.pairs[kPairRow * to + k] = in.pairs[kPairRow * pair + k];
  for (int k = 0; k < kConstants; ++k) out.constants[kConstants * to + k] = in.constants[kConstants * pair + k];
}

// A row that no pair fills.
template <class T>
DIFFVBD_FN void leave_empty(int64_t row, const Kept<T>& out) {
  out.rows[row] = -1;
  for (int k = 0; k < kPairRow; ++k) out.pairs[kPairRow * row + k] = -1;
  for (int k = 0; k < kConstants; ++k) out.constants[kConstants * row + k] = T(0);
  for (int k = 0; k < 4; ++k) out.entry[4 * row + k] = -1;
}

// Calls f(entry in the shorter list) for the pairs of a corner point that stay.
template <class T, class F>
DIFFVBD_FN void each_entry(const KeepInputs<T>& in, const int32_t* kept, int64_t corner, const F& f) {
  for (int32_t e = in.ptr[corner]; e < in.ptr[corner + 1]; ++e) {
    const int32_t entry = in.entry[e], pair = entry >> 2;
    if (in.keep[pair]) f(4 * kept[pair] + (entry & 3));
  }
}

}  // namespace diffvbd::contact
