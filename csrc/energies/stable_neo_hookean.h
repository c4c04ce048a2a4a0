// Stable Neo-Hookean tets (Smith et al. 2018; paper, appendix on closed forms): P = mu F + (lb (J - 1) - mu) cof F, lb
// = mu + lam.
//
// Seen from one vertex i of a tet (i, j, k, l), J is affine in x_i, so the energy is exactly quadratic in x_i and F is
// never needed. With n = (x_k - x_j) x (x_l - x_j), c6 = 1 / (6 V) and the stiffness weights k_ij = V grad N_i . grad
// N_j:
//     J = c6 n . (x_i - x_j),   V F grad N_i = sum_j k_ij (x_j - x_i),   V dJ/dx_i = n / 6.
// Every sum below still lacks the factor h^2, which the vertex applies once.
#pragma once

#include <limits>

#include "tet.h"

namespace diffvbd {

template <bool Exact>
struct StableNeoHookean {
  static constexpr bool quadratic = true;  // in the position of one vertex
  // The material of a tet: mu, lam [Pa].
  template <class Pair>
  DIFFVBD_FN static const auto& mu(const Pair& e) {
    return e.material[0];
  }
  template <class Pair>
  DIFFVBD_FN static const auto& lam(const Pair& e) {
    return e.material[1];
  }
  static constexpr const char* material_names[] = {"mu", "lam"};
  // what is expected of the scalar `which` of a material, if it is not met, or null
  template <class T>
  static const char* invalid(const T* material, int which) {
    const T mu = material[0], lam = material[1], most = std::numeric_limits<T>::max();
    if (which == 0) return mu >= 0 && mu <= most ? nullptr : "mu: expected finite values >= 0 Pa";
    if (Exact) return lam + mu >= 0 && lam <= most ? nullptr : "lam: expected finite values with mu + lam >= 0 Pa";
    return lam >= 0 && lam <= most ? nullptr : "lam: expected finite values >= 0 Pa with block=\"paper\"";
  }
  // Its rest shape as the vertex sees it: k_ij, k_ik, k_il [m], c6 [1/m^3].
  template <class Pair>
  DIFFVBD_FN static const auto& k_ij(const Pair& e) {
    return e.rest[0];
  }
  template <class Pair>
  DIFFVBD_FN static const auto& k_ik(const Pair& e) {
    return e.rest[1];
  }
  template <class Pair>
  DIFFVBD_FN static const auto& k_il(const Pair& e) {
    return e.rest[2];
  }
  template <class Pair>
  DIFFVBD_FN static const auto& c6(const Pair& e) {
    return e.rest[3];
  }

  // g += dE/dx_i / h^2, and the block mu k I + (lh c6 / 6) n n^T; lh = lam + mu is the exact block, lam the paper's.
  template <class Pair, class R>
  DIFFVBD_FN static void block(const Pair& e, const Vec3<R>& xi, Vec3<R>& g, R& h_diagonal, Sym3<R>& h_outer) {
    const R sixth = R(1) / R(6);
    const Vec3<R> ek = e.xk - e.xj, el = e.xl - e.xj, d = xi - e.xj;
    const Vec3<R> n = cross(ek, el);
    const R j_minus_1 = c6(e) * dot(n, d) - R(1);
    const R lb = mu(e) + lam(e);
    const R a = sixth * (lb * j_minus_1 - mu(e));
    const Vec3<R> stretch = k_ik(e) * (ek - d) + k_il(e) * (el - d) - k_ij(e) * d;
    g += mu(e) * stretch + a * n;
    h_diagonal = h_diagonal - mu(e) * (k_ij(e) + k_ik(e) + k_il(e));
    add_outer(h_outer, sixth * c6(e) * (Exact ? lb : lam(e)), n);
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
  template <class Pair, class R>
  DIFFVBD_FN static View<R> view(const Pair& e, const Vec3<R>& xi, const Vec3<R>& d_raw, const Vec3<R>& p) {
    const Vec3<R> at = Exact ? xi + d_raw : xi;
    const Vec3<R> ek = e.xk - e.xj, el = e.xl - e.xj, d = at - e.xj;
    const Vec3<R> n = cross(ek, el);
    const R strain = c6(e) * dot(n, d) - R(1);
    return {ek, el, d, n, dot(n, p), strain, Exact ? strain : strain + c6(e) * dot(n, d_raw)};
  }
  // 6 V times the factor of q in the gradient at x_i + d_raw
  template <class Pair, class R>
  DIFFVBD_FN static R stress(const Pair& e, const View<R>& v) {
    if constexpr (Exact) return (mu(e) + lam(e)) * v.after - mu(e);
    return lam(e) * v.after + mu(e) * v.strain - mu(e);
  }

  // The adjoint of p . (g + H d_raw) times -h^2 (method.md, section 3; paper, eqs. 7-12, 14-15): of the corners, of the
  // material, of the rest shape.
  template <class Pair, class R>
  DIFFVBD_FN static TetAdjoint<R> block_vjp(const Pair& e, const View<R>& v, const Vec3<R>& d_raw, const Vec3<R>& p,
                                            const R& minus_h2) {
    const R sixth = R(1) / R(6), lb = mu(e) + lam(e);
    const R b = sixth * minus_h2;
    const R c6_n_p = c6(e) * v.n_p;
    const R along = b * lb * c6_n_p;

    Vec3<R> u = b * stress(e, v) * p + along * v.d;
    if constexpr (!Exact) u += b * lam(e) * c6_n_p * d_raw;
    const R mu_h2 = minus_h2 * mu(e);
    const Vec3<R> w = mu_h2 * p, along_n = along * v.n;

    TetAdjoint<R> out;
    out.xk = k_ik(e) * w + cross(v.el, u);
    out.xl = k_il(e) * w + cross(u, v.ek);
    out.xi = along_n - (k_ij(e) + k_ik(e) + k_il(e)) * w;
    // dE depends on differences of positions only: the four adjoints sum to zero.
    out.xj = -(out.xi + out.xk + out.xl);
    return out;
  }
  template <class Pair, class R>
  DIFFVBD_FN static void material_vjp(const Pair& e, const View<R>& v, const Vec3<R>& d_raw, const Vec3<R>& p,
                                      const R& minus_h2, R* material_bar) {
    const R b = R(1) / R(6) * minus_h2;
    const R dj = -dot(v.d, p), dk = dot(v.ek - v.d, p), dl = dot(v.el - v.d, p);
    R stretch = k_ij(e) * dj + k_ik(e) * dk + k_il(e) * dl;
    if constexpr (!Exact) stretch = stretch - (k_ij(e) + k_ik(e) + k_il(e)) * dot(d_raw, p);
    material_bar[0] = minus_h2 * stretch + b * (v.strain - R(1)) * v.n_p;
    material_bar[1] = b * v.after * v.n_p;
  }
  template <class Pair, class R>
  DIFFVBD_FN static void rest_vjp(const Pair& e, const View<R>& v, const Vec3<R>& d_raw, const Vec3<R>& p,
                                  const R& minus_h2, R* rest_bar) {
    const R b = R(1) / R(6) * minus_h2, mu_h2 = minus_h2 * mu(e), lb = mu(e) + lam(e);
    const R dj = -dot(v.d, p), dk = dot(v.ek - v.d, p), dl = dot(v.el - v.d, p);
    const R tangent = Exact ? R(0) : dot(d_raw, p);
    rest_bar[0] = mu_h2 * (dj - tangent);
    rest_bar[1] = mu_h2 * (dk - tangent);
    rest_bar[2] = mu_h2 * (dl - tangent);
    rest_bar[3] = b * lb * v.n_p * dot(v.n, v.d);
    if constexpr (!Exact) rest_bar[3] = rest_bar[3] + b * lam(e) * v.n_p * dot(v.n, d_raw);
  }

  // The derivative of the gradient dE/dx_i / h^2 at the view's state along the motion w of the four corners: the tet's
  // rows of the Hessian times w. Both blocks are of one energy, so of the same Hessian; the view's d_raw is 0.
  template <class Pair, class R>
  DIFFVBD_FN static Vec3<R> product(const Pair& e, const View<R>& v, const Vec3<R>& wi, const Vec3<R>& wj,
                                    const Vec3<R>& wk, const Vec3<R>& wl) {
    const R sixth = R(1) / R(6), lb = mu(e) + lam(e);
    const Vec3<R> fk = wk - wj, fl = wl - wj, f = wi - wj;
    const Vec3<R> turn = cross(fk, v.el) + cross(v.ek, fl);  // of n
    const R strain = c6(e) * (dot(turn, v.d) + dot(v.n, f));
    const Vec3<R> stretch = k_ik(e) * (fk - f) + k_il(e) * (fl - f) - k_ij(e) * f;
    return mu(e) * stretch + sixth * (lb * strain * v.n + stress(e, v) * turn);
  }

  // The energy of a tet [J] from its four corners, up to a constant.
  template <class R>
  DIFFVBD_FN static R value(const Vec3<R> (&x)[4], const R* rest, const R* material) {
    const R mu = material[0], lam = material[1], c6 = rest[6];
    R shear = R(0);
    for (int a = 0; a < 4; ++a) {
      for (int b = a + 1; b < 4; ++b) {
        const Vec3<R> edge = x[b] - x[a];
        shear = shear - rest[weight_index(a, b)] * dot(edge, edge);
      }
    }
    const R strain = c6 * dot(x[1] - x[0], cross(x[2] - x[0], x[3] - x[0])) - R(1);
    return R(0.5) * mu * shear + (R(0.5) * (mu + lam) * strain * strain - mu * strain) / (R(6) * c6);
  }

  // The energy of a tet at x + s p less that at x, a polynomial in s: adds its coefficients of s, s^2, ... s^6.
  template <class R>
  DIFFVBD_FN static void line(const Vec3<R> (&x)[4], const Vec3<R> (&p)[4], const R* rest, const R* material,
                              R (&c)[TetLayout::line_degree]) {
    const R mu = material[0], lam = material[1], c6 = rest[6], half = R(1) / R(2);
    R first = R(0), second = R(0);
    for (int a = 0; a < 4; ++a) {
      for (int b = a + 1; b < 4; ++b) {
        const Vec3<R> e = x[b] - x[a], f = p[b] - p[a];
        first = first - rest[weight_index(a, b)] * dot(e, f);
        second = second - rest[weight_index(a, b)] * dot(f, f);
      }
    }
    const Vec3<R> e1 = x[1] - x[0], e2 = x[2] - x[0], e3 = x[3] - x[0];
    const Vec3<R> f1 = p[1] - p[0], f2 = p[2] - p[0], f3 = p[3] - p[0];
    const Vec3<R> n = cross(e2, e3), m = cross(f2, e3) + cross(e2, f3), o = cross(f2, f3);
    // the strain is strain + q, q = j1 s + j2 s^2 + j3 s^3
    const R strain = c6 * dot(e1, n) - R(1);
    const R j1 = c6 * (dot(f1, n) + dot(e1, m)), j2 = c6 * (dot(f1, m) + dot(e1, o)), j3 = c6 * dot(f1, o);
    const R volume = R(1) / (R(6) * c6), b = volume * half * (mu + lam), t = R(2) * b * strain - volume * mu;
    c[0] = c[0] + mu * first + t * j1;
    c[1] = c[1] + half * mu * second + t * j2 + b * j1 * j1;
    c[2] = c[2] + t * j3 + R(2) * b * j1 * j2;
    c[3] = c[3] + b * (R(2) * j1 * j3 + j2 * j2);
    c[4] = c[4] + R(2) * b * j2 * j3;
    c[5] = c[5] + b * j3 * j3;
  }

  // Its derivative along p at x, and by how much more than that it changes up to x + p.
  template <bool, class R>
  DIFFVBD_FN static void path(const Vec3<R> (&x)[4], const Vec3<R> (&p)[4], const R* rest, const R* material, R& slope,
                              R& bend) {
    R c[TetLayout::line_degree]{};
    line(x, p, rest, material, c);
    slope = c[0], bend = R(0);
    for (int k = 1; k < TetLayout::line_degree; ++k) bend = bend + c[k];
  }

  // The stiffness of two corners at rest, per volume [Pa/m^2], from the gradients of their shape functions [1/m]: three
  // rows of 2 mu eps : eps + lam tr(eps)^2. Positive semidefinite down to the least lam that a body can have.
  template <class R>
  DIFFVBD_FN static void rest_stiffness(const Vec3<R>& a, const Vec3<R>& b, const R* material, Vec3<R> (&rows)[3]) {
    const R mu = material[0], least = R(-2) / R(3) * mu, lam = select(material[1] < least, least, material[1]);
    const R both = mu * dot(a, b);
    rows[0] = mu * b.x * a + lam * a.x * b + Vec3<R>{both, R(0), R(0)};
    rows[1] = mu * b.y * a + lam * a.y * b + Vec3<R>{R(0), both, R(0)};
    rows[2] = mu * b.z * a + lam * a.z * b + Vec3<R>{R(0), R(0), both};
  }

  // Adds what small parts of d_raw and p, kept apart, do to n . p and to the strain.
  template <class Pair, class R>
  DIFFVBD_FN static void correct(const Pair& e, View<R>& v, const Vec3<R>& d_low, const Vec3<R>& p_low) {
    v.n_p = v.n_p + dot(v.n, p_low);
    v.after = v.after + c6(e) * dot(v.n, d_low);
    if constexpr (Exact) v.strain = v.after;
  }

  // g_sum += dE/dx_i + (block) d_raw, p_sum += (block) p, both without h^2: what a solve has to meet, tet by tet.
  template <class Pair, class R>
  DIFFVBD_FN static void apply(const Pair& e, const View<R>& v, const Vec3<R>& d_raw, const Vec3<R>& p, Vec3<R>& g_sum,
                               Vec3<R>& p_sum) {
    const R sixth = R(1) / R(6), k_ii = -(k_ij(e) + k_ik(e) + k_il(e));
    Vec3<R> stretch = k_ik(e) * (v.ek - v.d) + k_il(e) * (v.el - v.d) - k_ij(e) * v.d;
    if constexpr (!Exact) stretch += k_ii * d_raw;
    g_sum += mu(e) * stretch + sixth * stress(e, v) * v.n;
    p_sum += mu(e) * k_ii * p + sixth * (Exact ? mu(e) + lam(e) : lam(e)) * c6(e) * v.n_p * v.n;
  }
};

}  // namespace diffvbd
