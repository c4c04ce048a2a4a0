// What a tet of a generated law (own_law.h) reads: its rest shape, with a fibre a . grad N_a of its corners; with
// DIFFVBD_LAW_VISCOUS the rest shape and the moduli of a second law, its viscosity in a step (docs/method.md, section
// 20); then the law's parameters. They are among the scalars of the rest shape, so that any number of them takes the
// way that is there; the material stays mu and lam, those of the law at rest, which no sweep reads.
#pragma once

#include "../core/hyper_dual.h"
#include "../core/views.h"

namespace diffvbd {

template <class S>
struct Invariants {
  S i1, i2, j, i4;
  S below;  // J - j, not zero where J is below kLeastVolume: there psi is its Taylor polynomial in J about that
};
constexpr double kLeastVolume = 0.1;  // twin of LEAST_VOLUME in diffvbd/laws/density.py

// psi's derivatives by the invariants.
template <class S>
struct Slopes {
  S i1, i2, j, i4;
};
// And the second ones: 11 12 1J 14, 22 2J 24, JJ J4, 44.
template <class S>
struct Curvatures {
  S of[10];
};
DIFFVBD_FN constexpr int curvature_place(int i, int k) {
  constexpr int first[4] = {0, 3, 5, 6};
  return i < k ? first[i] + k : first[k] + i;
}

template <class S>
DIFFVBD_FN S stretch_sum(const S& i1, const S& i2, const S& j);

}  // namespace diffvbd

#include DIFFVBD_LAW_HEADER

namespace diffvbd {

#ifdef DIFFVBD_LAW_VISCOUS
constexpr bool kViscous = true;
#else
constexpr bool kViscous = false;
#endif

struct TetLayout {
  // whether a vertex must see the edges that it is no end of: of a law that is not linear in I1
  static constexpr bool edges = Density::edges;
  static constexpr int material = 2;
  static constexpr int fibre = 7, viscous = fibre + (Density::fibre ? 4 : 0);
  static constexpr int parameters = viscous + (kViscous ? 9 : 0);
  static constexpr int rest = parameters + Density::parameters;
  // as a vertex sees them: k_ij k_ik k_il (k_jk k_jl k_kl) c6 (b_j b_k b_l) (k_ij k_ik k_il c6 mu lam of the
  // viscosity), then the parameters
  static constexpr int pair_c6 = edges ? 6 : 3, pair_fibre = pair_c6 + 1;
  static constexpr int pair_viscous = pair_fibre + (Density::fibre ? 3 : 0);
  static constexpr int pair_parameters = pair_viscous + (kViscous ? 6 : 0);
  static constexpr int pair_rest = pair_parameters + Density::parameters, pair_shape = pair_parameters;

  DIFFVBD_FN static constexpr int rest_index(int local, int i) {
    const int j = other_corner(local, 0), k = other_corner(local, 1), l = other_corner(local, 2);
    if (i < 3) return weight_index(local, other_corner(local, i));
    if (i < pair_c6) return i == 3 ? weight_index(j, k) : i == 4 ? weight_index(j, l) : weight_index(k, l);
    if (i == pair_c6) return 6;
    if (i < pair_viscous) return fibre + other_corner(local, i - pair_fibre);
    if (i < pair_viscous + 3 && kViscous) return viscous + weight_index(local, other_corner(local, i - pair_viscous));
    if (i < pair_parameters) return viscous + 3 + i - pair_viscous;
    return parameters + i - pair_parameters;
  }
  static constexpr int line_degree = 8;  // changes of the tet's energy along a line: OwnLaw::line()
  static constexpr bool polynomial = false, reads_material = false;

  template <class T>
  DIFFVBD_FN static T volume(const T* rest) {
    return 1 / (6 * rest[6]);
  }
};

}  // namespace diffvbd
