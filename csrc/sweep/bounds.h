// What contact brings to a block update: the part that pairs add to the block, computed color by color before the color
// moves (contact/), and the bound of the vertex's motion between two detections: its position stays within `radius` of
// `center`. Like the other safeguards a bound stands with its derivative (docs/method.md, section 12).
#pragma once

#include "../core/vec.h"

namespace diffvbd {

template <class R>
struct Bound {
  Vec3<R> center;  // [m]
  R radius;        // [m]
};

template <class R>
struct ContactTerm {
  Vec3<R> g;
  Sym3<R> H;
  Bound<R> bound;
};
constexpr int kContactScalars = 13;

// The step of x whose end is the point of the ball closest to x + step.
template <class R>
DIFFVBD_FN Vec3<R> bounded(const Vec3<R>& x, const Vec3<R>& step, const Bound<R>& b) {
  const Vec3<R> m = x + step - b.center, inward = b.center - x;
  const R length = square_root(dot(m, m));
  const auto outside = b.radius < length;
  const R scale = b.radius / select(outside, length, R(1));
  return {select(outside, inward.x + scale * m.x, step.x), select(outside, inward.y + scale * m.y, step.y),
          select(outside, inward.z + scale * m.z, step.z)};
}

// 1 where a bound changes the step, else 0
template <class R>
DIFFVBD_FN R is_cut(const Vec3<R>& x, const Vec3<R>& step, const Bound<R>& b) {
  const Vec3<R> m = x + step - b.center;
  return select(b.radius < square_root(dot(m, m)), R(1), R(0));
}

// step_bar: adjoint of bounded(x, step, b) on entry, of step on return; x_bar and b_bar receive their shares.
template <class R>
DIFFVBD_FN void bounded_vjp(const Vec3<R>& x, const Vec3<R>& step, const Bound<R>& b, Vec3<R>& step_bar, Vec3<R>& x_bar,
                            Bound<R>& b_bar) {
  const Vec3<R> m = x + step - b.center;
  const R length = square_root(dot(m, m));
  const auto outside = b.radius < length;
  const R inverse = R(1) / select(outside, length, R(1));
  const Vec3<R> unit = inverse * m;
  const R along = dot(unit, step_bar), live = select(outside, R(1), R(0));
  const R ratio = select(outside, b.radius * inverse, R(1));
  const Vec3<R> rest = live * (step_bar - ratio * (step_bar - along * unit));
  x_bar -= rest;
  b_bar.center += rest;
  b_bar.radius = b_bar.radius + live * along;
  step_bar -= rest;
}

}  // namespace diffvbd
