// What of a list can still matter once all vertices are where a part starts: from there each goes no farther than its
// own room in the sweeps, so that most of what a long way has listed is out of reach.
#pragma once

#include "candidates.h"

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

}  // namespace diffvbd::contact
