// Where a part of a step starts, with the adjoint: each vertex goes with its island, with its body as a whole, toward
// its wish and then with its fall, of all but the first the share that has been decided. Of a wish and of a fall the
// floor takes what would come too close (docs/method.md, section 12).
#pragma once

#include "../energies/floor_start.h"
#include "../rigid/body.h"
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

}  // namespace diffvbd::contact
