// What the CUDA registrations of sweeps share: plans, tapes, launches and workspace.
#pragma once

#include <torch/csrc/stable/accelerator.h>

#include "../../cuda/step.h"
#include "../sweep.h"
#include "binding.h"

namespace diffvbd::cuda {

using torch::stable::accelerator::DeviceGuard;

constexpr int64_t kWorkspaceBudget = int64_t{2} << 30;  // bytes; a batch that needs more is worked on in chunks
constexpr int kHostSizes = kPlanHeader;                 // a plan's header, but active, tets and slots come first

inline HostPlan plan_of(const Tensor& buffer, const Tensor& x, const std::vector<int64_t>& sizes) {
  require(is_index(buffer, x) && sizes.size() > kHostSizes &&
              static_cast<int64_t>(sizes.size()) == kHostSizes + sizes[4] + 1,
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
  return {plan, sizes.data() + kHostSizes, static_cast<int>(sizes[9]), static_cast<int>(sizes[10])};
}

// The regime and threads per vertex that Python chose for one direction, and what the device adds. A tape of one regime
// is that of any other, but for a scene per thread.
inline Choice choose(const Tensor& x, const std::vector<int64_t>& launch, bool reverse, int wanted = 0) {
  require(launch.size() == 4 && (launch[0] == kThread) == (launch[1] == kThread), "diffvbd: bad launch");
  const int64_t regime = launch[reverse ? 1 : 0], lanes = launch[reverse ? 3 : 2];
  const int some = reverse ? kSomeReverseLanes : kSomeLanes;
  require(regime >= kThread && regime <= kColor, "diffvbd: bad launch");
  require(lanes == kFewLanes || lanes == some || lanes == kManyLanes, "diffvbd: bad launch");
  Choice out{};
  out.regime = static_cast<int>(regime);
  out.lanes = static_cast<int>(lanes);
  out.wanted = wanted;
  int shared = 0;
  const int device = x.get_device_index();
  check(cudaDeviceGetAttribute(&out.multiprocessors, cudaDevAttrMultiProcessorCount, device), "a device query");
  check(cudaDeviceGetAttribute(&shared, cudaDevAttrMaxSharedMemoryPerBlockOptin, device), "a device query");
  out.shared = shared;
  return out;
}

// Memory for the kernels, and the number of scenes that it serves at once. Chunks of a whole number of waves.
template <class T>
Tensor workspace(const Tensor& x, const HostPlan& host, const StepInputs<T>& in, const StepAdjoints<T>* adjoints,
                 Choice& choice) {
  if (choice.regime == kThread) return empty(x, {in.scenes}, ScalarType::Byte);  // which scenes are rare
  choice.chunk = 1;
  const int64_t one = static_cast<int64_t>(workspace_bytes(host, in, adjoints, choice));
  const int64_t wave = choice.multiprocessors;
  choice.chunk = std::max<int64_t>(1, kWorkspaceBudget / one);
  if (choice.chunk > wave) choice.chunk -= choice.chunk % wave;
  choice.chunk = std::min(choice.chunk, std::max<int64_t>(1, in.scenes));
  const auto bytes = static_cast<int64_t>(workspace_bytes(host, in, adjoints, choice));
  return empty(x, {(bytes + static_cast<int64_t>(sizeof(T)) - 1) / static_cast<int64_t>(sizeof(T))});
}

// Scenes first, but last where each thread has a scene: who mixes up the two is told so by the shape.
template <class T>
std::vector<int64_t> tape_shape(const HostPlan& host, const StepInputs<T>& in, const std::vector<int64_t>& launch) {
  const int64_t rows = tape_rows(in.tape_policy, kept_scalars(in.energies));
  const int64_t active = host.plan.num_active;
  if (launch[0] == kThread) return {in.sweeps, rows, active, in.scenes};
  return {in.scenes, in.sweeps, rows, active};
}

template <class T>
void check_tape(const Tensor& tape, const Tensor& x, const HostPlan& host, const StepInputs<T>& in,
                const std::vector<int64_t>& launch) {
  const std::vector<int64_t> shape = tape_shape(host, in, launch);
  bool same = is_like(tape, x) && tape.dim() == 4;
  for (int i = 0; same && i < 4; ++i) same = tape.size(i) == shape[i];
  require(same, "tape: expected that of this step, of the dtype and on the device of x");
}

// The kinds of adjoints that a reverse kernel is compiled for.
template <class T>
int wishes(const StepAdjoints<T>& out) {
  return (out.material[0] ? kMaterial : 0) | (out.rest ? kMaterial | kRest : 0);
}

}  // namespace diffvbd::cuda
