// Where a part of a step starts, with the adjoint: each vertex goes with its island, with its body as a whole, toward
// its wish and then with its fall, of all but the first the share that has been decided. Of a wish and of a fall the
// floor takes what would come too close (docs/method.md, section 12).
#pragma once

#include "../energies/floor_start.h"
#include "../sweep/body.h"
#include "above_floor.h"
#include "passes.h"

namespace diffvbd::contact {

template <class T>
struct StartInputs {
  rigid::Inputs<T> scene;          // x, origin and the vertices of all bodies
  const T *move, *fall;            // [B, V, 3]  where each vertex wants to go from x, and then
  const T* u;                      // [B, bodies, 3]  translation of each body's island
  const T* left;                   // [B, V, 3]  what a floor leaves of the way of its body beside that
  const T* frames;                 // [B, bodies]  share of that
  const T *share, *last_share;     // [B, V]  of the way toward the wish, and of the fall
  Batched<const T> floor;          // [1 | B, data of the planes], or null
  const bool *held, *held_bodies;  // [V], [bodies]  these go where they are put; bodies of which something is
  const int32_t* body;             // [V]
  int32_t floor_scalars;
  StepParameters<T> parameters;

  DIFFVBD_FN int64_t row(int64_t scene_index, int32_t v) const { return scene_index * scene.vertices + v; }
  DIFFVBD_FN int64_t body_row(int64_t scene_index, int32_t v) const { return scene_index * scene.bodies + body[v]; }
  DIFFVBD_FN const T* planes(int64_t scene_index) const { return floor.data + scene_index * floor.scene; }
  DIFFVBD_FN VertexState<T> state(const Vec3<T>& x, int64_t scene_index, int32_t v) const {
    const Batched<const T>& o = scene.origin;
    return {x, x, o.data ? vector_at(o.data + scene_index * o.scene + 3 * int64_t{v}) : zero3<T>(),
            parameters.time_step};
  }
  DIFFVBD_FN bool is_free(int32_t v) const { return floor.data == nullptr || held[v]; }  // of a floor
};

template <class T>
DIFFVBD_FN void store(T* to, const Vec3<T>& a) {
  to[0] = a.x, to[1] = a.y, to[2] = a.z;
}

// The way of one vertex, as far as its shares are known.
template <class T>
struct StartPath {
  const StartInputs<T>& in;
  int64_t scene;
  int32_t v;
  int64_t row = in.row(scene, v), body = in.body_row(scene, v);

  DIFFVBD_FN Vec3<T> x() const { return vector_at(in.scene.x + 3 * row); }
  DIFFVBD_FN Vec3<T> move() const { return vector_at(in.move + 3 * row); }
  DIFFVBD_FN Vec3<T> fall() const { return vector_at(in.fall + 3 * row); }
  DIFFVBD_FN Vec3<T> u() const { return vector_at(in.u + 3 * body); }
  // From `from`, which a floor takes it to have reached.
  DIFFVBD_FN Vec3<T> filtered(const Vec3<T>& from, const Vec3<T>& way) const {
    return from + FloorStart::moved(in.state(from, scene, v), in.planes(scene), in.floor_scalars, way, in.parameters);
  }
  DIFFVBD_FN Vec3<T> target() const { return in.is_free(v) ? x() + move() : filtered(x() + u(), move() - u()); }
  DIFFVBD_FN Vec3<T> base(const Vec3<T>& target) const {
    return in.held[v] ? target : x() + u() + in.frames[body] * vector_at(in.left + 3 * row);
  }
  DIFFVBD_FN Vec3<T> at(const Vec3<T>& target, T share) const {
    const Vec3<T> from = base(target);
    return in.held[v] ? target : from + share * (target - from);
  }
  DIFFVBD_FN Vec3<T> last_target(const Vec3<T>& at) const { return in.is_free(v) ? at + fall() : filtered(at, fall()); }
  DIFFVBD_FN Vec3<T> end() const {
    const Vec3<T> from = at(target(), in.share[row]), to = last_target(from);
    return in.held[v] ? to : from + in.last_share[row] * (to - from);
  }
};

template <class T>
struct StartAdjoints {
  const T* end;                   // of the output
  T *x, *move, *fall, *u, *left;  // [B, V, 3] each, u for each vertex
  T* floor;                       // [B, V, floor_scalars], or null where not wanted
};

template <class T>
DIFFVBD_FN void reverse_start(const StartInputs<T>& in, const StartAdjoints<T>& a, int64_t scene, int32_t v) {
  const StartPath<T> path{in, scene, v};
  T* floor_bar = a.floor ? a.floor + path.row * in.floor_scalars : nullptr;
  for (int k = 0; floor_bar && k < in.floor_scalars; ++k) floor_bar[k] = T(0);
  // bar: of where a filtered way leads on entry, of the way on return; what the state receives
  const auto reverse_filtered = [&](const Vec3<T>& from, const Vec3<T>& way, Vec3<T>& bar) {
    Vec3<T> from_bar = bar;
    if (!in.is_free(v)) {
      FloorStart::moved_vjp(in.state(from, scene, v), in.planes(scene), in.floor_scalars, way, in.parameters, bar,
                            from_bar, floor_bar);
    }
    return from_bar;
  };
  const bool held = in.held[v];
  const T last = held ? T(1) : in.last_share[path.row], share = held ? T(1) : in.share[path.row];
  const Vec3<T> end_bar = vector_at(a.end + 3 * path.row), at = path.at(path.target(), share);
  Vec3<T> fall_bar = last * end_bar, at_bar = reverse_filtered(at, path.fall(), fall_bar);
  if (!held) at_bar += (T(1) - last) * end_bar;
  const Vec3<T> base_bar = held ? zero3<T>() : (T(1) - share) * at_bar;
  Vec3<T> move_bar = share * at_bar;
  const Vec3<T> start_bar = reverse_filtered(path.x() + path.u(), path.move() - path.u(), move_bar);
  store(a.x + 3 * path.row, start_bar + base_bar);
  store(a.move + 3 * path.row, move_bar);
  store(a.fall + 3 * path.row, fall_bar);
  store(a.u + 3 * path.row, start_bar - move_bar + base_bar);
  store(a.left + 3 * path.row, in.frames[path.body] * base_bar);
}

// What is decided at the start of a part, between the questions how far bodies and vertices may go at once
// (contact/advance.h) and whether a way raises the potential of a body: which bodies go a way of their own at all. None
// of it is differentiated; docs/method.md, section 12. What acts on bodies is called with a body and its team, what
// acts on vertices with a scene and a vertex.

constexpr double kBent = 0.1;      // share of the room of its own that a body may bend by, whatever its potential does
constexpr double kDeepBent = 0.5;  // the same of a body that planes or pairs hold up, even where its potential falls

// Of a vertex and its own way. What asks rests, unless it is told that its body's potential does not rise.
enum Resting : uint8_t { kGoes, kRests, kAsks };

// The largest share s of a rigid motion, at most 1, with s way + s^2 stretch <= room: so sweeps have the room to take
// back what the straight ways of a turn stretch a body by [m].
DIFFVBD_FN double share_within(double way, double stretch, double room, double tiny) {
  const double sum = way + square_root(way * way + 4 * stretch * room), share = 2 * room / (sum < tiny ? tiny : sum);
  return 1 < share ? 1 : share;  // or no number
}

// The ways of bodies as wholes, as far as rooms let them go.
template <class T>
struct Frames {
  StartInputs<T> in;
  const T* way;              // [B, V, 3]  of the rigid motions of bodies
  const T* stretch;          // [B, bodies]  by how much a straight way stretches a body [m]
  const T *room, *own_room;  // [B, bodies + 1]; the latter, beside the way, may be null
  T* limit;                  // [B, bodies]  share of that way beside u
  T *ways, *center;          // [B, V, 3]
  T *rooms, *own_rooms;      // [B, V]

  template <class Team>
  DIFFVBD_FN void operator()(const rigid::Body<T>& b, const Team& team) const {
    const double infinity = std::numeric_limits<double>::infinity(), tiny = std::numeric_limits<T>::min();
    const int64_t index = b.scene * b.in.bodies + b.body, place = index + b.scene;
    const Vec3<T> u = vector_at(in.u + 3 * index);
    const double square = most(team, b.size(), [&](int32_t i) {
      const int32_t v = b.vertex(i);
      const Vec3<T> beside = vector_at(way + 3 * b.row(v)) - u;
      const double own = in.held[v] ? 0 : double(dot(beside, beside));
      return own < infinity ? own : infinity;
    });
    const double longest = 0 < square ? square_root(square) : 0;
    double share = share_within(longest, stretch[index], room[place], tiny);
    if (own_room) share = smaller(share, share_within(0, stretch[index], own_room[place], tiny));
    if (!(longest < infinity)) share = std::numeric_limits<double>::quiet_NaN();  // as is such a way
    if (team.leads()) limit[index] = T(share);
    team.each(b.size(), [&](int32_t i) {
      const int32_t v = b.vertex(i);
      const int64_t row = b.row(v);
      const Vec3<T> x = vector_at(in.scene.x + 3 * row);
      store(ways + 3 * row, in.held[v] ? vector_at(in.move + 3 * row) : u + T(share) * vector_at(in.left + 3 * row));
      store(center + 3 * row, in.held[v] ? x : x + u);
      rooms[row] = room[place];
      if (own_room) own_rooms[row] = own_room[place];
    });
  }
};

// Where bodies have come as wholes, and the way from there to the wish of each vertex.
template <class T>
struct Wishes {
  StartInputs<T> in;
  T *base, *target, *way;  // [B, V, 3]

  DIFFVBD_FN void operator()(int64_t scene, int32_t v) const {
    const StartPath<T> path{in, scene, v};
    const Vec3<T> to = path.target(), from = path.base(to);
    store(base + 3 * path.row, from);
    store(target + 3 * path.row, to);
    store(way + 3 * path.row, to - from);
  }
};

// Which of these ways bend a free body: what a floor stops, or rooms hold back, does not go its own, nor does what is
// bent deeply while it is held up; with self-contact what else is bent asks.
template <class T>
struct Bends {
  StartInputs<T> in;
  const T *limit, *own_room;  // [B, bodies], and [B, bodies + 1] or null
  const bool* stopped;        // [B, bodies]
  T* way;                     // [B, V, 3]  of which those that rest lose theirs
  uint8_t* state;             // [B, V]

  template <class Team>
  DIFFVBD_FN void operator()(const rigid::Body<T>& b, const Team& team) const {
    const int64_t index = b.scene * b.in.bodies + b.body;
    const bool free = !in.held_bodies[b.body], up = stopped[index] || in.frames[index] < T(kShort);
    bool rests = free && (stopped[index] || limit[index] < T(kShort)), asks = false;
    if (own_room && free) {
      const double room = own_room[index + b.scene];
      const double square = most(team, b.size(), [&](int32_t i) {
        const Vec3<T> own = vector_at(way + 3 * b.row(b.vertex(i)));
        const double size = dot(own, own);
        return 0 < size ? size : 0;  // what is no number bends nothing
      });
      rests = rests || (up && (kDeepBent * room) * (kDeepBent * room) < square);
      asks = (kBent * room) * (kBent * room) < square;
    }
    team.each(b.size(), [&](int32_t i) {
      const int64_t row = b.row(b.vertex(i));
      state[row] = rests ? kRests : asks ? kAsks : kGoes;
      if (rests) store(way + 3 * row, zero3<T>());
    });
  }
};

// The answer to those that ask.
template <class T>
struct Holds {
  StartInputs<T> in;
  const T* way;          // [B, V, 3]
  const uint8_t* state;  // [B, V]
  const bool* rises;     // [B, V]
  T* way_out;
  uint8_t* state_out;

  DIFFVBD_FN void operator()(int64_t scene, int32_t v) const {
    const int64_t row = in.row(scene, v);
    const bool asks = state[row] == kAsks, held = asks && rises[row];
    state_out[row] = asks && !held ? uint8_t{kGoes} : state[row];
    store(way_out + 3 * row, held ? zero3<T>() : vector_at(way + 3 * row));
  }
};

// Which free bodies pairs have bent, that hold some of it up: these ask.
template <class T>
struct HeldUp {
  StartInputs<T> in;
  const T *base, *way;   // [B, V, 3]
  const uint8_t* state;  // [B, V]
  T* to;                 // [B, V, 3]
  uint8_t* state_out;

  template <class Team>
  DIFFVBD_FN void operator()(const rigid::Body<T>& b, const Team& team) const {
    const auto share_of = [&](int64_t row) { return state[row] == kGoes ? in.share[row] : T(0); };
    const double least = team.least(b.size(), [&](int32_t i) { return double(share_of(b.row(b.vertex(i)))); });
    const bool bent = !in.held_bodies[b.body] && T(least) < T(kShort);
    team.each(b.size(), [&](int32_t i) {
      const int64_t row = b.row(b.vertex(i));
      state_out[row] = state[row] != kGoes ? kRests : bent ? kAsks : kGoes;
      store(to + 3 * row, vector_at(base + 3 * row) + share_of(row) * vector_at(way + 3 * row));
    });
  }
};

// Where vertices have come toward their wishes, and the way of the fall from there.
template <class T>
struct Falls {
  StartInputs<T> in;     // share: of what goes
  const uint8_t* state;  // [B, V]
  T* share;              // [B, V]  of all
  T *at, *way;           // [B, V, 3]

  DIFFVBD_FN void operator()(int64_t scene, int32_t v) const {
    const StartPath<T> path{in, scene, v};
    const T went = state[path.row] == kGoes ? in.share[path.row] : T(0);
    const Vec3<T> from = path.at(path.target(), went);
    share[path.row] = went;
    store(at + 3 * path.row, from);
    store(way + 3 * path.row, path.last_target(from) - from);
  }
};

// Where the part starts, and who has lost more than a hundredth of its way to pairs; what a floor stops does not try
// again.
template <class T>
struct Starts {
  StartInputs<T> in;
  const bool* stopped;  // [B, bodies]
  T* end;               // [B, V, 3]
  bool* is_short;       // [B, V]

  DIFFVBD_FN void operator()(int64_t scene, int32_t v) const {
    const StartPath<T> path{in, scene, v};
    store(end + 3 * path.row, path.end());
    const bool again = !in.held[v] && (in.held_bodies[in.body[v]] || !stopped[path.body]);
    is_short[path.row] = again && (in.share[path.row] < T(kShort) || in.last_share[path.row] < T(kShort));
  }
};

template <class T>
struct ReverseStarts {
  StartInputs<T> in;
  StartAdjoints<T> out;
  DIFFVBD_FN void operator()(int64_t scene, int32_t v) const { reverse_start(in, out, scene, v); }
};

}  // namespace diffvbd::contact
