// A spring from a vertex to a point: k / 2 |x - a|^2. It brings only its block(); its adjoint is derived by Dual.
#pragma once

#include "../core/views.h"

namespace diffvbd {

struct Anchor {
  static constexpr bool per_vertex = true;  // data of each vertex: (stiffness [N/m], point [m])
  static constexpr int stride = 4;
  static constexpr bool has_filter = false;
  static constexpr bool reads_x_prev = false;
  static constexpr bool optional = true;

  template <class T>
  static const char* invalid(const T* a) {
    return a[0] >= 0 ? nullptr : "anchor_stiffness: expected >= 0 N/m";
  }

  template <class R>
  DIFFVBD_FN static void block(const VertexState<R>& s, const R* data, int count, Vec3<R>& g, Sym3<R>& H) {
    for (int i = 0; i < count; i += stride) {
      const R k = s.h * s.h * data[i];
      g += k * (s.x - Vec3<R>{data[i + 1], data[i + 2], data[i + 3]});
      add_diagonal(H, k);
    }
  }

  // the potential whose gradient block() adds
  template <class R>
  DIFFVBD_FN static R value(const VertexState<R>& s, const R* data, int) {
    const Vec3<R> d = s.x - Vec3<R>{data[1], data[2], data[3]};
    return R(0.5) * s.h * s.h * data[0] * dot(d, d);
  }
};

}  // namespace diffvbd
