// A tet and its law: how many scalars of material and of rest shape it reads, and what of them one of its vertices
// sees. Everything outside the law's own header counts them and knows no names.
#pragma once

#include "../core/views.h"
#ifdef DIFFVBD_LAW_HEADER
#include "own_layout.h"
#endif

namespace diffvbd {

#ifndef DIFFVBD_LAW_HEADER
// Material and rest shape of the law that scenes use (stable_neo_hookean.h).
struct TetLayout {
  static constexpr int material = 2;   // of a tet: mu, lam [Pa]
  static constexpr int rest = 7;       // of a tet: the stiffness weights k01 k02 k03 k12 k13 k23 [m], c6 [1/m^3]
  static constexpr int pair_rest = 4;  // of them, as corner `local` sees them: k_ij, k_ik, k_il, c6
  static constexpr int pair_shape = pair_rest;  // the first of them, which are 0 in pairs that fill up a block

  DIFFVBD_FN static constexpr int rest_index(int local, int i) {
    return i == 3 ? 6 : weight_index(local, other_corner(local, i));
  }
  static constexpr int line_degree = 6;  // of the tet's energy along a line, a polynomial: StableNeoHookean::line()
  static constexpr bool polynomial = true, reads_material = true;

  template <class T>
  DIFFVBD_FN static T volume(const T* rest) {
    return 1 / (6 * rest[6]);
  }
};
#endif
constexpr int kMaterialScalars = TetLayout::material;
constexpr int kRestScalars = TetLayout::rest, kPairRest = TetLayout::pair_rest;

// One (vertex, tet) pair as its vertex sees it; (j, i, k, l) is an even permutation of the tet.
template <class R>
struct TetPair {
  Vec3<R> xj, xk, xl;
  R rest[kPairRest], material[kMaterialScalars];
};

// The adjoints of a tet's corners by one reversed update, with the sign and h^2 applied.
template <class R>
struct TetAdjoint {
  Vec3<R> xi, xj, xk, xl;
};

// Which adjoints beyond the state are wanted: those that a variant is compiled for, and of them those asked for.
enum Wanted { kState = 0, kMaterial = 1, kRest = 2 };

// The adjoints of material and rest shape, scattered to the star.
template <class Law, int wanted, class R, class Star, class View>
DIFFVBD_FN void reverse_shape(const Star& star, int e, const TetPair<R>& tet, const View& view, const Vec3<R>& d_raw,
                              const Vec3<R>& p, const R& minus_h2) {
  if (star.template wants<wanted>(kMaterial)) {
    R material_bar[kMaterialScalars];
    Law::material_vjp(tet, view, d_raw, p, minus_h2, material_bar);
    star.add_material(e, material_bar);
  }
  if (star.template wants<wanted>(kRest)) {
    R rest_bar[kPairRest];
    Law::rest_vjp(tet, view, d_raw, p, minus_h2, rest_bar);
    star.add_rest(e, rest_bar);
  }
}

// The adjoints of one tet's inputs, scattered to the star.
template <class Law, int wanted, class R, class Star, class View>
DIFFVBD_FN void reverse_tet(const Star& star, int e, const TetPair<R>& tet, const View& view, const Vec3<R>& d_raw,
                            const Vec3<R>& p, const R& minus_h2, Vec3<R>& own) {
  const TetAdjoint<R> bar = Law::block_vjp(tet, view, d_raw, p, minus_h2);
  own += bar.xi;
  star.add(e, bar);
  reverse_shape<Law, wanted>(star, e, tet, view, d_raw, p, minus_h2);
}

// The sums of the tets of a star, without h^2.
template <class R>
struct TetSums {
  Vec3<R> g;
  R h_diagonal;
  Sym3<R> h_outer;
};
// The two loops below copy what they read often: no store of theirs can alias it.
template <class Law, class R, class Star>
DIFFVBD_FN TetSums<R> sum_tets(const Star& shared, const Vec3<R>& position) {
  decltype(auto) star = shared.local();
  const Vec3<R> x = position;
  TetSums<R> out{zero3<R>(), R(0), diagonal(R(0))};
  for (int e = 0; e < star.size(); ++e) Law::block(star.pair(e), x, out.g, out.h_diagonal, out.h_outer);
  return out;
}

// An update of x by d_raw, and p as in reverse_vertex().
template <class R>
struct Reversed {
  Vec3<R> x, d_raw, p;
  R minus_h2;
};
// The adjoints of a star's tets; returns that of its vertex.
template <class Law, int wanted, class R, class Star>
DIFFVBD_LOOP Vec3<R> reverse_tets(const Star& shared, const Reversed<R>& update) {
  decltype(auto) star = shared.local();
  const Reversed<R> u = update;
  Vec3<R> own = zero3<R>();
  for (int e = 0; e < star.size(); ++e) {
    const TetPair<R> tet = star.pair(e);
    reverse_tet<Law, wanted>(star, e, tet, Law::view(tet, u.x, u.d_raw, u.p), u.d_raw, u.p, u.minus_h2, own);
  }
  return own;
}

// w of a pair's neighbours, as TetPair has their positions.
template <class R>
struct PairDisplacement {
  Vec3<R> wj, wk, wl;
};
// The adjoint of w . g, with g the gradient that the tets have at all vertices: the vertex's own rows of their Hessian
// times w, gathered from w of its neighbours, and the adjoints of the tets' inputs as far as they come through the
// vertex's own w. Nothing is scattered to a neighbour. star.displacement(e) follows star.pair(e).
template <class Law, int wanted, class R, class Star>
DIFFVBD_LOOP Vec3<R> multiply_tets(const Star& shared, const Vec3<R>& position, const Vec3<R>& own_displacement,
                                   const R& minus_h2) {
  decltype(auto) star = shared.local();
  const Vec3<R> x = position, w = own_displacement, p = -w, none = zero3<R>();
  const R scale = minus_h2;
  Vec3<R> sum = none;
  for (int e = 0; e < star.size(); ++e) {
    const TetPair<R> tet = star.pair(e);
    const PairDisplacement<R> displacement = star.displacement(e);
    const auto view = Law::view(tet, x, none, p);
    sum += Law::product(tet, view, w, displacement.wj, displacement.wk, displacement.wl);
    reverse_shape<Law, wanted>(star, e, tet, view, none, p, scale);
  }
  return -(scale * sum);
}

}  // namespace diffvbd
