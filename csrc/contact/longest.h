// The longest way of a vertex of each body, and its largest angle as seen along an arm: how far bodies want to go.
#pragma once

#include <cstdint>

#include "../core/vec.h"

namespace diffvbd::contact {

template <class T>
struct LongestInputs {
  const T *way, *beside;       // [B, V, 3], [B, bodies, 3]; the latter, which is subtracted, may be null
  const T* arm;                // [B, V, 3], read for angles
  const bool* counts;          // [V] which vertices do
  const int32_t *order, *ptr;  // [V], [bodies + 1]
  int64_t scenes, vertices, bodies;
  bool angles;
};

template <class T>
struct Longest {
  T square, angle;  // of the length; length over that of the arm
  DIFFVBD_FN void keep(const Longest& other) {
    square = larger(square, other.square), angle = larger(angle, other.angle);
  }
};

// Of every `stride`-th vertex of a body from `first` on.
template <class T>
DIFFVBD_FN Longest<T> longest_of_body(const LongestInputs<T>& in, int64_t scene, int64_t body, int32_t first,
                                      int32_t stride) {
  const auto at = [](const T* rows, int64_t i) { return Vec3<T>{rows[3 * i], rows[3 * i + 1], rows[3 * i + 2]}; };
  const Vec3<T> u = in.beside ? at(in.beside, scene * in.bodies + body) : Vec3<T>{T(0), T(0), T(0)};
  Longest<T> out{T(0), T(0)};
  for (int64_t k = int64_t{in.ptr[body]} + first; k < in.ptr[body + 1]; k += stride) {
    const int32_t v = in.order[k];
    if (!in.counts[v]) continue;
    const int64_t i = scene * in.vertices + v;
    const Vec3<T> way = at(in.way, i) - u;
    Longest<T> own{dot(way, way), T(0)};
    if (in.angles) {
      const Vec3<T> arm = at(in.arm, i);
      own.angle = square_root(own.square) / larger(std::numeric_limits<T>::min(), square_root(dot(arm, arm)));
    }
    out.keep(own);
  }
  return out;
}

// out [1 or, with arms, 2, B, bodies]: lengths, angles
template <class T>
DIFFVBD_FN void store_longest(const LongestInputs<T>& in, const Longest<T>& found, int64_t row, T* out) {
  out[row] = square_root(found.square);  // which is the largest of the roots, to the bit
  if (in.angles) out[in.scenes * in.bodies + row] = found.angle;
}

}  // namespace diffvbd::contact
