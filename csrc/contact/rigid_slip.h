// Friction in the rigid correction of bodies that touch (docs/method.md, section 18): all but friction is linear in the
// motions of bodies, friction is taken as it is. Newton's method finds where they come to rest, with shorter steps
// where a full one would take a slip past that.
#pragma once

#include "rigid_rub.h"

namespace diffvbd::contact {

constexpr int kSlipIterations = 200;  // of Newton's method at most: mostly it settles within 10 to 30
constexpr int kHalvings = 40;         // in the search for the length of a step, at most: down to eps over a long way
constexpr double kOvershoot = 0.1;    // slope at the end of a step over that at its start, that is small
constexpr double kSettled = 1e-9;     // of the whole, a step after which there is but one more

// FrictionRate's value for the square of a length, without the divisions that take most of the time of a search.
DIFFVBD_FN double friction_rate(double square, double eps) {
  if (!(0 < square)) return 2 / eps;
#ifdef __CUDA_ARCH__
  const double inverse = rsqrt(square);
#else
  const double inverse = 1 / square_root(square);
#endif
  if (!(square < eps * eps)) return inverse;
  const double over = 1 / eps;
  return (2 - square * inverse * over) * over;
}

// A slip u along a step c of Newton's method, as far as friction depends on it.
struct SlipLine {
  double start, along, way;  // u u, u c and c c
  double size, rate, bend;   // what the step takes friction for: f1(|u|) / |u| at its start, and its derivative

  SlipLine() = default;
  DIFFVBD_FN SlipLine(const Vector& slip, const Vector& change, double load, double eps)
      : start(dot(slip, slip)), along(dot(slip, change)), way(dot(change, change)), size(load) {
    const FrictionRate<double> first(square_root(start), eps);
    rate = first.value, bend = first.curvature * along;
  }

  // The slope of the potential after a share of the step, over what that takes it for.
  DIFFVBD_FN double excess(double share, double eps) const {
    const double toward = along + share * way, square = start + share * (along + toward);
    return size * ((friction_rate(square, eps) - rate) * toward - share * bend * along);
  }
};

// Of a lagged pair that rubs, and its press.
template <class T>
DIFFVBD_FN SlipLine slip_line(const RigidInputs<T>& in, int64_t pair, const PairPress& a, const double* center,
                              const double* step) {
  const Lag<T> lag(in.lag + kLagScalars * pair);
  const Vector n = {double(lag.n.x), double(lag.n.y), double(lag.n.z)};
  const Vector way = way_of(a, {center, step});
  return {a.slip, way - dot(n, way) * n, a.rubs, in.friction_eps};
}

// Of a vertex at r from its body's center on one plane of a floor, with that body's motion so far and its step.
template <class T>
DIFFVBD_FN SlipLine slip_line(const RigidInputs<T>& in, const rigid::Body<T>& b, int32_t v, int plane, const Vector& r,
                              const double* motion, const double* step) {
  const FloorSlip a = floor_slip(in, b, v, plane, moved_by(motion, r));
  const Vector way = moved_by(step, r);
  return {a.slip, way - dot(a.n, way) * a.n, a.size, in.friction_eps};
}

// The share of a step that is taken, after which the slope of the potential is small or negative. fall: twice by how
// much the step lowers what it takes the potential for; `excess` of a share: that of all that slips.
template <class Excess>
DIFFVBD_FN double slip_share(double fall, const Excess& excess) {
  if (!(kOvershoot * fall < excess(1.0))) return 1;
  double low = 0, high = 1;
  for (int i = 0; i < kHalvings; ++i) {
    const double middle = 0.5 * (low + high), slope = excess(middle) - fall * (1 - middle);
    if (absolute(slope) <= kOvershoot * fall) return middle;
    (slope < 0 ? low : high) = middle;
  }
  return high;
}

// Where Newton's method is with a system: on its way, at the motion it has settled at but not with the matrix there,
// and done.
enum Settling : uint8_t { kOnItsWay, kSettledAt, kDone };

// The share of a step that is taken. fall, whole: twice what the step and the motion after it are worth in potential.
template <class Share>
DIFFVBD_FN double settle(Settling& state, bool rubs, double fall, double whole, const Share& share) {
  if (!rubs || state == kSettledAt) {
    state = kDone;
    return 1;
  }
  if (fall <= kSettled * kSettled * whole) {
    state = kSettledAt;
    return 1;
  }
  return share(fall);
}

}  // namespace diffvbd::contact
