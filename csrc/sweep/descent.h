// How much of an update is executed where a barrier acts. A barrier is no quadratic: a Newton step into it may raise
// the potential many times over, which later updates then have to take back. The fraction comes from a finite set, is
// recorded and counts as a constant.
#pragma once

#include "block.h"

namespace diffvbd {

// d . H d of a factored block
template <class R>
DIFFVBD_FN R square_in(const Factor<R>& H, const Vec3<R>& d) {
  const R first = d.x + H.l21 * d.y + H.l31 * d.z, second = d.y + H.l32 * d.z;
  return first * first / H.inv1 + second * second / H.inv2 + d.z * d.z / H.inv3;
}

// The largest of 1, 1/2, ... for which the vertex's own potential does not rise along the update, beyond rounding; or
// 0. The update goes t d with H d = -g. But for the barriers the potential is quadratic in one vertex, so that it
// changes by -(t - t^2 / 2) d . H d and by what the barriers deviate from their part of g and H. d is in the axes of H.
// 1 with the paper's block, whose update is no Newton step of the potential.
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
      R rise = up - down, terms = up + down;
      Set::for_each([&](auto energy, int k) {
        using E = decltype(energy);
        if constexpr (E::has_filter) {
          rise = rise + E::template change<true>(b.state, s * step, b.data[k], b.data_count[k], terms);
        }
      });
      const R rounding = R(kRounding * std::numeric_limits<T>::epsilon()) * terms;
      out = select(R(0) < out, out, select(rounding < rise, R(0), s));
    }
    out = select(R(0) < acts, out, R(1));
  }
  return out;
}

}  // namespace diffvbd
