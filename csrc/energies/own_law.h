// A law that a user has given as an energy density psi(I1, I2, J, I4): its derivatives by the invariants are generated
// (DIFFVBD_LAW_HEADER: struct Density, written by diffvbd/laws/generate.py), everything else stands here. It takes the
// place of StableNeoHookean, has the same interface, and its sums lack the same factor h^2.
//
// As there, a tet is seen through the stiffness weights k_ab = V grad N_a . grad N_b and c6 = 1 / (6 V). With its edges
// e_ab, and w_k the derivative of psi by the k-th invariant:
//     B = F F^T = -6 c6 sum k_ab e_ab e_ab^T,    I1 = tr B,    I2 = (I1^2 - tr B^2) / 2,    J = c6 n . (x_i - x_j),
//     V dpsi = -2 sum k_ab (W e_ab) . de_ab + w_J / 6 d(n . (x_i - x_j)) + V w_4 d|F a|^2,    W = w_1 + w_2 (I1 - B).
// A fibre a has F a = sum b_a x_a with b_a = a . grad N_a, and I4 = |F a|^2.
#pragma once

#include "../core/hyper_dual.h"
#include "../core/safeguards.h"
#include "stable_neo_hookean.h"
#include "tet.h"

#ifdef __CUDACC__
#define DIFFVBD_INLINED
#else
#define DIFFVBD_INLINED __attribute__((always_inline))
#endif

namespace diffvbd {

template <class A, class B>
DIFFVBD_FN auto times(const A& s, const Vec3<B>& v) -> Vec3<decltype(s * v.x)> {
  return {s * v.x, s * v.y, s * v.z};
}
template <class A, class B>
DIFFVBD_FN auto times(const Sym3<A>& m, const Vec3<B>& v) -> Vec3<decltype(m.xx * v.x)> {
  return {m.xx * v.x + m.xy * v.y + m.xz * v.z, m.xy * v.x + m.yy * v.y + m.yz * v.z,
          m.xz * v.x + m.yz * v.y + m.zz * v.z};
}
template <class A, class B>
DIFFVBD_FN auto inner(const Vec3<A>& a, const Vec3<B>& b) -> decltype(a.x * b.x) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}
template <class A, class B>
DIFFVBD_FN auto plus(const Vec3<A>& a, const Vec3<B>& b) -> Vec3<decltype(a.x + b.x)> {
  return {a.x + b.x, a.y + b.y, a.z + b.z};
}
// to += s v v^T
template <class S, class A, class B>
DIFFVBD_FN void add_square(Sym3<S>& to, const A& s, const Vec3<B>& v) {
  const auto w = times(s, v);
  to = {to.xx + w.x * v.x, to.xy + w.x * v.y, to.xz + w.x * v.z,
        to.yy + w.y * v.y, to.yz + w.y * v.z, to.zz + w.z * v.z};
}

// The sum of the principal stretches, tr U with F = R U: the largest root of s^4 - 2 I1 s^2 - 8 J s + I1^2 - 4 I2, by
// Newton's method from above. Its derivatives follow from two more iterations in the numbers of the invariants.
template <class S>
DIFFVBD_FN S newton_of_stretches(const S& s, const S& i1, const S& i2, const S& j) {
  using R = std::decay_t<decltype(value_of(s))>;
  const S square = s * s, inside = square - i1, q = inside * inside - R(4) * i2 - R(8) * (j * s);
  return s - q / (R(4) * (s * inside) - R(8) * j);
}
template <class S>
DIFFVBD_FN S stretch_sum(const S& i1, const S& i2, const S& j) {
  constexpr int kIterations = 12;
  const auto a = value_of(i1), b = value_of(i2), c = value_of(j);
  auto s = square_root(a + a + a);
  for (int k = 0; k < kIterations; ++k) s = newton_of_stretches(s, a, b, c);
  if constexpr (std::is_same_v<S, std::decay_t<decltype(s)>>) {
    return s;
  } else {
    return newton_of_stretches(newton_of_stretches(S(s), i1, i2, j), i1, i2, j);
  }
}

struct OwnLaw {
  static constexpr bool quadratic = Density::quadratic;  // psi in the position of one vertex
  static constexpr const char* material_names[] = {"mu", "lam"};
  template <class T>
  static const char* invalid(const T*, int) {
    return nullptr;  // Python has looked at the parameters
  }

  // --- a tet as one of its vertices sees it

  using L = TetLayout;
  template <class R>
  DIFFVBD_FN static const R& c6(const TetPair<R>& e) {
    return e.rest[L::pair_c6];
  }
  template <class R>
  DIFFVBD_FN static R own_weight(const TetPair<R>& e) {
    return -(e.rest[0] + e.rest[1] + e.rest[2]);
  }
  template <class R>
  DIFFVBD_FN static R own_fibre(const TetPair<R>& e) {
    return -(e.rest[L::pair_fibre] + e.rest[L::pair_fibre + 1] + e.rest[L::pair_fibre + 2]);
  }
  template <class R>
  DIFFVBD_FN static R volume(const R& c6) {  // 0 of a pair that fills up a block
    const auto real = R(0) < c6;
    return select(real, R(1) / (R(6) * select(real, c6, R(1))), R(0));
  }

  // The viscosity, as a law of another rest shape.
  using Viscous = StableNeoHookean<true>;
  template <class R>
  struct ViscousPair {
    Vec3<R> xj, xk, xl;
    R rest[4], material[2];
    DIFFVBD_FN explicit ViscousPair(const TetPair<R>& e) : xj(e.xj), xk(e.xk), xl(e.xl) {
      const R* own = e.rest + L::pair_viscous;
      for (int i = 0; i < 4; ++i) rest[i] = own[i];
      material[0] = own[4], material[1] = own[5];
    }
  };
  struct None {};
  template <class R>
  using ViscousView = std::conditional_t<kViscous, Viscous::View<R>, None>;

  // The invariants, of positions in numbers S that move with x_i.
  template <class R, class S>
  struct Shape {
    Vec3<R> ek, el, n;
    Vec3<S> d;      // x_i - x_j
    Sym3<S> m;      // I1 - B, with I2
    Vec3<S> fibre;  // F a, with I4
    Invariants<S> v;
  };
  template <class R, class S>
  DIFFVBD_FN static Shape<R, S> shape(const TetPair<R>& e, const Vec3<S>& d) {
    Shape<R, S> s{};
    s.ek = e.xk - e.xj, s.el = e.xl - e.xj, s.d = d;
    s.n = cross(s.ek, s.el);
    s.v.j = c6(e) * inner(s.n, d);
    const Vec3<S> ik = plus(s.ek, -d), il = plus(s.el, -d);
    const R* k = e.rest;
    const R scale = R(-6) * c6(e);
    if constexpr (!L::edges) {  // I1 but for a constant
      s.v.i1 = scale * (k[0] * inner(d, d) + k[1] * inner(ik, ik) + k[2] * inner(il, il));
    } else {
      const Vec3<R> kl = s.el - s.ek;
      if constexpr (Density::second) {
        Sym3<R> still = diagonal(R(0));
        add_square(still, k[3], s.ek), add_square(still, k[4], s.el), add_square(still, k[5], kl);
        Sym3<S> b{S(still.xx), S(still.xy), S(still.xz), S(still.yy), S(still.yz), S(still.zz)};
        add_square(b, k[0], d), add_square(b, k[1], ik), add_square(b, k[2], il);
        b = {scale * b.xx, scale * b.xy, scale * b.xz, scale * b.yy, scale * b.yz, scale * b.zz};
        set_second(b, s.v, s.m);
      } else {
        const R still = k[3] * dot(s.ek, s.ek) + k[4] * dot(s.el, s.el) + k[5] * dot(kl, kl);
        s.v.i1 = scale * (k[0] * inner(d, d) + k[1] * inner(ik, ik) + k[2] * inner(il, il) + still);
      }
    }
    if constexpr (Density::fibre) {
      const R *b = e.rest + L::pair_fibre, own = own_fibre(e);
      s.fibre = plus(b[1] * s.ek + b[2] * s.el, times(own, d));
      s.v.i4 = inner(s.fibre, s.fibre);
    }
    settle(s.v, c6(e));
    return s;
  }
  // I1, I2 and I1 - B
  template <class S>
  DIFFVBD_FN static void set_second(const Sym3<S>& b, Invariants<S>& v, Sym3<S>& m) {
    v.i1 = b.xx + b.yy + b.zz;
    v.i2 = (b.xx * b.yy - b.xy * b.xy) + (b.yy * b.zz - b.yz * b.yz) + (b.zz * b.xx - b.xz * b.xz);
    m = {v.i1 - b.xx, -b.xy, -b.xz, v.i1 - b.yy, -b.yz, v.i1 - b.zz};
  }
  // A pair that fills up a block is at rest, where any psi is a number; a small J is split.
  template <class S, class R>
  DIFFVBD_FN static void settle(Invariants<S>& v, const R& c6) {
    if constexpr (!quadratic) {
      const auto real = R(0) < c6;
      v.i1 = select(real, v.i1, S(R(3))), v.i2 = select(real, v.i2, S(R(3)));
      v.j = select(real, v.j, S(R(1))), v.i4 = select(real, v.i4, S(R(1)));
    }
    if constexpr (Density::guarded) {
      const R least = R(kLeastVolume);
      const auto small = value_of(v.j) < least;
      v.below = select(small, v.j - least, S(R(0)));
      v.j = select(small, S(least), v.j);
    }
  }

  // W e, where W is a plain scalar without I2
  template <class S, class M, class E>
  DIFFVBD_FN static auto stressed(const Slopes<S>& w, const Sym3<M>& m, const Vec3<E>& e) {
    if constexpr (Density::second) {
      return plus(times(w.i1, e), times(w.i2, times(m, e)));
    } else if constexpr (!L::edges) {  // w_1 depends on no invariant
      return times(value_of(w.i1), e);
    } else {
      return times(w.i1, e);
    }
  }

  template <class R>
  DIFFVBD_FN static Vec3<R> stretch(const TetPair<R>& e, const Vec3<R>& ek, const Vec3<R>& el, const Vec3<R>& d) {
    return e.rest[1] * (ek - d) + e.rest[2] * (el - d) - e.rest[0] * d;
  }

  // g += dE/dx_i / h^2 and the exact block.
  template <class R>
  DIFFVBD_FN static void block(const TetPair<R>& e, const Vec3<R>& xi, Vec3<R>& g, R& h_diagonal, Sym3<R>& h_outer) {
    const Shape<R, R> s = shape(e, xi - e.xj);
    const R* p = e.rest + L::pair_parameters;
    const Slopes<R> w = Density::slopes(s.v, p);
    const auto c = Density::curvatures(s.v, p);
    const R sixth = R(1) / R(6), k = own_weight(e);
    const Vec3<R> f = stretch(e, s.ek, s.el, s.d);
    // V grad I_k grad I_l^T = a_k a_l^T times 24 c6, 2 c6, c6 / 6 ...: factors of V stay out of what has none
    Vec3<R> a[4] = {f, zero3<R>(), s.n, zero3<R>()};
    g += R(2) * w.i1 * f + sixth * w.j * s.n;
    h_diagonal = h_diagonal + R(2) * w.i1 * k;
    if constexpr (Density::second) {
      const Vec3<R> mf = a[1] = s.m * f;
      g += R(2) * w.i2 * mf;
      h_outer += (R(2) * w.i2 * k) * s.m;
      const R twelve = R(12) * c6(e) * w.i2;
      add_outer(h_outer, twelve, f);
      h_diagonal = h_diagonal - twelve * dot(f, f);
    }
    if constexpr (Density::fibre) {
      const R b = own_fibre(e), of_volume = R(2) * volume(c6(e)) * w.i4 * b;
      a[3] = b * s.fibre;
      g += of_volume * s.fibre;
      h_diagonal = h_diagonal + of_volume * b;
    }
    const R scales[4] = {R(12) * c6(e), R(12) * c6(e), c6(e), R(2)};  // of grad I_k = scale a_k
    each_below<4>([&](auto row) DIFFVBD_INLINED {
      constexpr int i = decltype(row)::value;
      if constexpr (Density::couples(i)) {
        Vec3<R> sum = zero3<R>();
        each_below<4>([&](auto column) DIFFVBD_INLINED {
          constexpr int l = decltype(column)::value;
          if constexpr (Density::couples(i, l)) {
            // V scale_i scale_l, in which V c6 = 1 / 6
            const R factor = i == 3 && l == 3 ? volume(c6(e)) * R(4)
                             : i == 3         ? sixth * R(2) * scale_over_c6<R>(l)
                             : l == 3         ? sixth * R(2) * scale_over_c6<R>(i)
                                              : sixth * scale_over_c6<R>(i) * scales[l];
            sum += (factor * c.of[curvature_place(i, l)]) * a[l];
          }
        });
        h_outer.xx = h_outer.xx + a[i].x * sum.x, h_outer.xy = h_outer.xy + a[i].x * sum.y;
        h_outer.xz = h_outer.xz + a[i].x * sum.z, h_outer.yy = h_outer.yy + a[i].y * sum.y;
        h_outer.yz = h_outer.yz + a[i].y * sum.z, h_outer.zz = h_outer.zz + a[i].z * sum.z;
      }
    });
    if constexpr (kViscous) Viscous::block(ViscousPair<R>(e), xi, g, h_diagonal, h_outer);
  }
  template <class R>
  DIFFVBD_FN static constexpr R scale_over_c6(int i) {
    return i < 2 ? R(12) : R(1);
  }

  // --- the adjoint of p . (g + H d): phi is the derivative of V psi along p and the mixed one along p and d, so its
  // own derivatives are those of V psi by corners, rest shape and parameters, in numbers that carry both directions.
  // Where psi is quadratic in x_i, g + H d is g at x_i + d, and one direction will do.

  template <class R>
  using Number = std::conditional_t<quadratic, Dual<R>, Hyper<R>>;
  template <class R>
  DIFFVBD_FN static Dual<R> moving(const R& x, const R& d, const R& p, const Dual<R>*) {
    return {x + d, p};
  }
  template <class R>
  DIFFVBD_FN static Hyper<R> moving(const R& x, const R& d, const R& p, const Hyper<R>*) {
    return {x, p, d, R(0)};
  }
  template <class R>
  struct View {
    Shape<R, Number<R>> s;
    Slopes<Number<R>> w;
    ViscousView<R> second;
  };
  template <class R>
  DIFFVBD_FN static View<R> view(const TetPair<R>& e, const Vec3<R>& xi, const Vec3<R>& d_raw, const Vec3<R>& p) {
    const Number<R>* number = nullptr;
    const Vec3<R> d = xi - e.xj;
    View<R> v{shape(e, Vec3<Number<R>>{moving(d.x, d_raw.x, p.x, number), moving(d.y, d_raw.y, p.y, number),
                                       moving(d.z, d_raw.z, p.z, number)}),
              {},
              {}};
    v.w = Density::slopes(v.s.v, e.rest + L::pair_parameters);
    if constexpr (kViscous) v.second = Viscous::view(ViscousPair<R>(e), xi, d_raw, p);
    return v;
  }

  template <class R>
  DIFFVBD_FN static TetAdjoint<R> block_vjp(const TetPair<R>& e, const View<R>& v, const Vec3<R>& d_raw,
                                            const Vec3<R>& p, const R& minus_h2) {
    const R* k = e.rest;
    const auto& s = v.s;
    const R twice = R(-2) * minus_h2, sixth = R(1) / R(6) * minus_h2;
    const auto pulled = [&](const R& weight, const auto& edge)
                            DIFFVBD_INLINED { return (twice * weight) * extract(stressed(v.w, s.m, edge)); };
    const Vec3<R> ij = pulled(k[0], s.d), ik = pulled(k[1], plus(s.ek, -s.d)), il = pulled(k[2], plus(s.el, -s.d));
    const Vec3<R> u = sixth * extract(times(v.w.j, s.d));
    TetAdjoint<R> out;
    out.xi = ij - ik - il + (sixth * extract(v.w.j)) * s.n;
    out.xk = ik + cross(s.el, u);
    out.xl = il + cross(u, s.ek);
    if constexpr (L::edges) {
      const auto still = [&](const R& weight, const Vec3<R>& edge)
                             DIFFVBD_INLINED { return (twice * weight) * extract(stressed(v.w, s.m, edge)); };
      const Vec3<R> kl = still(k[5], s.el - s.ek);
      out.xk += still(k[3], s.ek) - kl;
      out.xl += still(k[4], s.el) + kl;
    }
    if constexpr (Density::fibre) {
      const R* b = e.rest + L::pair_fibre;
      const Vec3<R> t = (R(2) * minus_h2 * volume(c6(e))) * extract(times(v.w.i4, s.fibre));
      out.xi += own_fibre(e) * t, out.xk += b[1] * t, out.xl += b[2] * t;
    }
    if constexpr (kViscous) {
      const TetAdjoint<R> more = Viscous::block_vjp(ViscousPair<R>(e), v.second, d_raw, p, minus_h2);
      out.xi += more.xi, out.xk += more.xk, out.xl += more.xl;
    }
    out.xj = -(out.xi + out.xk + out.xl);
    return out;
  }
  template <class R>
  DIFFVBD_FN static void material_vjp(const TetPair<R>&, const View<R>&, const Vec3<R>&, const Vec3<R>&, const R&,
                                      R* material_bar) {
    material_bar[0] = material_bar[1] = R(0);  // moduli at rest, which no sweep reads
  }
  template <class R>
  DIFFVBD_FN static void rest_vjp(const TetPair<R>& e, const View<R>& v, const Vec3<R>& d_raw, const Vec3<R>& of,
                                  const R& minus_h2, R* rest_bar) {
    const auto& s = v.s;
    const R* p = e.rest + L::pair_parameters;
    if constexpr (kViscous) {
      const ViscousPair<R> second(e);
      Viscous::rest_vjp(second, v.second, d_raw, of, minus_h2, rest_bar + L::pair_viscous);
      Viscous::material_vjp(second, v.second, d_raw, of, minus_h2, rest_bar + L::pair_viscous + 4);
    }
    const R of_volume = minus_h2 * volume(c6(e));
    const auto squared = [&](const auto& edge)
                             DIFFVBD_INLINED { return -(minus_h2 * extract(inner(edge, stressed(v.w, s.m, edge)))); };
    rest_bar[0] = squared(s.d), rest_bar[1] = squared(plus(s.ek, -s.d)), rest_bar[2] = squared(plus(s.el, -s.d));
    if constexpr (L::edges) {
      rest_bar[3] = squared_still(v, s.ek, minus_h2), rest_bar[4] = squared_still(v, s.el, minus_h2);
      rest_bar[5] = squared_still(v, s.el - s.ek, minus_h2);
    }
    rest_bar[L::pair_c6] = R(6) * of_volume * volume(c6(e)) * extract(Density::by_scale(s.v, p));
    if constexpr (Density::fibre) {
      const auto t = times(v.w.i4, s.fibre);
      const R two = R(2) * of_volume;
      rest_bar[L::pair_fibre] = -(two * extract(inner(t, s.d)));
      rest_bar[L::pair_fibre + 1] = two * extract(inner(t, plus(s.ek, -s.d)));
      rest_bar[L::pair_fibre + 2] = two * extract(inner(t, plus(s.el, -s.d)));
    }
    if constexpr (Density::parameters > 0) {
      Number<R> slopes[Density::parameters];
      Density::by_parameters(s.v, p, slopes);
      for (int i = 0; i < Density::parameters; ++i) rest_bar[L::pair_parameters + i] = of_volume * extract(slopes[i]);
    }
  }
  template <class R>
  DIFFVBD_FN static R squared_still(const View<R>& v, const Vec3<R>& edge, const R& minus_h2) {
    return -(minus_h2 * extract(inner(edge, stressed(v.w, v.s.m, edge))));
  }

  // The derivative of dE/dx_i / h^2 along the motion w of the four corners.
  template <class R>
  DIFFVBD_FN static Vec3<R> product(const TetPair<R>& e, const View<R>& v, const Vec3<R>& wi, const Vec3<R>& wj,
                                    const Vec3<R>& wk, const Vec3<R>& wl) {
    const Vec3<R> at{value_of(v.s.d.x), value_of(v.s.d.y), value_of(v.s.d.z)};
    const auto along = [](const Vec3<R>& x, const Vec3<R>& w) {
      return Vec3<Dual<R>>{{x.x, w.x}, {x.y, w.y}, {x.z, w.z}};
    };
    const Vec3<Dual<R>> d = along(at, wi - wj), ek = along(v.s.ek, wk - wj), el = along(v.s.el, wl - wj);
    const Dual<R> none(R(0));
    const Vec3<Dual<R>> corners[4] = {d, {none, none, none}, ek, el};
    const R *k = e.rest, *b_of = e.rest + L::pair_fibre;
    R weights[6] = {k[0], k[1], k[2], R(0), R(0), R(0)}, b[3] = {};
    if constexpr (L::edges) weights[3] = k[3], weights[4] = k[4], weights[5] = k[5];
    if constexpr (Density::fibre) b[0] = b_of[0], b[1] = b_of[1], b[2] = b_of[2];
    Sym3<Dual<R>> m{};
    Vec3<Dual<R>> fibre{};
    const Invariants<Dual<R>> i = invariants(corners, weights, c6(e), b, m, fibre);
    const Slopes<Dual<R>> w = Density::slopes(i, k + L::pair_parameters);
    const Vec3<Dual<R>> f = times(k[1], ek - d) + times(k[2], el - d) - times(k[0], d);
    Vec3<R> out = R(2) * extract(stressed(w, m, f)) + (R(1) / R(6)) * extract(times(w.j, cross(ek, el)));
    if constexpr (Density::fibre) out += (R(2) * volume(c6(e)) * own_fibre(e)) * extract(times(w.i4, fibre));
    if constexpr (kViscous) out += Viscous::product(ViscousPair<R>(e), v.second, wi, wj, wk, wl);
    return out;
  }
  // Invariants of corners i, j, k, l with x_j at the origin. weights: of ij ik il jk jl kl; b: of j, k, l.
  template <class R, class S>
  DIFFVBD_FN static Invariants<S> invariants(const Vec3<S> (&x)[4], const R (&weights)[6], const R& c6, const R (&b)[3],
                                             Sym3<S>& m, Vec3<S>& fibre) {
    Invariants<S> v{S(R(3)), S(R(3)), c6 * inner(cross(x[2], x[3]), x[0]), S(R(1)), S(R(0))};
    Sym3<S> sum{S(R(0)), S(R(0)), S(R(0)), S(R(0)), S(R(0)), S(R(0))};
    for (int a = 0; a < 6; ++a) add_square(sum, R(-6) * c6 * weights[a], x[edge_end(a, 1)] - x[edge_end(a, 0)]);
    set_second(sum, v, m);
    if constexpr (Density::fibre) {
      fibre = times(-(b[0] + b[1] + b[2]), x[0]) + times(b[1], x[2]) + times(b[2], x[3]);
      v.i4 = inner(fibre, fibre);
    }
    settle(v, c6);
    return v;
  }
  DIFFVBD_FN static constexpr int edge_end(int edge, int end) {
    constexpr int ends[6][2] = {{0, 1}, {0, 2}, {0, 3}, {1, 2}, {1, 3}, {2, 3}};
    return ends[edge][end];
  }

  // --- the energy of a tet [J], up to a constant

  template <class S, class R>
  DIFFVBD_FN static S energy(const Vec3<S> (&given)[4], const R* rest) {
    constexpr int order[4] = {0, other_corner(0, 0), other_corner(0, 1), other_corner(0, 2)};  // i, j, k, l
    Vec3<S> x[4];
    for (int a = 0; a < 4; ++a) x[a] = given[order[a]] - given[order[1]];
    R weights[6], b[3] = {};
    for (int a = 0; a < 6; ++a) weights[a] = rest[weight_index(order[edge_end(a, 0)], order[edge_end(a, 1)])];
    if constexpr (Density::fibre) {
      for (int a = 0; a < 3; ++a) b[a] = rest[L::fibre + order[a + 1]];
    }
    Sym3<S> m{};
    Vec3<S> fibre{};
    S sum = volume(rest[6]) * Density::value(invariants(x, weights, rest[6], b, m, fibre), rest + L::parameters);
    if constexpr (kViscous) {
      const R *second = rest + L::viscous, c6 = second[6], mu = second[7], lam = second[8], half = R(0.5);
      for (int a = 0; a < 6; ++a) {
        const Vec3<S> edge = x[edge_end(a, 1)] - x[edge_end(a, 0)];
        const R weight = second[weight_index(order[edge_end(a, 0)], order[edge_end(a, 1)])];
        sum = sum - (half * mu * weight) * inner(edge, edge);
      }
      const S strain = c6 * inner(cross(x[2], x[3]), x[0]) - S(R(1));
      sum = sum + volume(c6) * ((half * (mu + lam)) * (strain * strain) - mu * strain);
    }
    return sum;
  }
  template <class R>
  DIFFVBD_FN static R value(const Vec3<R> (&x)[4], const R* rest, const R*) {
    return energy(x, rest);
  }

  // Along x + s p: adds c[k], the change from the k-th trial fraction to the one before it, the last from 0. So the
  // first ones left out, they sum up to the change at a fraction.
  template <class R>
  DIFFVBD_FN static void line(const Vec3<R> (&x)[4], const Vec3<R> (&p)[4], const R* rest, const R*,
                              R (&c)[TetLayout::line_degree]) {
    R last = energy(x, rest);
    for (int k = kFractions - 1; k >= 0; --k) {
      Vec3<R> at[4];
      for (int a = 0; a < 4; ++a) at[a] = x[a] + R(fraction_of(k)) * p[a];
      const R now = energy(at, rest);
      c[k] = c[k] + (now - last);
      last = now;
    }
  }
  // The derivative along p at x, if it is asked for, and by how much more than that the energy changes up to x + p.
  template <bool has_slope, class R>
  DIFFVBD_FN static void path(const Vec3<R> (&x)[4], const Vec3<R> (&p)[4], const R* rest, const R*, R& slope,
                              R& bend) {
    Vec3<R> end[4];
    for (int a = 0; a < 4; ++a) end[a] = x[a] + p[a];
    slope = R(0);
    if constexpr (has_slope) {
      Vec3<Dual<R>> at[4];
      for (int a = 0; a < 4; ++a) at[a] = {{x[a].x, p[a].x}, {x[a].y, p[a].y}, {x[a].z, p[a].z}};
      slope = extract(energy(at, rest));
    }
    bend = energy(end, rest) - energy(x, rest) - slope;
  }

  // The change of a tet's energy as its vertex moves from x by `step`, and the sizes of the terms.
  template <class R>
  DIFFVBD_FN static void change(const TetPair<R>& e, const Vec3<R>& x, const Vec3<R>& step, R& sum, R& size) {
    const R* p = e.rest + L::pair_parameters;
    const R v = volume(c6(e));
    const Vec3<R> d = x - e.xj;
    const Invariants<R> here = shape(e, d).v;
    const R before = v * Density::value(here, p), after = v * Density::value(shape(e, d + step).v, p);
    const Slopes<R> w = Density::slopes(here, p);
    sum = sum + (after - before);
    // psi may be small where its terms are not: what rounding of the invariants does to it
    size =
        size + absolute(before) + absolute(after) +
        v * (absolute(w.i1 * here.i1) + absolute(w.i2 * here.i2) + absolute(w.j * here.j) + absolute(w.i4 * here.i4));
    if constexpr (kViscous) {  // which is quadratic
      Vec3<R> g = zero3<R>();
      R own = R(0);
      Sym3<R> outer = diagonal(R(0));
      Viscous::block(ViscousPair<R>(e), x, g, own, outer);
      const R slope = dot(g, step), bend = R(0.5) * (own * dot(step, step) + dot(step, outer * step));
      sum = sum + (slope + bend), size = size + absolute(slope) + absolute(bend);
    }
  }

  // --- for blocks that are solved in two passes (sweep/refine.h), which only quadratic laws have

  template <class R>
  DIFFVBD_FN static void correct(const TetPair<R>&, View<R>&, const Vec3<R>&, const Vec3<R>&) {}
  template <class R>
  DIFFVBD_FN static void apply(const TetPair<R>& e, const View<R>& v, const Vec3<R>&, const Vec3<R>& p, Vec3<R>& g_sum,
                               Vec3<R>& p_sum) {
    R diagonal_sum = R(0);
    Sym3<R> outer_sum = diagonal(R(0));
    const Vec3<R> at{value_of(v.s.d.x), value_of(v.s.d.y), value_of(v.s.d.z)};
    block(e, e.xj + at, g_sum, diagonal_sum, outer_sum);
    p_sum += diagonal_sum * p + outer_sum * p;
  }
};

}  // namespace diffvbd
