// Where a vertex wants to be at the start of a part: its wish, less what the floor takes from the way there that it
// goes beside its island; with the adjoint.
#pragma once

#include "../energies/floor_start.h"
#include "passes.h"

namespace diffvbd::contact {

template <class T>
struct StartInputs {
  const T *x, *move;               // [B, V, 3]  at the detection; where each vertex wants to go from there
  const T* u;                      // [B, bodies, 3]
  Batched<const T> origin, floor;  // [B, V, 3], [1 | B, data of the planes]; either may be null
  const bool* held;                // [V]  these go where they are put
  const int32_t* body;             // [V]
  int64_t scenes;
  int32_t vertices, bodies, floor_scalars;
  StepParameters<T> parameters;

  DIFFVBD_FN Vec3<T> translation(int64_t scene, int32_t v) const {
    return vector_at(u + 3 * (scene * bodies + body[v]));
  }
  DIFFVBD_FN const T* planes(int64_t scene) const { return floor.data + scene * floor.scene; }
  // The floor acts on the way from where the island has brought the vertex.
  DIFFVBD_FN VertexState<T> state(const Vec3<T>& base, int64_t scene, int32_t v) const {
    const Vec3<T> o = origin.data ? vector_at(origin.data + scene * origin.scene + 3 * int64_t{v}) : zero3<T>();
    return {base, base, o, parameters.time_step};
  }
  DIFFVBD_FN bool is_free(int32_t v) const { return floor.data == nullptr || held[v]; }
};

template <class T>
DIFFVBD_FN void start_vertex(const StartInputs<T>& in, int64_t scene, int32_t v, T* target) {
  const int64_t row = 3 * (scene * in.vertices + v);
  const Vec3<T> x = vector_at(in.x + row), move = vector_at(in.move + row);
  Vec3<T> out = x + move;
  if (!in.is_free(v)) {
    const Vec3<T> u = in.translation(scene, v), base = x + u;
    out =
        base + FloorStart::moved(in.state(base, scene, v), in.planes(scene), in.floor_scalars, move - u, in.parameters);
  }
  target[row] = out.x, target[row + 1] = out.y, target[row + 2] = out.z;
}

template <class T>
struct StartAdjoints {
  const T* target;  // of the output
  T *x, *move, *u;  // [B, V, 3] each, u for each vertex
  T* floor;         // [B, V, floor_scalars], or null where not wanted
};

template <class T>
DIFFVBD_FN void reverse_start(const StartInputs<T>& in, const StartAdjoints<T>& a, int64_t scene, int32_t v) {
  const int64_t row = scene * in.vertices + v;
  T* floor_bar = a.floor ? a.floor + row * in.floor_scalars : nullptr;
  for (int k = 0; floor_bar && k < in.floor_scalars; ++k) floor_bar[k] = T(0);
  Vec3<T> x_bar = vector_at(a.target + 3 * row), step_bar = x_bar;
  if (!in.is_free(v)) {
    const Vec3<T> u = in.translation(scene, v), base = vector_at(in.x + 3 * row) + u;
    FloorStart::moved_vjp(in.state(base, scene, v), in.planes(scene), in.floor_scalars,
                          vector_at(in.move + 3 * row) - u, in.parameters, step_bar, x_bar, floor_bar);
  }
  const Vec3<T> bars[] = {x_bar, step_bar, x_bar - step_bar};
  T* const to[] = {a.x + 3 * row, a.move + 3 * row, a.u + 3 * row};
  for (int k = 0; k < 3; ++k) to[k][0] = bars[k].x, to[k][1] = bars[k].y, to[k][2] = bars[k].z;
}

}  // namespace diffvbd::contact
