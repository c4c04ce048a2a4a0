// What is tried at the start of the sweeps, of each vertex or of each body as a whole: inputs, state and the ways.
#pragma once

#include "passes.h"

namespace diffvbd::contact {

template <class T>
struct AdvanceInputs {
  const T *x, *move;                  // [B, V, 3]  at the detection; where each vertex wants to go from there
  const T* u;                         // [B, bodies, 3]  translation of each body's island; or null
  const T* center;                    // [B, V, 3]  from where a vertex has its room, less u
  const T* origin;                    // [B, V, 3] or null
  const T *collider, *collider_next;  // [B, Vc, 3]
  const bool* held;                   // [N]
  const int32_t* body;                // [N]
  PairList listed;
  const T* constants;
  const T* room;                   // [B, V]
  const T *own_center, *own_room;  // the same beside the rigid motion of its body; or null
  int64_t scenes;
  int32_t vertices, corners, bodies;
  bool careful;  // the motion does not minimise the barrier
  bool whole;    // all vertices of a body go the same share

  // What goes a share of its own: vertices, or bodies.
  DIFFVBD_FN int64_t units() const { return scenes * (whole ? bodies : vertices); }
  DIFFVBD_FN int64_t unit(int64_t scene, int32_t v) const {
    return whole ? scene * bodies + body[v] : scene * vertices + v;
  }
  DIFFVBD_FN int64_t scene_of_unit(int64_t unit) const { return unit / (whole ? bodies : vertices); }
};

// How a vertex has moved since the gaps of pairs were taken, and where it would be if it went on as it tries.
template <class T>
struct Motion {
  Vec3<T> since, end;
  T size;  // of its position, which rounding is measured by
};

// What changes while it is worked out, of each unit.
template <class T>
struct AdvanceState {
  T *share, *now;                     // of the whole way after the moves so far; of what is left, tried in this one
  uint8_t *blocked, *stamp;           // something does not let it pass; the round in which it last tried less
  uint8_t* failed;                    // [B]  a scene in which something has found no way
  bool first;                         // the move in which colliders and prescribed vertices go
  const Motion<T>* motion = nullptr;  // [B, V]  in this round; set before pairs are looked at
};

// Written by whoever finds it: all write the same.
DIFFVBD_FN void mark(uint8_t* flag) {
#if defined(__CUDA_ARCH__)
  *flag = 1;
#else
  __atomic_store_n(flag, uint8_t{1}, __ATOMIC_RELAXED);
#endif
}

template <class T>
DIFFVBD_FN Vec3<T> way_of(const AdvanceInputs<T>& in, int64_t scene, int32_t v) {
  const Vec3<T> way = vector_at(in.move + 3 * (scene * in.vertices + v));
  return in.held[v] || !in.u ? way : way - vector_at(in.u + 3 * (scene * in.bodies + in.body[v]));
}

// And the part of it that it tries.
template <class T>
DIFFVBD_FN Vec3<T> way_tried(const AdvanceInputs<T>& in, const AdvanceState<T>& s, int64_t scene, int32_t v) {
  const int64_t unit = in.unit(scene, v);
  const T done = in.held[v] ? T(s.first ? 0 : 1) : s.share[unit];
  return ((T(1) - done) * (in.held[v] ? T(1) : s.now[unit])) * way_of(in, scene, v);
}

// A vertex as it is, relative to `from`, and the way that it tries.
template <class T>
struct Trial {
  Vec3<T> at, from, since, way;
  T size;
};

template <class T>
DIFFVBD_FN T size_of(const Vec3<T>& p) {
  return absolute(p.x) + absolute(p.y) + absolute(p.z);
}

template <class T>
DIFFVBD_FN Trial<T> trial(const AdvanceInputs<T>& in, const AdvanceState<T>& s, int64_t scene, int32_t v) {
  Trial<T> out;
  const int64_t row = scene * in.vertices + v;
  const Vec3<T> whole = way_of(in, scene, v);
  const int64_t unit = in.unit(scene, v);
  const T done = in.held[v] ? T(s.first ? 0 : 1) : s.share[unit];
  out.at = vector_at(in.x + 3 * row) + done * whole;
  out.since = out.at - vector_at(in.center + 3 * row);
  out.from = in.origin ? vector_at(in.origin + 3 * row) : zero3<T>();
  out.way = way_tried(in, s, scene, v);
  out.size = size_of(out.at + out.from);
  return out;
}
template <class T>
DIFFVBD_FN Motion<T> motion_of(const AdvanceInputs<T>& in, const AdvanceState<T>& s, int64_t scene, int32_t v) {
  const Trial<T> t = trial(in, s, scene, v);
  return {t.since, t.since + t.way, t.size};
}
// That of a corner of a pair that is a vertex.
template <class T>
DIFFVBD_FN Motion<T> motion_at(const AdvanceInputs<T>& in, const AdvanceState<T>& s, const int32_t* pair, int k) {
  return s.motion[int64_t{pair[5]} * in.vertices + pair[k]];
}

template <class T>
DIFFVBD_FN T guard_of_size(T size) {
  return T(kGuardUlps) * std::numeric_limits<T>::epsilon() * size;
}

}  // namespace diffvbd::contact
