// How far the sweeps of a part may carry a vertex from where they find it: what the part has wanted of the bodies of
// its scene, within what is left of the rooms that pairs were found for.
#pragma once

#include <cstdint>

#include "passes.h"

namespace diffvbd::contact {

template <class T>
struct SweepRoomInputs {
  const T *x, *start, *begin, *move, *fall;  // [B, V, 3] [m]: where the sweeps begin, where the start of the part led,
                                             // where the part began, and what it wanted of a vertex
  const T *apart, *stretched;                // [B, bodies] [m]
  const T *center, *room;                    // [B, V, 3], [B, V] [m]
  const T *own_center, *own_room;  // the same beside the rigid motion of a body; null without pairs of its own
  const bool* held;                // [V]
  const int32_t *order, *ptr;      // [V], [bodies + 1]
  int64_t scenes, vertices, bodies;
  T more, least;  // factor of what sweeps take back, and what they are given beside that [m]
};

// Squares of the longest ways: what pairs have held up, what a correction has moved, and falls.
template <class T>
struct SweepWays {
  T held_up, corrected, fallen;
  DIFFVBD_FN void keep(const SweepWays& other) {
    held_up = larger(held_up, other.held_up), corrected = larger(corrected, other.corrected);
    fallen = larger(fallen, other.fallen);
  }
};

// Of every `stride`-th vertex of a body from `first` on.
template <class T>
DIFFVBD_FN SweepWays<T> ways_of_body(const SweepRoomInputs<T>& in, int64_t scene, int64_t body, int32_t first,
                                     int32_t stride) {
  SweepWays<T> out{T(0), T(0), T(0)};
  for (int64_t k = int64_t{in.ptr[body]} + first; k < in.ptr[body + 1]; k += stride) {
    const int32_t v = in.order[k];
    if (in.held[v]) continue;
    const int64_t i = scene * in.vertices + v;
    const Vec3<T> start = vector_at(in.start + 3 * i), fall = vector_at(in.fall + 3 * i);
    const Vec3<T> left = vector_at(in.begin + 3 * i) + vector_at(in.move + 3 * i) + fall - start,
                  way = vector_at(in.x + 3 * i) - start;
    out.keep({dot(left, left), dot(way, way), dot(fall, fall)});
  }
  return out;
}

template <class T>
DIFFVBD_FN T wish_of_body(const SweepRoomInputs<T>& in, const SweepWays<T>& ways, int64_t row) {
  return square_root(ways.fallen) + in.apart[row] + in.more * square_root(ways.held_up) + square_root(ways.corrected) +
         in.more * in.stretched[row];
}

// The most of every `stride`-th body of a scene: bodies push one another.
template <class T>
DIFFVBD_FN T most_of_scene(const SweepRoomInputs<T>& in, const T* wishes, int64_t scene, int32_t first,
                           int32_t stride) {
  T out = T(0);
  for (int64_t body = first; body < in.bodies; body += stride) out = larger(out, wishes[scene * in.bodies + body]);
  return out;
}

// Of one vertex, where `most` is that of its scene.
template <class T>
DIFFVBD_FN T sweep_room(const SweepRoomInputs<T>& in, T most, int64_t scene, int64_t v) {
  if (in.held[v]) return T(0);
  const int64_t i = scene * in.vertices + v;
  const Vec3<T> x = vector_at(in.x + 3 * i), way = x - vector_at(in.center + 3 * i);
  T room = smaller(in.room[i] - square_root(dot(way, way)), in.least + most);
  if (in.own_room) {
    const Vec3<T> own = x - vector_at(in.own_center + 3 * i);
    room = smaller(room, in.own_room[i] - square_root(dot(own, own)));
  }
  return room < T(0) ? T(0) : room;
}

}  // namespace diffvbd::contact
