// What the CUDA registrations of work on bodies share.
#pragma once

#include <vector>

#include "binding_cuda.h"
#include "cuda/bodies.h"

namespace diffvbd::cuda {

inline BodyGroups groups_of(const std::vector<int64_t>& groups, int64_t bodies) {
  require(groups.size() == 3 && groups[0] + groups[1] + groups[2] == bodies,
          "diffvbd: expected three groups of bodies");
  return {static_cast<int32_t>(groups[0]), static_cast<int32_t>(groups[1]), static_cast<int32_t>(groups[2])};
}

inline Tensor workspace_of(const BodyGroups& groups, const Tensor& x) {
  return empty(x, {bodies_workspace(groups, x.size(0))}, ScalarType::Double);
}

}  // namespace diffvbd::cuda
