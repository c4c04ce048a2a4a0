// Where a part of a step starts: the bound of each vertex, and the vertex moved as far toward its goal as bound and
// floor let it; with the adjoint.
#pragma once

#include "../energies/floor_start.h"
#include "../sweep/bounds.h"
#include "candidates.h"
#include "passes.h"

namespace diffvbd::contact {

constexpr int kGuardUlps = 32;

template <class T>
struct StartInputs {
  const T *x, *move;               // [B, V, 3]  at the detection; where each vertex wants to go from there
  const T* goal;                   // [B, V, 3]  where pinned vertices are put
  const T* u;                      // [B, bodies, 3]
  const T* near;                   // [B, corners, kNearValues]
  Batched<const T> origin, floor;  // [B, V, 3], [1 | B, data of the planes]; either may be null
  const bool* pinned;              // [V]
  const int32_t* body;             // [V]
  int64_t scenes, corners;
  int32_t vertices, bodies, floor_scalars;
  T gamma, cap;
  StepParameters<T> parameters;

  DIFFVBD_FN Vec3<T> at(const T* p, int64_t scene, int32_t v) const {
    return vector_at(p + 3 * (scene * vertices + v));
  }
  DIFFVBD_FN Vec3<T> local_origin(int64_t scene, int32_t v) const {
    return origin.data ? vector_at(origin.data + scene * origin.scene + 3 * int64_t{v}) : zero3<T>();
  }
  // Share of the smallest gap that is the vertex's to move; a gap is not trusted to less than some roundings of a
  // position.
  DIFFVBD_FN T share(int64_t scene, int32_t v) const {
    const Vec3<T> o = local_origin(scene, v), p = at(x, scene, v) + o;
    const T guard = T(kGuardUlps) * std::numeric_limits<T>::epsilon() * (absolute(p.x) + absolute(p.y) + absolute(p.z));
    return gamma * (near[(scene * corners + v) * kNearValues + kNearValues - 1] - guard);
  }
  DIFFVBD_FN Bound<T> bound(int64_t scene, int32_t v) const {
    const T wanted = share(scene, v);
    const T radius = wanted < cap ? wanted : cap;
    return {at(x, scene, v) + vector_at(u + 3 * (scene * bodies + body[v])), T(0) < radius ? radius : T(0)};
  }
  DIFFVBD_FN const T* planes(int64_t scene) const { return floor.data + scene * floor.scene; }
  // The floor acts on the way from the center of the bound, which it does not lengthen: its end lies inside, too.
  DIFFVBD_FN VertexState<T> state(const Bound<T>& b, int64_t scene, int32_t v) const {
    return {b.center, b.center, local_origin(scene, v), parameters.time_step};
  }
};

template <class T>
struct StartOutputs {
  T *bounds, *start, *move;  // [B, V, 4], [B, V, 3], [B, V, 3]: what is left to go
  uint8_t* outside;          // [B, V]: the bound has cut the motion
};

template <class T>
DIFFVBD_FN void start_vertex(const StartInputs<T>& in, const StartOutputs<T>& out, int64_t scene, int32_t v) {
  const int64_t row = scene * in.vertices + v;
  const Bound<T> b = in.bound(scene, v);
  const Vec3<T> x = in.at(in.x, scene, v), move = in.at(in.move, scene, v);
  Vec3<T> start = in.at(in.goal, scene, v);
  out.outside[row] = 0;
  if (!in.pinned[v]) {
    start = x + bounded(x, move, b);
    out.outside[row] = is_cut(x, move, b) > T(0);
    if (in.floor.data) {
      start = b.center + FloorStart::moved(in.state(b, scene, v), in.planes(scene), in.floor_scalars, start - b.center,
                                           in.parameters);
    }
  }
  const Vec3<T> left = move - (start - x);
  T *to = out.bounds + 4 * row, *at = out.start + 3 * row, *rest = out.move + 3 * row;
  to[0] = b.center.x, to[1] = b.center.y, to[2] = b.center.z, to[3] = b.radius;
  at[0] = start.x, at[1] = start.y, at[2] = start.z;
  rest[0] = left.x, rest[1] = left.y, rest[2] = left.z;
}

template <class T>
struct StartAdjoints {
  const T *bounds, *start, *move;  // of the outputs
  T *x, *wanted, *goal, *u, *gap;  // [B, V, 3] four times, u for each vertex; [B, V]
  T* floor;                        // [B, V, floor_scalars], or null where not wanted
};

template <class T>
DIFFVBD_FN void reverse_start(const StartInputs<T>& in, const StartAdjoints<T>& a, int64_t scene, int32_t v) {
  const int64_t row = scene * in.vertices + v;
  const Bound<T> b = in.bound(scene, v);
  const Vec3<T> x = in.at(in.x, scene, v), move = in.at(in.move, scene, v), left_bar = vector_at(a.move + 3 * row);
  const Vec3<T> start_bar = vector_at(a.start + 3 * row) - left_bar, none = zero3<T>();
  Bound<T> b_bar{vector_at(a.bounds + 4 * row), a.bounds[4 * row + 3]};
  Vec3<T> x_bar = left_bar, move_bar = left_bar, goal_bar = none;
  T* floor_bar = a.floor ? a.floor + row * in.floor_scalars : nullptr;
  for (int k = 0; floor_bar && k < in.floor_scalars; ++k) floor_bar[k] = T(0);
  if (in.pinned[v]) {
    goal_bar = start_bar;
  } else {
    Vec3<T> target_bar = start_bar;
    if (in.floor.data) {
      const Vec3<T> step = x + bounded(x, move, b) - b.center;
      b_bar.center += start_bar;
      FloorStart::moved_vjp(in.state(b, scene, v), in.planes(scene), in.floor_scalars, step, in.parameters, target_bar,
                            b_bar.center, floor_bar);
      b_bar.center -= target_bar;
    }
    x_bar += target_bar;
    bounded_vjp(x, move, b, target_bar, x_bar, b_bar);
    move_bar += target_bar;
  }
  const T wanted = in.share(scene, v);
  a.gap[row] = T(0) < wanted && wanted < in.cap ? in.gamma * b_bar.radius : T(0);
  x_bar += b_bar.center;
  const Vec3<T> bars[] = {x_bar, move_bar, goal_bar, b_bar.center};
  T* const to[] = {a.x + 3 * row, a.wanted + 3 * row, a.goal + 3 * row, a.u + 3 * row};
  for (int k = 0; k < 4; ++k) to[k][0] = bars[k].x, to[k][1] = bars[k].y, to[k][2] = bars[k].z;
}

}  // namespace diffvbd::contact
