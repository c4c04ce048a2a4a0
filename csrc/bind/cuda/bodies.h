// What the CUDA registrations of work on bodies share.
#pragma once

#include <algorithm>
#include <vector>

#include "../../cuda/bodies.h"
#include "binding.h"

namespace diffvbd::cuda {

inline BodyGroups groups_of(const std::vector<int64_t>& groups, int64_t bodies) {
  require(groups.size() == 4 && *std::min_element(groups.begin(), groups.end()) >= 0 &&
              groups[0] + groups[1] + groups[2] + groups[3] == bodies,
          "diffvbd: expected four groups of bodies");
  const auto at = [&](int i) { return static_cast<int32_t>(groups[i]); };
  return {at(0), at(1), at(2), at(3)};
}

inline Tensor workspace_of(const BodyGroups& groups, const Tensor& x) {
  return empty(x, {bodies_workspace(groups, x.size(0), x.size(1))}, ScalarType::Double);
}

}  // namespace diffvbd::cuda
