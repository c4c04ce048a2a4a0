// Plans and tapes of sweeps, as their backends have them.
#pragma once

#include "backend.h"

namespace diffvbd {

#ifdef USE_CUDA

using cuda::HostPlan;
constexpr int kRestRowOfPlan = cuda::kRestRow, kLanesOfPlan = kSlice;

// sizes: a plan's header, but active, tets and slots come first; then the first block of each color.
inline HostPlan plan_of(const Tensor& buffer, const Tensor& x, Ints sizes) {
  require(is_index(buffer, x) && sizes.size() > kPlanHeader &&
              static_cast<int64_t>(sizes.size()) == kPlanHeader + sizes[4] + 1,
          "diffvbd: expected a plan made for CUDA by build_plan, and its sizes");
  const int order[kPlanHeader] = {3, 1, 0, 4, 5, 2, 6, 7, 8, 9, 10};
  int32_t header[kPlanHeader];
  for (int i = 0; i < kPlanHeader; ++i) header[i] = static_cast<int32_t>(sizes[order[i]]);
  require_header(header);
  const int32_t* start = data<const int32_t>(buffer);
  const GroupPlan plan = view_group_plan(header, start);
  const int32_t* end =
      plan.visit_pair ? plan.visit_pair + 16 * int64_t{plan.num_tets} : plan.tet_pair + 4 * int64_t{plan.num_tets};
  require(end - start <= buffer.numel(), "diffvbd: the plan is shorter than its sizes say");
  return {plan, sizes.data() + kPlanHeader, static_cast<int>(sizes[9]), static_cast<int>(sizes[10])};
}
inline const GroupPlan& view_of(const HostPlan& host) { return host.plan; }

#else

using HostPlan = Plan;
constexpr int kRestRowOfPlan = kPairRest, kLanesOfPlan = kLanes;

inline Plan plan_of(const Tensor& buffer, const Tensor& /*x*/, Ints sizes) {
  require(buffer.scalar_type() == ScalarType::Int && buffer.is_contiguous() && buffer.numel() >= kPlanHeader,
          "diffvbd: expected a plan made by build_plan");
  const int32_t* start = data<const int32_t>(buffer);
  require_header(start);
  const Plan plan = view_plan(start);
  require(plan.incoming - start + int64_t{plan.incoming_slots} * kLanes <= buffer.numel(),
          "diffvbd: the plan is shorter than its header says");
  require(sizes.size() == 3 && sizes[0] == plan.num_active && sizes[1] == plan.num_tets && sizes[2] == plan.slots,
          "diffvbd: the sizes are not those of the plan");
  return plan;
}
inline const Plan& view_of(const Plan& plan) { return plan; }

#endif

}  // namespace diffvbd
