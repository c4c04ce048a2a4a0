// Stable Neo-Hookean tets (Smith et al. 2018; paper, appendix on closed forms): P = mu F + (lb (J - 1) - mu) cof F, lb
// = mu + lam.
//
// Seen from one vertex i of a tet (i, j, k, l), J is affine in x_i, so the energy is exactly quadratic in x_i and F is
// never needed. With n = (x_k - x_j) x (x_l - x_j), c6 = 1 / (6 V) and the stiffness weights k_ij = V grad N_i . grad
// N_j:
//     J = c6 n . (x_i - x_j),   V F grad N_i = sum_j k_ij (x_j - x_i),   V dJ/dx_i = n / 6.
// Every sum below still lacks the factor h^2, which the vertex applies once.
#pragma once

#include "../core/vec.h"

namespace diffvbd {

// One (vertex, tet) pair as its vertex sees it; (j, i, k, l) is an even permutation of the tet.
template <class R>
struct TetPair {
  Vec3<R> xj, xk, xl;
  R k_ij, k_ik, k_il, c6;
  R mu, lam;
};

// What one reversed update adds to the adjoints of a pair's inputs (each with the sign and h^2 already applied).
template <class R>
struct TetPairAdjoint {
  Vec3<R> xi, xj, xk, xl;
  R mu, lam;
  R k_ij, k_ik, k_il, c6;
};

// Which adjoints beyond the state are wanted: those that a variant is compiled for, and of them those asked for.
enum Wanted { kState = 0, kMaterial = 1, kRest = 2 };

template <bool Exact>
struct StableNeoHookean {
  // g += dE/dx_i / h^2, and the block mu k I + (lh c6 / 6) n n^T; lh = lam + mu is the exact block, lam the paper's.
  template <class R>
  DIFFVBD_FN static void block(const TetPair<R>& e, const Vec3<R>& xi, Vec3<R>& g, R& h_diagonal, Sym3<R>& h_outer) {
    const R sixth = R(1) / R(6);
    const Vec3<R> ek = e.xk - e.xj, el = e.xl - e.xj, d = xi - e.xj;
    const Vec3<R> n = cross(ek, el);
    const R j_minus_1 = e.c6 * dot(n, d) - R(1);
    const R lb = e.mu + e.lam;
    const R a = sixth * (lb * j_minus_1 - e.mu);
    const Vec3<R> stretch = e.k_ik * (ek - d) + e.k_il * (el - d) - e.k_ij * d;
    g += e.mu * stretch + a * n;
    h_diagonal = h_diagonal - e.mu * (e.k_ij + e.k_ik + e.k_il);
    add_outer(h_outer, sixth * e.c6 * (Exact ? lb : e.lam), n);
  }

  // A tet as the adjoint of an update of x_i sees it. With the exact block g + H d_raw is g at x_i + d_raw, so the
  // Hessian tangent is had by evaluating there.
  template <class R>
  struct View {
    Vec3<R> ek, el, d, n;
    R n_p;     // n . p
    R strain;  // J - 1 at x_i; with the exact block at x_i + d_raw
    R after;   // J - 1 at x_i + d_raw
  };
  template <class R>
  DIFFVBD_FN static View<R> view(const TetPair<R>& e, const Vec3<R>& xi, const Vec3<R>& d_raw, const Vec3<R>& p) {
    const Vec3<R> at = Exact ? xi + d_raw : xi;
    const Vec3<R> ek = e.xk - e.xj, el = e.xl - e.xj, d = at - e.xj;
    const Vec3<R> n = cross(ek, el);
    const R strain = e.c6 * dot(n, d) - R(1);
    return {ek, el, d, n, dot(n, p), strain, Exact ? strain : strain + e.c6 * dot(n, d_raw)};
  }
  // 6 V times the factor of q in the gradient at x_i + d_raw
  template <class R>
  DIFFVBD_FN static R stress(const TetPair<R>& e, const View<R>& v) {
    if constexpr (Exact) return (e.mu + e.lam) * v.after - e.mu;
    return e.lam * v.after + e.mu * v.strain - e.mu;
  }

  // The adjoint of p . (g + H d_raw) times -h^2 (method.md, section 3; paper, eqs. 7-12, 14-15).
  template <int wanted, class R>
  DIFFVBD_FN static TetPairAdjoint<R> block_vjp(const TetPair<R>& e, const Vec3<R>& xi, const Vec3<R>& d_raw,
                                                const Vec3<R>& p, const R& minus_h2, int asked = wanted) {
    return view_vjp<wanted>(e, view(e, xi, d_raw, p), d_raw, p, minus_h2, asked);
  }
  template <int wanted, class R>
  DIFFVBD_FN static TetPairAdjoint<R> view_vjp(const TetPair<R>& e, const View<R>& v, const Vec3<R>& d_raw,
                                               const Vec3<R>& p, const R& minus_h2, int asked = wanted) {
    const R sixth = R(1) / R(6);
    const Vec3<R>&ek = v.ek, &el = v.el, &d = v.d, &n = v.n;
    const R lb = e.mu + e.lam, n_p = v.n_p;
    const R b = sixth * minus_h2;
    const R c6_n_p = e.c6 * n_p;
    const R along = b * lb * c6_n_p;

    Vec3<R> u = b * stress(e, v) * p + along * d;
    if constexpr (!Exact) u += b * e.lam * c6_n_p * d_raw;
    const R mu_h2 = minus_h2 * e.mu;
    const Vec3<R> w = mu_h2 * p, cut = along * n;

    TetPairAdjoint<R> out{};
    out.xk = e.k_ik * w + cross(el, u);
    out.xl = e.k_il * w + cross(u, ek);
    out.xi = cut - (e.k_ij + e.k_ik + e.k_il) * w;
    // dE depends on differences of positions only: the four adjoints sum to zero.
    out.xj = -(out.xi + out.xk + out.xl);
    const int more = wanted & asked;
    if (more != 0) {
      const R dj = -dot(d, p), dk = dot(ek - d, p), dl = dot(el - d, p);
      if (more & kMaterial) {
        R stretch = e.k_ij * dj + e.k_ik * dk + e.k_il * dl;
        if constexpr (!Exact) stretch = stretch - (e.k_ij + e.k_ik + e.k_il) * dot(d_raw, p);
        out.lam = b * v.after * n_p;
        out.mu = minus_h2 * stretch + b * (v.strain - R(1)) * n_p;
      }
      if (more & kRest) {
        const R tangent = Exact ? R(0) : dot(d_raw, p);
        out.k_ij = mu_h2 * (dj - tangent);
        out.k_ik = mu_h2 * (dk - tangent);
        out.k_il = mu_h2 * (dl - tangent);
        out.c6 = b * lb * n_p * dot(n, d);
        if constexpr (!Exact) out.c6 = out.c6 + b * e.lam * n_p * dot(n, d_raw);
      }
    }
    return out;
  }

  // Adds what small parts of d_raw and p, kept apart, do to n . p and to the strain.
  template <class R>
  DIFFVBD_FN static void correct(const TetPair<R>& e, View<R>& v, const Vec3<R>& d_low, const Vec3<R>& p_low) {
    v.n_p = v.n_p + dot(v.n, p_low);
    v.after = v.after + e.c6 * dot(v.n, d_low);
    if constexpr (Exact) v.strain = v.after;
  }

  // g_sum += dE/dx_i + (block) d_raw, p_sum += (block) p, both without h^2: what a solve has to meet, tet by tet.
  template <class R>
  DIFFVBD_FN static void apply(const TetPair<R>& e, const View<R>& v, const Vec3<R>& d_raw, const Vec3<R>& p,
                               Vec3<R>& g_sum, Vec3<R>& p_sum) {
    const R sixth = R(1) / R(6), k_ii = -(e.k_ij + e.k_ik + e.k_il);
    Vec3<R> stretch = e.k_ik * (v.ek - v.d) + e.k_il * (v.el - v.d) - e.k_ij * v.d;
    if constexpr (!Exact) stretch += k_ii * d_raw;
    g_sum += e.mu * stretch + sixth * stress(e, v) * v.n;
    p_sum += e.mu * k_ii * p + sixth * (Exact ? e.mu + e.lam : e.lam) * e.c6 * v.n_p * v.n;
  }
};

}  // namespace diffvbd
