// From which of two states a body's sweeps start: the one of lower incremental potential.
#pragma once

#include "../rigid/body.h"

namespace diffvbd::start {

template <class T>
struct Candidates {
  rigid::Inputs<T> bodies;                            // x: one state; y the predictor
  const T* other;                                     // [B, V, 3]  the other state
  const int32_t *tets, *tet_ptr;                      // [listed tets, 5]: its number, its corners; [bodies + 1]
  Batched<const T> material[kMaterialScalars], rest;  // [B, T] or [B, 1] each, [B, T, kRestScalars]; null: no tets
};

// From which ratio of Way on tets resist. Each corner has all of its mass in each of its tets, some 24, so that this is
// where h^2 times the stiffness of a layer of vertices is half of their mass.
constexpr double kSoft = 0.02;

// What happens to a body on the straight way d from x to `other`.
struct Way {
  double rise;   // of the potential
  double ratio;  // h^2 d . K d over the d . M d of its corners, of each tet; their mean, weighted by d . K d
  // Whether tets hardly turn vertices back within a step. Over the whole body d . M d would hide a few that do.
  DIFFVBD_FN bool is_soft() const { return ratio < kSoft; }
};
template <class T, class Team>
DIFFVBD_FN Way way_between(const Candidates<T>& in, const rigid::Body<T>& b, const Team& team) {
  const auto other = [&](int32_t v) { return rigid::Body<T>::at(in.other + 3 * b.row(v)); };
  double vertices[1];
  team.template sum<1>(b.size(), vertices, [&](int32_t i, double* to) {
    const int32_t v = b.vertex(i);
    const rigid::Vector one = b.position(v), two = other(v), way = two - one;
    if (dot(way, way) == 0) return;
    to[0] += b.mass(v) * dot(way, 0.5 * (one + two) - b.target(v));
    b.energies(v, [&](auto energy, int, const double* data, int count) {
      using E = decltype(energy);
      to[0] += E::value(b.state(v, two), data, count) - E::value(b.state(v, one), data, count);
    });
  });
  if (in.rest.data == nullptr) return {vertices[0], 0};
  double tets[3];  // rise, size of bends, what their ratios weigh
  const int32_t first = in.tet_ptr[b.body];
  team.template sum<3>(in.tet_ptr[b.body + 1] - first, tets, [&](int32_t i, double* to) {
    const int32_t* tet = in.tets + 5 * int64_t{first + i};
    rigid::Vector one[4], way[4];
    for (int c = 0; c < 4; ++c) one[c] = b.position(tet[1 + c]), way[c] = other(tet[1 + c]) - one[c];
    double rest[kRestScalars], material[kTetScalars];
    const T* of_tet = in.rest.data + b.scene * in.rest.scene + kRestScalars * int64_t{tet[0]};
    for (int c = 0; c < kRestScalars; ++c) rest[c] = of_tet[c];
    for (int m = 0; m < kMaterialScalars; ++m) {
      material[m] = in.material[m].data[b.scene * in.material[m].scene + in.material[m].item * tet[0]];
    }
    if constexpr (TetLayout::reads_x_prev) {
      for (int c = 0; c < 4; ++c) {
        const rigid::Vector before = b.state(tet[1 + c], one[c]).x_prev;
        double* at = material + kMaterialScalars + 3 * c;
        at[0] = before.x, at[1] = before.y, at[2] = before.z;
      }
    }
    double rise[TetLayout::line_degree]{};
    TetLaw::line(one, way, rest, material, rise);
    double bend = 0, inertia = 0;  // half of d . K d, K averaged over the way: what the energy rises beyond its slope
    for (int k = 1; k < TetLayout::line_degree; ++k) bend += rise[k];
    for (int c = 0; c < 4; ++c) inertia += b.mass(tet[1 + c]) * dot(way[c], way[c]);
    to[0] += rise[0] + bend;
    if (inertia > 0) to[1] += std::abs(bend), to[2] += bend * bend / inertia;
  });
  const double h2 = b.in.time_step * b.in.time_step;
  return {vertices[0] + h2 * tets[0], tets[1] > 0 ? 2 * h2 * tets[2] / tets[1] : 0};
}

}  // namespace diffvbd::start
