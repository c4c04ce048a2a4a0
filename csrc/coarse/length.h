// How far a body goes along a correction: the longest of a few lengths that lowers the potential enough.
#pragma once

#include <cmath>
#include <limits>

#include "../core/safeguards.h"
#include "../energies/tet.h"

namespace diffvbd::coarse {

constexpr int kDegree = TetLayout::line_degree;
constexpr double kDecrease = 1e-4;  // share of what the slope promises
constexpr int kFailures = 2;        // lengths of 0 after which a body's corrections are over

// The smooth part of the change of the potential, c[0] s + ... + c[5] s^6, and the sum of its terms' sizes.
struct Change {
  double c[kDegree];

  DIFFVBD_FN double at(double s) const {
    double sum = 0;
    for (int i = kDegree - 1; i >= 0; --i) sum = (sum + c[i]) * s;
    return sum;
  }
  DIFFVBD_FN double size(double s) const {
    double sum = 0;
    for (int i = kDegree - 1; i >= 0; --i) sum = (sum + std::abs(c[i])) * s;
    return sum;
  }
};

// slope: of the whole potential at s = 0. more(s, size): the change of what is no polynomial, which adds to `size` and
// is infinite where s is not admissible.
template <class T, class More>
DIFFVBD_FN double length(const Change& change, double slope, const More& more) {
  if (!(slope <= 0)) return 0;  // at rest it is 0: the whole correction is taken, for its derivative
  for (int trial = 0; trial < kFractions; ++trial) {
    const double s = fraction_of(trial);
    double size = change.size(s);
    const double rise = change.at(s) + more(s, size);
    if (rise <= kDecrease * s * slope + kRounding * double(std::numeric_limits<T>::epsilon()) * size) return s;
  }
  return 0;
}

}  // namespace diffvbd::coarse
