// How much of an update is executed where a barrier acts. A barrier is no quadratic: a Newton step into it may raise
// the potential many times over, which later updates then have to take back. The fraction comes from a finite set, is
// recorded and counts as a constant.
#pragma once

#include "block.h"

namespace diffvbd {

// Above 0 where an energy with a step filter acts on a vertex at x, or would after the step.
template <class Set, class R>
DIFFVBD_FN R acting(const Block<R>& b, const Vec3<R>& step) {
  R out = R(0);
  VertexState<R> after = b.state;
  after.x += step;
  Set::for_each([&](auto energy, int k) {
    using E = decltype(energy);
    if constexpr (E::has_filter) {
      out = out + E::near(b.state, b.data[k], b.data_count[k]) + E::near(after, b.data[k], b.data_count[k]);
    }
  });
  return out;
}

// The largest of 1, 1/2, ... for which the vertex's own potential does not rise along the step, beyond rounding; or 0.
// Inertia and tets are quadratic in one vertex; pairs count as in its block.
template <class Set, class R, class T, class Star>
DIFFVBD_COLD R searched_fraction(const Block<R>& b, const Star& star, const StepParameters<T>& q, const Vec3<R>& step) {
  star.rewind();
  TetSums<R> tets = sum_tets<typename Set::Elastic>(star, b.state.x);
  star.total(tets.g, tets.h_diagonal, tets.h_outer);
  const R h2 = R(q.time_step) * R(q.time_step);
  const Vec3<R> inertia = b.mass * (b.state.x - b.y), elastic = h2 * tets.g;
  R slope = dot(inertia, step) + dot(elastic, step), size = sizes(inertia, step) + sizes(elastic, step);
  R curvature = (b.mass + h2 * tets.h_diagonal) * dot(step, step) + h2 * dot(step, tets.h_outer * step);
  if constexpr (Set::contact) {
    const ContactTerm<R> contact = star.contact(b);
    slope = slope + dot(contact.g, step);
    size = size + sizes(contact.g, step);
    curvature = curvature + dot(step, contact.H * step);
  }
  const R rounding = R(kRounding * std::numeric_limits<T>::epsilon());
  R out = R(0);
  for (int trial = 0; trial < kFractions && any(out < R(fraction_of(kFractions))); ++trial) {
    const R s = R(fraction_of(trial)), quadratic = R(0.5) * s * s * curvature;
    R rise = s * slope + quadratic, terms = s * size + quadratic;
    Set::for_each([&](auto energy, int k) {
      using E = decltype(energy);
      if (b.data_count[k] > 0) rise = rise + E::change(b.state, s * step, b.data[k], b.data_count[k], terms);
    });
    out = select(R(0) < out, out, select(rounding * terms < rise, R(0), s));
  }
  return out;
}

// 1 with the paper's block, whose update is no Newton step of the potential.
template <class Set, class R, class T, class Star>
DIFFVBD_FN R descending_fraction(const Block<R>& b, const Star& star, const StepParameters<T>& q, const Update<R>& u) {
  if constexpr (!Set::filters || !std::is_same_v<typename Set::Elastic, TetLaw>) {
    return R(1);
  } else {
    const Vec3<R> step = u.alpha * u.step;
    const R acts = acting<Set>(b, step);
    if (!star.any(any(R(0) < acts))) return R(1);
    const Block<R> b_copy = b;  // copies keep the usual path in registers
    const Star star_copy = star;
    return select(R(0) < acts, searched_fraction<Set>(b_copy, star_copy, q, step), R(1));
  }
}

}  // namespace diffvbd
