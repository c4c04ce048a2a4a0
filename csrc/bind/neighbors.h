// What both registrations of the search for neighbors ask of its arguments.
#pragma once

#include <cstdio>
#include <limits>
#include <stdexcept>

#include "arguments.h"

namespace diffvbd {

constexpr int64_t kMaxPairs = int64_t{1} << 30;

inline void check_neighbor_arguments(const Tensor& points, double radius, int64_t max_pairs) {
  require(points.dim() == 3 && points.size(2) == 3 && points.is_contiguous(),
          "points: expected contiguous points of shape [scenes, points, 3]");
  require(points.size(0) * points.size(1) <= std::numeric_limits<int32_t>::max(),
          "points: expected fewer than 2^31 in all scenes");
  // Its square must be a normal number.
  const double limit = points.scalar_type() == ScalarType::Double ? 1e150 : 1e18;
  if (!(radius >= 1 / limit && radius <= limit)) {
    char text[96];
    std::snprintf(text, sizeof text, "radius: expected a number in [%g, %g] m, got %g", 1 / limit, limit, radius);
    throw std::invalid_argument(text);
  }
  require(max_pairs >= 0 && max_pairs <= kMaxPairs, "max_pairs: expected an integer in [0, 2^30]");
}

}  // namespace diffvbd
