// What the CPU registrations share: memory, plans and tapes.
#pragma once

#include <vector>

#include "../../cpu/run.h"
#include "../sweep.h"

namespace diffvbd {

inline Tensor zeros(const Tensor& like, const std::vector<int64_t>& sizes) {
  return torch::stable::new_zeros(like, sizes);
}
inline Tensor empty(const Tensor& like, const std::vector<int64_t>& sizes) {
  return torch::stable::new_empty(like, sizes);
}

inline Plan plan_of(const Tensor& buffer, const std::vector<int64_t>& sizes) {
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

template <class T>
std::vector<int64_t> tape_shape(const Plan& plan, const StepInputs<T>& in) {
  return {in.scenes, in.sweeps, tape_rows(in.tape_policy, kept_scalars(in.energies)), plan.num_active};
}

template <class T>
void check_tape(const Tensor& tape, const Tensor& x, const Plan& plan, const StepInputs<T>& in) {
  int64_t size = 1;
  for (const int64_t n : tape_shape(plan, in)) size *= n;
  require_like("tape", tape, x, size);
}

}  // namespace diffvbd
