// How much of an update is executed where a barrier acts. A barrier is no quadratic: a Newton step into it may raise
// the potential many times over, which later updates then have to take back. The fraction comes from a finite set, is
// recorded and counts as a constant.
#pragma once

#include "../core/safeguards.h"
#include "block.h"
#include "refine.h"

namespace diffvbd {

// d . H d of a factored block
template <class R>
DIFFVBD_FN R square_in(const Factor<R>& H, const Vec3<R>& d) {
  const R first = d.x + H.l21 * d.y + H.l31 * d.z, second = d.y + H.l32 * d.z;
  return first * first / H.inv1 + second * second / H.inv2 + d.z * d.z / H.inv3;
}

// The same for a law that is not quadratic in one vertex: the change of the vertex's whole potential, tet by tet. Pairs
// count by their quadratic model.
template <class Set, class R, class T, class Star>
DIFFVBD_FN R descending_fraction(const Block<R>& b, const Star& star, const StepParameters<T>& q, const Update<R>& u) {
  const Vec3<R> whole = u.alpha * u.step;
  const R h2 = R(q.time_step) * R(q.time_step);
  R out = R(0);
  for (int trial = 0; trial < kFractions && star.any(out < R(fraction_of(kFractions))); ++trial) {
    const R s = R(fraction_of(trial));
    const Vec3<R> step = s * whole;
    R of_tets = R(0), size = R(0);
    star.rewind();
    for (int e = 0; e < star.size(); ++e) Set::Elastic::change(star.pair(e), b.state.x, step, of_tets, size);
    star.total(of_tets, size);
    const R slope = b.mass * dot(step, b.state.x - b.y), bend = R(0.5) * b.mass * dot(step, step);
    R increase = h2 * of_tets + (slope + bend), terms = h2 * size + absolute(slope) + bend;
    Set::for_each([&](auto energy, int k) {
      using E = decltype(energy);
      if constexpr (E::has_filter) {
        increase = increase + E::change(b.state, step, b.data[k], b.data_count[k], terms);
      } else if (b.data_count[k] > 0) {
        VertexState<R> end = b.state;
        end.x += step;
        const R before = E::value(b.state, b.data[k], b.data_count[k]),
                after = E::value(end, b.data[k], b.data_count[k]);
        increase = increase + (after - before), terms = terms + absolute(before) + absolute(after);
      }
    });
    if constexpr (Set::contact) {
      const ContactTerm<R> pairs = star.contact(b);
      const R down = dot(pairs.g, step), up = R(0.5) * dot(step, pairs.H * step);
      increase = increase + (down + up), terms = terms + absolute(down) + absolute(up);
    }
    const R rounding = R(kRounding * std::numeric_limits<T>::epsilon()) * terms;
    const R admitted = select(rounding < increase, R(0), s);
    out = select(R(0) < out, out, select(terms < R(std::numeric_limits<T>::max()), admitted, R(0)));
  }
  return out;
}

// A block of such a law, or of pairs that count negative, may have negative curvature. It is then shifted by the least
// of some powers of two [kg] that makes it positive definite: decided, and constant in the reverse, as the factored
// block is that of the shifted one.
constexpr double kLeastCurvature = 1.0 / 64;  // of the vertex's own mass
constexpr int kShifts = 8;
// Above 0 where it is positive definite, up to rounding: the least pivot. A determinant would lose what the stiffest
// direction takes.
template <class T, class R>
DIFFVBD_FN R least_pivot(const Sym3<R>& a, const R& shift) {
  const R rounding = R(16 * std::numeric_limits<T>::epsilon());
  const R xx = a.xx + shift, first = R(1) / select(R(0) < xx, xx, R(1));
  const R yy = a.yy + shift - first * a.xy * a.xy, t = a.yz - first * a.xy * a.xz;
  const R zz = a.zz + shift - first * a.xz * a.xz - t * t / select(R(0) < yy, yy, R(1));
  const R second = yy + rounding * absolute(a.yy), third = zz + rounding * absolute(a.zz);
  const R least = select(second < third, second, third);
  return select(xx < least, xx, least);
}
template <class T, class R, class Star>
DIFFVBD_FN R shift_of(const Sym3<R>& H, const R& least, const Star& star) {
  R shift = R(0);
  if (!star.any(R(0) < select(R(0) < least_pivot<T>(H, -least), R(0), R(1)))) return shift;
  const R size =
      absolute(H.xx) + absolute(H.yy) + absolute(H.zz) + R(2) * (absolute(H.xy) + absolute(H.xz) + absolute(H.yz));
  R trial = R(0.0625) * power_of_two(select(R(0) < size, size, least));
  for (int k = 0; k < kShifts; ++k) {
    shift = select(R(0) < least_pivot<T>(H, shift - least), shift, trial);
    trial = trial + trial;
  }
  return shift;
}

// The largest of 1, 1/2, ... for which the vertex's own potential does not increase along the update, beyond rounding;
// or 0. The update is t d with H d = -g. Apart from the barriers the potential is quadratic in one vertex: it changes
// by -(t - t^2 / 2) d . H d, and by the deviation of the barriers from their part of g and H. d is in the axes of H. 1
// with the paper's block, whose update is no Newton step of the potential.
template <class Set, class R, class T>
DIFFVBD_FN R descending_fraction(const Block<R>& b, const StepParameters<T>& q, const Factor<R>& H, const Vec3<R>& d,
                                 const Update<R>& u) {
  R out = R(1);
  if constexpr (Set::filters && std::is_same_v<typename Set::Elastic, TetLaw>) {
    const Vec3<R> step = u.alpha * u.step;
    VertexState<R> end = b.state;
    end.x += step;
    R acts = R(0);
    Set::for_each([&](auto energy, int k) {
      using E = decltype(energy);
      if constexpr (E::has_filter) {
        acts = acts + E::near(b.state, b.data[k], b.data_count[k]) + E::near(end, b.data[k], b.data_count[k]);
      }
    });
    if (!any(R(0) < acts)) return out;
    const R square = dot(d, d), ratio = dot(u.d_raw, step) / select(R(0) < square, square, R(1));
    const R whole = square_in(H, d), own = whole - R(q.regularization) * square;  // which no energy has
    out = R(0);
    for (int trial = 0; trial < kFractions && any(out < R(fraction_of(kFractions))); ++trial) {
      const R s = R(fraction_of(trial)), t = s * ratio, down = t * whole, up = R(0.5) * t * t * own;
      R increase = up - down, terms = up + down;
      Set::for_each([&](auto energy, int k) {
        using E = decltype(energy);
        if constexpr (E::has_filter) {
          increase = increase + E::template change<true>(b.state, s * step, b.data[k], b.data_count[k], terms);
        }
      });
      const R rounding = R(kRounding * std::numeric_limits<T>::epsilon()) * terms;
      out = select(R(0) < out, out, select(rounding < increase, R(0), s));
    }
    out = select(R(0) < acts, out, R(1));
  }
  return out;
}

// The algorithm: one block update of Vertex Block Descent (paper, eqs. 2-3) and its exact transpose (eqs. 7-12).
// Loops, memory and launches belong to cpu/ and cuda/; a Star gives this file the incident tets of one vertex, and
// where several threads share them, total() sums over the threads.

// The Newton step, in the axes of the block and in those of the mesh, and the factored block.
template <class R>
struct NewtonStep {
  Vec3<R> d, d_raw;
  Factor<R> H;
};

template <class Set, class R, class T, class Star>
DIFFVBD_FN NewtonStep<R> newton_step(const Block<R>& b, const Star& star, const StepParameters<T>& q) {
  const System<Set, R> system = assemble<Set>(b, star, q);
  Sym3<R> block = system.H;
  R least = system.least, shift = R(0);
  if constexpr (!Set::Elastic::quadratic || Set::contact) {
    const R own = least_eigenvalue(b, q), bound = R(kLeastCurvature) * own;
    shift = shift_of<T>(block, bound, star);
    add_diagonal(block, shift);
    least = select(own < least, least, bound);  // turned axes round more
  }
  const Factor<R> H = factor<T>(block, least);
  Vec3<R> d = -solve(H, system.g);
  if constexpr (!Set::well_conditioned && Set::Elastic::quadratic) {
    if (star.any(is_ill_conditioned<Set>(H, shared_entries<Set>(b, system.axes))))
      d = refine_step<Set>(b, star, q, system.axes, H, shift, d);
  }
  return {d, system.axes.from(d), H};
}

// Whether a block needs refinement: all threads that share a star must know.
template <class Set, class R, class Star>
DIFFVBD_FN bool needs_refinement(const Block<R>& b, const Star& star, const Factor<R>& H) {
  return Set::Elastic::quadratic && star.any(is_ill_conditioned<Set>(H, shared_entries<Set>(b, NoFrame<R>{})));
}

// Saturated, then relaxed.
template <class R, class T>
DIFFVBD_FN Vec3<R> relaxed(const Vec3<R>& d_raw, const StepParameters<T>& q) {
  return R(q.relaxation) * (q.saturates ? saturate(d_raw, q) : d_raw);
}

// From the Newton step to the executed one.
template <class Set, class R, class T>
DIFFVBD_FN Update<R> safeguarded(const Block<R>& b, const Vec3<R>& d_raw, const StepParameters<T>& q) {
  Update<R> out{d_raw, relaxed(d_raw, q), R(1), R(1)};
  Set::for_each([&](auto energy, int k) {
    using E = decltype(energy);
    if constexpr (E::has_filter) {
      const R alpha = E::filter(b.state, b.data[k], b.data_count[k], out.step, q);
      out.alpha = select(alpha < out.alpha, alpha, out.alpha);
    }
  });
  return out;
}

template <class Set, class R, class T, class Star>
DIFFVBD_FN Update<R> update_of(const Block<R>& b, const Star& star, const NewtonStep<R>& newton,
                               const StepParameters<T>& q) {
  Update<R> out = safeguarded<Set>(b, newton.d_raw, q);
  if constexpr (Set::Elastic::quadratic) {
    out.fraction = descending_fraction<Set>(b, q, newton.H, newton.d, out);
  } else {
    out.fraction = descending_fraction<Set>(b, star, q, out);
  }
  return out;
}

template <class Set, class R>
DIFFVBD_FN Vec3<R> moved(const Vec3<R>& x, const Update<R>& u) {
  if constexpr (Set::takes_fractions) return x + (u.fraction * u.alpha) * u.step;
  return x + u.step;
}

// The update that was executed. Puts b.state.x back to where it was before it, and completes what the tape left out.
template <class Set, class R, class T, class Star>
DIFFVBD_FN Update<R> replayed(Block<R>& b, const Star& star, Recalled<R>& r, bool full, const StepParameters<T>& q) {
  Update<R> u;
  if constexpr (Set::keeps_positions) {
    b.state.x = r.x_old;
  } else {
    u = safeguarded<Set>(b, r.d, q);
    b.state.x -= u.step;
  }
  if (!full) {
    const NewtonStep<R> step = newton_step<Set>(b, star, q);
    r.H = step.H;
    if (Set::keeps_positions) r.d = step.d;
  }
  if constexpr (Set::keeps_positions) u = safeguarded<Set>(b, axes_of<T, Set>(b).from(r.d), q);
  if constexpr (Set::takes_fractions) u.fraction = r.fraction;
  return u;
}

// Calls get() for each scalar that a tape keeps of one update, in the order in which the forward put them.
template <class Set, class R, class Get>
DIFFVBD_FN Recalled<R> recall(bool full, Get&& get) {
  Recalled<R> r{};
  if (Set::keeps_positions) r.x_old = {get(), get(), get()};
  if (full || !Set::keeps_positions) r.d = {get(), get(), get()};
  if (full) r.H = {get(), get(), get(), get(), get(), get()};
  if (Set::takes_fractions) r.fraction = get();
  return r;
}
template <class Set, class R, class Put>
DIFFVBD_FN void record(bool full, const Block<R>& before, const NewtonStep<R>& step, const Update<R>& u, Put&& put) {
  const Vec3<R>& d = step.d;
  const Factor<R>& H = step.H;
  if (Set::keeps_positions) put(before.state.x.x), put(before.state.x.y), put(before.state.x.z);
  if (full || !Set::keeps_positions) put(d.x), put(d.y), put(d.z);
  if (full) put(H.l21), put(H.l31), put(H.l32), put(H.inv1), put(H.inv2), put(H.inv3);
  if (Set::takes_fractions) put(u.fraction);
}

// Adjoints of what one update read, except those of its star, which go through star.add().
template <class R>
struct BlockAdjoint {
  Vec3<R> x, y, x_prev;
  R mass;
  Vec3<R> p;  // H^-1 of what reaches the Newton step: what the adjoint of pairs starts from
};

// Transpose of one block update. `b` holds the state before it, `x_bar` the adjoint of the position after it.
// add_data(k, i, value) receives the adjoint of b.data[k][i]; it is called only if `wants_data`.
template <class Set, int wanted, class R, class T, class Star, class AddData>
DIFFVBD_FN BlockAdjoint<R> reverse_vertex(const Block<R>& b, const Star& star, const Update<R>& u, const Recalled<R>& r,
                                          const Vec3<R>& x_bar, const StepParameters<T>& q, bool wants_data,
                                          AddData&& add_data) {
  const R h = R(q.time_step), minus_h2 = -(h * h);
  BlockAdjoint<R> out{x_bar, zero3<R>(), zero3<R>(), R(0), zero3<R>()};
  Vec3<R> step_bar = x_bar;
  R alpha_bar = R(0);
  if constexpr (Set::takes_fractions) step_bar = u.fraction * x_bar;
  if constexpr (Set::filters) {
    alpha_bar = dot(u.step, step_bar);
    step_bar = u.alpha * step_bar;
    Set::for_each([&](auto energy, int k) {
      using E = decltype(energy);
      if constexpr (E::has_filter) {
        E::filter_vjp(b.state, b.data[k], b.data_count[k], u.step, q, u.alpha, alpha_bar, out.x, step_bar);
      }
    });
  }
  Vec3<R> z = R(q.relaxation) * step_bar;
  if (q.saturates) z = saturate_vjp(u.d_raw, z, q);
  const Axes<Set, R> axes = axes_of<T, Set>(b);
  const Vec3<R> z_axes = axes.to(z);
  Vec3<R> p_axes = solve(r.H, z_axes), d_low = zero3<R>();
  bool ill_conditioned = false;
  if constexpr (!Set::contact && !Set::well_conditioned &&
                Set::Elastic::quadratic) {  // what contact adds to a block is not on a full tape
    ill_conditioned = star.any(is_ill_conditioned<Set>(r.H, shared_entries<Set>(b, axes)));
    if constexpr (Set::filters)
      ill_conditioned = ill_conditioned || (wants_data && star.any(is_oblique<Set>(b, b.state.x, true)));
  }
  if constexpr (!Set::well_conditioned && Set::Elastic::quadratic) {
    if (ill_conditioned) out.x += reverse_refined<Set, wanted>(b, star, q, axes, r, u.d_raw, z_axes, p_axes, d_low);
  }
  const Vec3<R> p = axes.from(p_axes);
  out.p = p;

  out.y = b.mass * p;
  out.x -= out.y;
  out.mass = -(dot(b.state.x - b.y, p) + dot(u.d_raw, p));
  Set::for_each([&](auto energy, int k) {
    using E = decltype(energy);
    const auto reverse = [&](const Vec3<R>& p, const Update<R>& u, const auto& planes) {
      vertex_energy_vjp<E>(b.state, b.data[k], b.data_count[k], p, u.d_raw, out.x, out.x_prev, planes);
      if (wants_data) {  // out of line, so for copies: those that stay in registers have no address
        const VertexState<R> s_copy = b.state;
        const Vec3<R> p_copy = p;
        const Update<R> u_copy = u;
        const auto planes_copy = planes;
        vertex_energy_data_vjp<E>(
            s_copy, b.data[k], b.data_count[k], p_copy, u_copy, q, alpha_bar,
            [&](int i, const R& value) { add_data(k, i, value); }, planes_copy);
      }
    };
    if constexpr (E::has_filter) {
      reverse(p_axes, Update<R>{r.d, u.step, u.alpha, u.fraction}, plane_step(axes, d_low));
    } else {
      reverse(p, u, NoFrame<R>{});
    }
  });
  if (!ill_conditioned) {
    Vec3<R> own = star.template reverse_tets<typename Set::Elastic, wanted>({b.state.x, u.d_raw, p, minus_h2});
    star.total(own);
    out.x += own;
  }
  return out;
}

// Adjoint of w . (g + E d) at one vertex, with g the gradient of the potential and E the blocks of the vertex energies:
// out.x is the vertex's part of the Hessian times w, with the neighbours' w from the star; the rest is what its own g
// and E depend on. d: how the coarse correction wanted to move the vertex. A pinned vertex has w = 0, and of its
// neighbours' g only tets reach it.
template <class Set, int wanted, class R, class T, class Star, class AddData>
DIFFVBD_FN BlockAdjoint<R> reverse_gradient(const Block<R>& b, const Star& star, const Vec3<R>& w, const Vec3<R>& d,
                                            const StepParameters<T>& q, bool wants_data, AddData&& add_data) {
  const R h = R(q.time_step), minus_h2 = -(h * h);
  const Vec3<R> p = -w, none = zero3<R>();
  BlockAdjoint<R> out{none, b.mass * p, none, -dot(b.state.x - b.y, p), p};
  out.x = -out.y;
  Set::for_each([&](auto energy, int k) {
    using E = decltype(energy);
    vertex_energy_vjp<E>(b.state, b.data[k], b.data_count[k], p, d, out.x, out.x_prev);
    if (wants_data) {
      const Update<R> still{d, none, R(1), R(1)};
      vertex_energy_data_vjp<E>(b.state, b.data[k], b.data_count[k], p, still, q, R(0),
                                [&](int i, const R& value) { add_data(k, i, value); });
    }
  });
  out.x += star.template multiply_tets<typename Set::Elastic, wanted>(b.state.x, w, minus_h2);
  return out;
}

}  // namespace diffvbd
