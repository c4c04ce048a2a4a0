// Blocks whose directions differ widely in stiffness: lam far above mu, a stiff tet beside soft ones, large strain. The
// sums of g and H round by eps times the stiffest direction, and so does a strain of a tet that hardly strains. The
// step is therefore refined: what it leaves of its own equation is summed up again, tet by tet, where the stiff terms
// are small already, and solved for with the same factors. In the reverse the last correction stays apart, because
// added to p or d_raw it would round away: what it does to n . p and to the strain of each tet is added to these. Here
// alone, out of line: most blocks never come here.
#pragma once

#include "block.h"

namespace diffvbd {

// Errors grow by eps times the spread of a block: some tenths of it relative to an ulp of the input. 40 is lam of a
// hundred mu. Pairs in contact make blocks ill-conditioned all the time, and their adjoint is not refined.
constexpr double kIllConditioned = 40, kIllConditionedContact = 1e3;
constexpr int kRefinements = 2;  // each leaves eps times the spread of the error: from 1e-4 to 1e-12 at 1e12

// Whether the trace and the least pivot of a block lie further apart than rounding forgives: trace(D^-1) trace(L D L^T)
// but for the last pivot's own part, both times inv1 inv2, so that nothing is divided. What a plane puts on an entry of
// its own does no harm.
template <class Set, class R>
DIFFVBD_FN auto is_ill_conditioned(const Factor<R>& f, const Shared<R>& on) {
  const R trace =
      on.first * (R(1) + f.l21 * f.l21 + f.l31 * f.l31) * f.inv2 + on.second * (R(1) + f.l32 * f.l32) * f.inv1;
  return R(Set::contact ? kIllConditionedContact : kIllConditioned) * (f.inv1 * f.inv2) <
         (f.inv1 + f.inv2 + f.inv3) * trace;
}

// Out of line, so that no compiler fuses its products in one place and not in another: the rounding of a strain that a
// solve has seen must be the one that its adjoint sees.
template <class Elastic, class R>
DIFFVBD_COLD typename Elastic::template View<R> view_of(const TetPair<R>& e, const Vec3<R>& xi, const Vec3<R>& d_raw,
                                                        const Vec3<R>& p) {
  return Elastic::view(e, xi, d_raw, p);
}

// A vector in the axes of a block, and in those of the mesh.
template <class R>
struct Both {
  Vec3<R> block, mesh;
};

template <class R>
struct Applied {
  Vec3<R> g, p;  // g + H d and H p, in the axes of the block
};

template <class Set, class R, class T, class Star>
DIFFVBD_COLD Applied<R> apply(const Block<R>& b, const Star& star, const StepParameters<T>& q, const Axes<Set, R>& axes,
                              const Both<R>& d, const Both<R>& p) {
  const System<Set, R> own = assemble<Set, false>(b, star, q);
  Applied<R> out{own.g + own.H * d.block, own.H * p.block};
  if constexpr (Set::filters) {
    Set::for_each([&](auto energy, int k) {
      using E = decltype(energy);
      if constexpr (E::has_filter) {
        for (int i = 0; i < b.data_count[k]; i += E::stride) {
          const auto f = push_of<E>(b.state, b.data[k] + i, axes, d.block);
          out.g += f.reaction * f.n;
          out.p += (f.curvature * dot(f.n, p.block)) * f.n;
        }
      }
    });
  }
  const R h2 = R(q.time_step) * R(q.time_step);
  Vec3<R> g_sum = zero3<R>(), p_sum = zero3<R>();
  star.rewind();
  for (int e = 0; e < star.size(); ++e) {
    const TetPair<R> pair = star.pair(e);
    const auto view = view_of<typename Set::Elastic>(pair, b.state.x, d.mesh, p.mesh);
    Set::Elastic::apply(pair, view, d.mesh, p.mesh, g_sum, p_sum);
  }
  star.total(g_sum, p_sum);
  out.g += axes.to(h2 * g_sum);
  out.p += axes.to(h2 * p_sum);
  return out;
}

// A correction, or none where it is not smaller than what it should be small against: the factors hold no digits then.
template <class R>
DIFFVBD_FN Vec3<R> if_small(const Vec3<R>& correction, const R& limit) {
  return select(dot(correction, correction) < limit, correction, zero3<R>());
}

// The Newton step d of a block, refined. In the axes of the block, as `d`.
template <class Set, class R, class T, class Star>
DIFFVBD_COLD Vec3<R> refined_step(const Block<R>& b, const Star& star, const StepParameters<T>& q,
                                  const Axes<Set, R>& axes, const Factor<R>& H, const R& shift, const Vec3<R>& first) {
  Vec3<R> d = first;
  for (int k = 0; k < kRefinements; ++k) {
    const Both<R> now{d, axes.from(d)}, none{zero3<R>(), zero3<R>()};
    d -= if_small(solve(H, apply<Set>(b, star, q, axes, now, none).g + shift * d), dot(d, d));
  }
  return d;
}

// p = H^-1 z, refined, the small part of d, and the adjoints of the star, which go through star.add() but for that of
// x_i. z, p and d_low are in the axes of the block.
template <class Set, int wanted, class R, class T, class Star>
DIFFVBD_COLD Vec3<R> reverse_star(const Block<R>& given, const Star& star, const StepParameters<T>& q,
                                  const Axes<Set, R>& axes, const Recalled<R>& r, const Vec3<R>& d_raw,
                                  const Vec3<R>& z, Vec3<R>& p, Vec3<R>& d_low) {
  using Elastic = typename Set::Elastic;
  const Factor<R>& H = r.H;
  Block<R> b = given;
  b.y = star.predictor(b);
  const Both<R> d{r.d, d_raw};
  for (int k = 0; k < kRefinements; ++k) {
    const Both<R> now{p, axes.from(p)};
    p += if_small(solve(H, z - apply<Set>(b, star, q, axes, d, now).p), dot(p, p));
  }
  const Vec3<R> p_mesh = axes.from(p);
  const Applied<R> left = apply<Set>(b, star, q, axes, d, Both<R>{p, p_mesh});
  // of d the small part may be what x + d_raw has been rounded by
  const R rounding = R(std::numeric_limits<T>::epsilon()) * dot(b.state.x, b.state.x);
  d_low = if_small(-solve(H, left.g), dot(d_raw, d_raw) + rounding);
  Vec3<R> own = zero3<R>();
  const R h = R(q.time_step), minus_h2 = -(h * h);
  const Vec3<R> d_low_mesh = axes.from(d_low), p_low_mesh = axes.from(if_small(solve(H, z - left.p), dot(p, p)));
  star.rewind();
  for (int e = 0; e < star.size(); ++e) {
    const TetPair<R> pair = star.pair(e);
    auto view = view_of<Elastic>(pair, b.state.x, d_raw, p_mesh);
    Elastic::correct(pair, view, d_low_mesh, p_low_mesh);
    reverse_tet<Elastic, wanted>(star, e, pair, view, d_raw, p_mesh, minus_h2, own);
  }
  star.total(own);
  return own;
}

// Copies keep what the well-conditioned path works with in registers.
template <class Set, class R, class T, class Star>
DIFFVBD_FN Vec3<R> refine_step(const Block<R>& b, const Star& star, const StepParameters<T>& q,
                               const Axes<Set, R>& axes, const Factor<R>& H, const R& shift, const Vec3<R>& d) {
  const Block<R> b_copy = b;
  const Star star_copy = star;
  const Axes<Set, R> axes_copy = axes;
  const Factor<R> H_copy = H;
  const Vec3<R> d_copy = d;
  const R shift_copy = shift;
  return refined_step<Set>(b_copy, star_copy, q, axes_copy, H_copy, shift_copy, d_copy);
}
template <class Set, int wanted, class R, class T, class Star>
DIFFVBD_FN Vec3<R> reverse_refined(const Block<R>& b, const Star& star, const StepParameters<T>& q,
                                   const Axes<Set, R>& axes, const Recalled<R>& r, const Vec3<R>& d_raw,
                                   const Vec3<R>& z, Vec3<R>& p, Vec3<R>& d_low) {
  const Star star_copy = star;
  const Block<R> b_copy = b;
  const Axes<Set, R> axes_copy = axes;
  const Recalled<R> r_copy = r;
  const Vec3<R> d_copy = d_raw, z_copy = z;
  Vec3<R> refined = p, low;
  const Vec3<R> own = reverse_star<Set, wanted>(b_copy, star_copy, q, axes_copy, r_copy, d_copy, z_copy, refined, low);
  star.adopt(star_copy);
  p = refined;
  d_low = low;
  return own;
}

}  // namespace diffvbd
