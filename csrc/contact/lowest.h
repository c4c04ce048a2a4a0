// The lowest vertex of an island above each plane of a floor: how far a common translation may go down.
#pragma once

#include <cstdint>

#include "../core/vec.h"

namespace diffvbd::contact {

constexpr int kPlaneScalars = 7;  // of a plane in the data of FloorBarrier: normal, height, ...

template <class T>
struct LowestInputs {
  const T *x, *origin;                   // [B, V, 3]; origin may be null
  const T* planes;                       // [1 | B, planes, kPlaneScalars]
  const int32_t *body_order, *body_ptr;  // [V], [bodies + 1]
  const int32_t* island;                 // [B, bodies]
  int64_t scenes, plane_scene;           // stride of scenes in planes
  int32_t vertices, bodies, num_planes;

  DIFFVBD_FN T gap(int64_t scene, int32_t v, int32_t plane) const {
    const T *p = planes + scene * plane_scene + plane * kPlaneScalars, *at = x + 3 * (scene * vertices + v);
    const Vec3<T> n{p[0], p[1], p[2]};
    T height = p[3];
    if (origin) {
      const T* o = origin + 3 * (scene * vertices + v);
      height = height - dot(n, Vec3<T>{o[0], o[1], o[2]});
    }
    return dot(n, Vec3<T>{at[0], at[1], at[2]}) - height;
  }
};

// A vertex and its gap; the lower one is kept, of equal ones that with the smaller number.
template <class T>
struct Lowest {
  T gap;
  int32_t vertex;
  DIFFVBD_FN void keep(const Lowest& other) {
    if (other.vertex < 0) return;
    if (vertex < 0 || other.gap < gap || (!(gap < other.gap) && other.vertex < vertex)) *this = other;
  }
};

// Of every `stride`-th vertex of a body from `first` on.
template <class T>
DIFFVBD_FN Lowest<T> lowest_of_body(const LowestInputs<T>& in, int64_t scene, int32_t body, int32_t plane,
                                    int32_t first, int32_t stride) {
  Lowest<T> out{T(0), -1};
  for (int32_t k = in.body_ptr[body] + first; k < in.body_ptr[body + 1]; k += stride) {
    const int32_t v = in.body_order[k];
    out.keep({in.gap(scene, v, plane), v});
  }
  return out;
}

// Of the bodies of an island; `own` [B, bodies, planes] holds theirs.
template <class T>
DIFFVBD_FN int32_t lowest_of_island(const LowestInputs<T>& in, const int32_t* own, int64_t scene, int32_t body,
                                    int32_t plane) {
  const int32_t island = in.island[scene * in.bodies + body];
  Lowest<T> out{T(0), -1};
  for (int32_t b = 0; b < in.bodies; ++b) {
    if (b != body && (island < 0 || in.island[scene * in.bodies + b] != island)) continue;
    const int32_t v = own[(scene * in.bodies + b) * in.num_planes + plane];
    if (v >= 0) out.keep({in.gap(scene, v, plane), v});
  }
  return out.vertex < 0 ? 0 : out.vertex;
}

}  // namespace diffvbd::contact
