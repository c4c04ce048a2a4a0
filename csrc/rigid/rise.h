// By how much the incremental potential of a body rises from one state to another.
#pragma once

#include "body.h"

namespace diffvbd::rigid {

// What the terms of one vertex alone add on its way from the state to `to`: the rise, the sizes of the terms, and a
// count of what comes too near a plane.
template <class T>
DIFFVBD_FN void add_rise(const Body<T>& b, int32_t v, const Vector& to, double* sum) {
  const Vector from = b.position(v), step = to - from;
  const double inertial = b.mass(v) * dot(step, 0.5 * (from + to) - b.target(v));
  sum[0] += inertial, sum[1] += absolute(inertial);
  b.energies(v, [&](auto energy, int, const double* values, int count) {
    using E = decltype(energy);
    const auto there = b.state(v, to);
    if constexpr (E::has_filter) {
      if (!E::template admits<T>(there, from, values, count, kLeastShare)) sum[2] += 1;
    }
    const double before = E::value(b.state(v, from), values, count), after = E::value(there, values, count);
    sum[0] += after - before, sum[1] += absolute(before) + absolute(after);
  });
}

}  // namespace diffvbd::rigid
