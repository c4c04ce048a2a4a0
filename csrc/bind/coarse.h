// The plan of a coarse space, as its entries and those of sweeps take it.
#pragma once

#include "../subspace/coarse.h"
#include "../subspace/coarse_matrix.h"
#include "backend.h"

namespace diffvbd {

// sizes: those of the plan, and how many sweeps come before
inline coarse::Plan coarse_plan(const Tensor& plan, const Tensor& x, Ints sizes) {
  bool known = is_index(plan, x) && sizes.size() == coarse::kSizes;
  for (const int64_t size : sizes) known = known && size >= 0 && size <= std::numeric_limits<int32_t>::max();
  int64_t used = 0;
  coarse::Plan out{};
  if (known) out = coarse::view_plan(sizes.data(), data<const int32_t>(plan), used);
  require(known && used == plan.numel() && out.every > 0 && out.begun <= 1,
          "diffvbd: expected a plan of a coarse space, int32, and its sizes");
  return out;
}

}  // namespace diffvbd
