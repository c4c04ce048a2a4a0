// How far the bodies of a scene may go until pairs are found again: what CPU and CUDA share. Islands depend on the
// rooms, and the rooms on what an island leaves of a motion, hence in passes: from ways to rooms and islands, then some
// rounds of rooms beside these and islands (docs/method.md, section 12). Index data, without gradient.
#pragma once

#include <cstdint>

#include "above_floor.h"
#include "islands.h"
#include "motion.h"
#include "passes.h"

namespace diffvbd::contact {

constexpr int kRoomRounds = 3;  // of rooms beside islands, and islands with these: whom one meets gets room as well
constexpr double kSpare = 2;    // of dhat, that a body gets beside what it asks for: others may push it

template <class T>
struct RoomInputs {
  MotionInputs<T> motion;
  IslandInputs<T> islands;                            // but for its room
  const T *rigid, *ways, *sums;                       // of find_motion
  Batched<const T> floor;                             // [1 | B, 7 planes] or null
  const T *most, *most_alone, *most_own, *least_own;  // [bodies] [m] rooms of a body: see ContactSurface
  int32_t floor_planes;
  T share, least, dhat;  // of a way that its room is, and beside that [m]
  bool self_contact;

  DIFFVBD_FN int32_t planes() const { return islands.num_planes + floor_planes; }
  DIFFVBD_FN T way(Way which, int64_t place) const { return ways[which * motion.scenes * motion.bodies + place]; }
};

// What the passes hand on. Rooms with a last column, the largest of the scene.
template <class T>
struct RoomWork {
  T *planes, *pushed;         // [B, planes, 7]; [B]: the longest way of a collider's point
  T *stopped, *bent, *most;   // [B, bodies]
  int32_t* island;            // [B, bodies]
  T *room, *own_room, *over;  // [B, bodies + 1] twice, [B, bodies]: results
};

// Plane colliders, then the planes of the floor, as the floor has them.
template <class T>
DIFFVBD_FN void write_plane(const RoomInputs<T>& in, int64_t scene, int32_t k, T* to) {
  const int32_t colliders = in.islands.num_planes;
  if (k >= colliders) {
    const T* from = in.floor.data + scene * in.floor.scene + kPlaneScalars * (k - colliders);
    for (int i = 0; i < kPlaneScalars; ++i) to[i] = from[i];
    return;
  }
  const auto at = [&](int corner) {
    const int64_t point = in.islands.planes[3 * k + corner] - in.islands.vertices;
    return MovingBody<T>::vector(in.islands.collider_next + 3 * (scene * in.islands.colliders() + point));
  };
  const Vector a = at(0), across = cross(at(1) - a, at(2) - a);
  const Vector n = (1 / larger(length(across), double(std::numeric_limits<T>::min()))) * across;
  to[0] = T(n.x), to[1] = T(n.y), to[2] = T(n.z), to[3] = T(dot(n, a));
  to[4] = T(0), to[5] = in.dhat, to[6] = T(0);
}

template <class T, class Team>
DIFFVBD_FN void prepare_scene(const RoomInputs<T>& in, int64_t scene, const Team& team, const RoomWork<T>& work) {
  const int32_t planes = in.planes(), points = in.islands.colliders();
  team.each(planes, [&](int32_t k) { write_plane(in, scene, k, work.planes + kPlaneScalars * (scene * planes + k)); });
  double pushed[1];
  team.template most<1>(points, pushed, [&](int32_t j, double* of) {
    const int64_t row = 3 * (scene * points + j);
    of[0] = length(MovingBody<T>::vector(in.islands.collider_next + row) -
                   MovingBody<T>::vector(in.islands.collider + row));
  });
  if (team.leads()) work.pushed[scene] = T(pushed[0]);
}

// What a body asks for that goes so far beside what its island does.
template <class T>
DIFFVBD_FN T asked(const RoomInputs<T>& in, const RoomWork<T>& work, int64_t place, T beside) {
  // the sweeps may take back all that the start has let fall and bent
  const T falls = T(2) * in.way(kFalls, place) + in.least;
  return in.share * beside + in.way(kBends, place) + falls + work.stopped[place];
}
// And what it gets. What is prescribed goes where it goes: pairs with it are listed however far that is.
template <class T>
DIFFVBD_FN T room_of(const RoomInputs<T>& in, const RoomWork<T>& work, int64_t place, T beside, T most) {
  const T wished = asked(in, work, place, beside) + T(kSpare) * in.dhat;
  const T room = larger(smaller(wished, most), in.way(kDriven, place));
  return room + work.pushed[place / in.motion.bodies];
}
template <class T>
DIFFVBD_FN T& room_at(const RoomInputs<T>& in, T* rooms, int64_t scene, int32_t body) {
  return rooms[scene * (in.motion.bodies + 1) + body];
}

// How far planes stop a body, which is left to the sweeps: they press and bend it. And the room that it wishes for
// where it meets nothing.
template <class T, class Team>
DIFFVBD_FN void wish_of_body(const RoomInputs<T>& in, const MovingBody<T>& b, const Team& team,
                             const RoomWork<T>& work) {
  const int32_t planes = in.planes();
  double far[2] = {0, in.way(kApart, b.place())};
  if (planes > 0) {
    const T* own = work.planes + kPlaneScalars * (b.scene * planes);
    const auto at = [&](int32_t i) { return b.position(i); };
    const auto rigid = [&](int32_t i) { return b.of(in.rigid, i); };
    const auto way = [&](int32_t i) { return b.way(i); };
    const auto counts = [&](int32_t i) { return b.is_free(i); };
    const AboveFloor free = above_floor(team, b.size(), own, planes, at, way, counts);
    const AboveFloor whole = above_floor(team, b.size(), own, planes, at, rigid, counts);
    team.template most<2>(b.size(), far, [&](int32_t i, double* of) {
      of[0] = b.is_free(i) ? length(b.way(i) - free.left(b.way(i))) : 0.0;
      of[1] = b.is_free(i) ? length(b.way(i) - whole.left(rigid(i))) : 0.0;
    });
  }
  if (!team.leads()) return;
  const int64_t place = b.place();
  work.stopped[place] = smaller(T(far[0]), in.most_own[b.body]);
  work.bent[place] = T(far[1]);
  const T bends = in.way(kBends, place);
  room_at(in, work.room, b.scene, b.body) = room_of(in, work, place, bends, in.most_alone[b.body]);
}

// Whether a body asks for more than it gets among others.
template <class T>
DIFFVBD_FN bool asks_more(const RoomInputs<T>& in, const RoomWork<T>& work, int64_t scene, int32_t body) {
  const int64_t place = scene * in.motion.bodies + body;
  const T asks = asked(in, work, place, in.way(kBends, place)) + in.share * in.way(kStretched, place);
  return !(asks <= in.most[body]);
}

// A body that meets nothing in a larger room has it: it costs no pairs.
template <class T>
DIFFVBD_FN void room_among_others(const RoomInputs<T>& in, const RoomWork<T>& work, int64_t scene, int32_t body,
                                  bool looked) {
  const int32_t* island = work.island + scene * in.motion.bodies;
  const int64_t place = scene * in.motion.bodies + body;
  bool alone = looked && island[body] >= 0;
  for (int32_t b = 0; b < in.motion.bodies && alone; ++b) alone = b == body || island[b] != island[body];
  work.most[place] = alone ? in.most_alone[body] : in.most[body];
  room_at(in, work.room, scene, body) = room_of(in, work, place, in.way(kBends, place), work.most[place]);
}

// With an island that moves along, the room beside that.
template <class T, class Team>
DIFFVBD_FN void room_beside_island(const RoomInputs<T>& in, const MovingBody<T>& b, const Team& team,
                                   const RoomWork<T>& work) {
  const int64_t place = b.place(), first = b.scene * in.motion.bodies;
  const int32_t own = work.island[place];
  double sum[4], far[1];
  team.template sum<4>(own < 0 ? 0 : in.motion.bodies, sum, [&](int32_t k, double* to) {
    if (work.island[first + k] != own) return;
    for (int i = 0; i < 4; ++i) to[i] += in.sums[4 * (first + k) + i];
  });
  const Vector u = (1 / larger(sum[3], double(std::numeric_limits<T>::min()))) * Vector{sum[0], sum[1], sum[2]};
  team.template most<1>(b.size(), far,
                        [&](int32_t i, double* of) { of[0] = b.is_free(i) ? length(b.way(i) - u) : 0.0; });
  if (!team.leads()) return;
  const T beside = T(far[0]), stretched = in.way(kStretched, place), most = work.most[place];
  T& room = room_at(in, work.room, b.scene, b.body);
  room = larger(room, room_of(in, work, place, beside, most));
  const T way = beside + in.share * stretched, wanted = asked(in, work, place, beside) + in.share * stretched;
  // up to 2, which makes two parts; a longer way more
  work.over[place] = larger(way / most, smaller(wanted / most, T(2)));
  T own_room = T(0);
  if (in.self_contact) {
    own_room = (in.share + T(1)) * (work.bent[place] + stretched) + T(2) * in.way(kFalls, place) + in.least;
    own_room = larger(smaller(own_room, in.most_own[b.body]), smaller(room, in.least_own[b.body]));
    own_room = larger(own_room, in.way(kDriven, place));
  }
  room_at(in, work.own_room, b.scene, b.body) = own_room;
}

// The end: no collider can push what belongs to an island that none comes near. Then the last column of both rooms.
template <class T, class Team>
DIFFVBD_FN void end_rooms(const RoomInputs<T>& in, int64_t scene, const Team& team, const RoomWork<T>& work) {
  double most[2];
  team.template most<2>(in.motion.bodies, most, [&](int32_t k, double* of) {
    T& room = room_at(in, work.room, scene, k);
    if (0 <= work.island[scene * in.motion.bodies + k]) room -= work.pushed[scene];
    of[0] = room, of[1] = room_at(in, work.own_room, scene, k);
  });
  if (!team.leads()) return;
  room_at(in, work.room, scene, in.motion.bodies) = T(most[0]);
  room_at(in, work.own_room, scene, in.motion.bodies) = T(most[1]);
}

// How far the sweeps of a part may carry a vertex from where they find it: what the part has wanted of the bodies of
// its scene, within what is left of the rooms that pairs were found for.

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
