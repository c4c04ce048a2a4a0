// From which of two states a body's sweeps start: the one of lower incremental potential.
#pragma once

#include "../rigid/body.h"

namespace diffvbd::start {

template <class T>
struct Candidates {
  rigid::Inputs<T> bodies;         // x: one state; y the predictor
  const T* other;                  // [B, V, 3]  the other state
  const int32_t *tets, *tet_ptr;   // [listed tets, 5]: its number, its corners; [bodies + 1]
  Batched<const T> mu, lam, rest;  // [B, T] or [B, 1] twice, [B, T, 7]; mu is null without an elastic energy
};

// Energy of a tet over h^2, from its corners, weights k and c6 (stable_neo_hookean.h), up to a constant.
DIFFVBD_FN double tet_energy(const rigid::Vector (&x)[4], const double* k, double mu, double lam) {
  double shear = 0;
  for (int a = 0; a < 4; ++a) {
    for (int b = a + 1; b < 4; ++b) {
      const rigid::Vector edge = x[b] - x[a];
      shear -= k[weight_index(a, b)] * dot(edge, edge);
    }
  }
  const double c6 = k[6], strain = c6 * dot(x[1] - x[0], cross(x[2] - x[0], x[3] - x[0])) - 1;
  return 0.5 * mu * shear + (0.5 * (mu + lam) * strain * strain - mu * strain) / (6 * c6);
}

// By how much the potential of `other` lies above that of x.
template <class T, class Team>
DIFFVBD_FN double rise(const Candidates<T>& in, const rigid::Body<T>& b, const Team& team) {
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
  if (in.mu.data == nullptr) return vertices[0];
  double tets[1];
  const int32_t first = in.tet_ptr[b.body];
  team.template sum<1>(in.tet_ptr[b.body + 1] - first, tets, [&](int32_t i, double* to) {
    const int32_t* tet = in.tets + 5 * int64_t{first + i};
    rigid::Vector one[4], two[4];
    for (int c = 0; c < 4; ++c) one[c] = b.position(tet[1 + c]), two[c] = other(tet[1 + c]);
    double k[kRestScalars];
    const T* rest = in.rest.data + b.scene * in.rest.scene + kRestScalars * int64_t{tet[0]};
    for (int c = 0; c < kRestScalars; ++c) k[c] = rest[c];
    const double mu = in.mu.data[b.scene * in.mu.scene + in.mu.item * tet[0]],
                 lam = in.lam.data[b.scene * in.lam.scene + in.lam.item * tet[0]];
    to[0] += tet_energy(two, k, mu, lam) - tet_energy(one, k, mu, lam);
  });
  return vertices[0] + b.in.time_step * b.in.time_step * tets[0];
}

}  // namespace diffvbd::start
