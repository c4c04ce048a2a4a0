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

// Which adjoints beyond the state are wanted.
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

  // The adjoint of p . (g + H d_raw) times -h^2 (method.md, section 3; paper, eqs. 7-12, 14-15). With the exact block
  // g + H d_raw is g at x_i + d_raw, so the Hessian tangent is had by evaluating there and dropping d_raw.
  template <int wanted, class R>
  DIFFVBD_FN static TetPairAdjoint<R> block_vjp(const TetPair<R>& e, const Vec3<R>& xi, const Vec3<R>& d_raw,
                                                const Vec3<R>& p, const R& minus_h2) {
    const R sixth = R(1) / R(6);
    const Vec3<R> at = Exact ? xi + d_raw : xi;
    const Vec3<R> ek = e.xk - e.xj, el = e.xl - e.xj, d = at - e.xj;
    const Vec3<R> n = cross(ek, el);
    const R lb = e.mu + e.lam;
    const R n_p = dot(n, p), n_d = dot(n, d);
    const R j_minus_1 = e.c6 * n_d - R(1);
    const R b = sixth * minus_h2;
    const R c6_n_p = e.c6 * n_p;
    const R along = b * lb * c6_n_p;

    Vec3<R> u = b * (lb * j_minus_1 - e.mu) * p + along * d;
    R n_raw = R(0);
    if constexpr (!Exact) {
      n_raw = dot(n, d_raw);
      const R c = b * e.lam * e.c6;
      u += c * n_raw * p + c * n_p * d_raw;
    }
    const R mu_h2 = minus_h2 * e.mu;
    const Vec3<R> w = mu_h2 * p, cut = along * n;

    TetPairAdjoint<R> out{};
    out.xk = e.k_ik * w + cross(el, u);
    out.xl = e.k_il * w + cross(u, ek);
    out.xi = cut - (e.k_ij + e.k_ik + e.k_il) * w;
    // dE depends on differences of positions only: the four adjoints sum to zero.
    out.xj = -(out.xi + out.xk + out.xl);
    if constexpr ((wanted & (kMaterial | kRest)) != 0) {
      const R dj = -dot(d, p), dk = dot(ek - d, p), dl = dot(el - d, p);
      if constexpr ((wanted & kMaterial) != 0) {
        R stretch = e.k_ij * dj + e.k_ik * dk + e.k_il * dl;
        R bulk = sixth * j_minus_1 * n_p;
        R shear = sixth * n_p;
        if constexpr (!Exact) {
          stretch = stretch - (e.k_ij + e.k_ik + e.k_il) * dot(d_raw, p);
          out.lam = minus_h2 * (bulk + sixth * n_raw * c6_n_p);
        } else {
          out.lam = minus_h2 * bulk;
        }
        out.mu = minus_h2 * (stretch + bulk - shear);
      }
      if constexpr ((wanted & kRest) != 0) {
        const R tangent = Exact ? R(0) : dot(d_raw, p);
        out.k_ij = mu_h2 * (dj - tangent);
        out.k_ik = mu_h2 * (dk - tangent);
        out.k_il = mu_h2 * (dl - tangent);
        out.c6 = b * (lb * n_d * n_p);
        if constexpr (!Exact) out.c6 = out.c6 + b * (e.lam * n_raw * n_p);
      }
    }
    return out;
  }
};

}  // namespace diffvbd
