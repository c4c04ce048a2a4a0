// One body of one scene as loops read it: its vertices, their state and their energies. Loops and sums over its
// vertices belong to a Team: a few threads, a block, or a whole device.
#pragma once

#include "../core/rotation.h"
#include "../energies/energies.h"

namespace diffvbd::rigid {

constexpr double kLeastGapFraction = 0.1;  // of a gap, kept in one step: that of the updates, 1 - FILTER_ETA
constexpr int32_t kCorrected = -2;         // as `other` of a vertex whose body is corrected

template <class T>
struct Inputs {
  using Scalar = T;
  const T* x;                                      // [B, V, 3]
  Batched<const T> x_prev, y, mass, origin, data;  // origin may be null
  const int32_t *order, *ptr;                      // vertices by body [listed], [bodies + 1]
  const double* spread;                            // [bodies]  squared radius of gyration at rest [m^2]
  const int32_t* other;                            // [V]  which of the other bodies a vertex is in, -1: none
  int64_t scenes, data_start[kVertexEnergies];     // of each energy among the data of a scene
  int32_t vertices, bodies, data_count[kVertexEnergies];
  double time_step;
};

// calls f(energy, its position in the list)
template <int k = 0, class F>
DIFFVBD_FN void each_energy(F&&, EnergyList<>) {}
template <int k = 0, class F, class E, class... Rest>
DIFFVBD_FN void each_energy(F&& f, EnergyList<E, Rest...>) {
  f(E{}, k);
  each_energy<k + 1>(f, EnergyList<Rest...>{});
}

// One body of one scene; item i is its i-th vertex.
template <class T>
struct Body {
  const Inputs<T>& in;
  int64_t scene;
  int32_t body;

  DIFFVBD_FN int32_t size() const { return in.ptr[body + 1] - in.ptr[body]; }
  DIFFVBD_FN int32_t vertex(int32_t i) const { return in.order[in.ptr[body] + i]; }
  DIFFVBD_FN int64_t row(int32_t v) const { return scene * in.vertices + v; }
  DIFFVBD_FN Vector position(int32_t v) const { return wide_at(in.x + 3 * row(v)); }
  DIFFVBD_FN Vector target(int32_t v) const { return wide_at(in.y.data + scene * in.y.scene + 3 * int64_t{v}); }
  DIFFVBD_FN double mass(int32_t v) const { return in.mass.data[scene * in.mass.scene + v]; }
  DIFFVBD_FN VertexState<double> state(int32_t v, const Vector& x) const {
    const Vector origin =
        in.origin.data ? wide_at(in.origin.data + scene * in.origin.scene + 3 * int64_t{v}) : Vector{};
    return {x, wide_at(in.x_prev.data + scene * in.x_prev.scene + 3 * int64_t{v}), origin, in.time_step};
  }

  // calls f(energy, its position, its data for a vertex, their count) for the energies that are present
  template <class F>
  DIFFVBD_FN void energies(int32_t v, F&& f) const {
    each_energy(
        [&](auto energy, int k) {
          const int count = in.data_count[k];
          if (count == 0) return;
          const T* own = in.data.data + scene * in.data.scene + in.data_start[k] +
                         (decltype(energy)::per_vertex ? int64_t{v} * count : 0);
          if constexpr (sizeof(T) == sizeof(double)) {
            f(energy, k, own, count);
          } else {
            double values[kMaxEnergyData];
            for (int i = 0; i < count; ++i) values[i] = own[i];
            f(energy, k, values, count);
          }
        },
        VertexEnergies{});
  }
};

}  // namespace diffvbd::rigid
