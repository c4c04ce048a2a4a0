// What the CUDA registrations of sweeps share: tensors to the arrays of a step, of its adjoint and of its kernels.
#pragma once

#include <torch/csrc/stable/accelerator.h>

#include <tuple>

#include "../../cuda/step.h"
#include "binding.h"

namespace diffvbd::cuda {

using torch::stable::accelerator::DeviceGuard;

constexpr int64_t kWorkspaceBudget = int64_t{2} << 30;  // bytes; a batch that needs more is worked on in chunks
constexpr int kHostSizes = kPlanHeader;                 // a plan's header, but active, tets and slots come first

inline HostPlan plan_of(const Tensor& buffer, const std::vector<int64_t>& sizes) {
  require(buffer.scalar_type() == ScalarType::Int && buffer.is_contiguous() && buffer.is_cuda() &&
              sizes.size() > kHostSizes && static_cast<int64_t>(sizes.size()) == kHostSizes + sizes[4] + 1,
          "diffvbd: expected a plan made for CUDA by build_plan, and its sizes");
  const int order[kPlanHeader] = {3, 1, 0, 4, 5, 2, 6, 7, 8, 9, 10};
  int32_t header[kPlanHeader];
  for (int i = 0; i < kPlanHeader; ++i) header[i] = static_cast<int32_t>(sizes[order[i]]);
  return {view_group_plan(header, data<const int32_t>(buffer)), sizes.data() + kHostSizes, static_cast<int>(sizes[9]),
          static_cast<int>(sizes[10])};
}

// What all four sweep operators have in common.
template <class T>
StepInputs<T> inputs(const HostPlan& host, const Tensor& x, const Tensor& mu, const Tensor& lam, const Tensor& mass,
                     const Tensor& rest, int64_t energies, const std::vector<int64_t>& data_count,
                     const std::vector<double>& numbers, int64_t sweeps, int64_t tape_policy) {
  const GroupPlan& plan = host.plan;
  require(x.dim() == 3 && x.size(1) == plan.num_vertices && x.size(2) == 3,
          "diffvbd::sweep: expected x of shape [scenes, vertices, 3]");
  const int64_t b = x.size(0);
  StepInputs<T> in{};
  in.scenes = b;
  in.mu = batched<T>(mu, x, b, plan.num_tets);
  in.lam = batched<T>(lam, x, b, plan.num_tets);
  in.mass = batched<T>(mass, x, b, plan.num_vertices);
  in.rest = batched<T>(rest, x, b, int64_t{plan.slots} * 4 * kSlice);
  constexpr int elastic = kExactBlock | kPaperBlock;
  in.energies = static_cast<int>(plan.num_tets > 0 ? energies : energies & ~elastic);
  in.data_size = energy_data_size(data_count, plan.num_vertices);
  for (int k = 0; k < kVertexEnergies; ++k) in.data_count[k] = static_cast<int>(data_count[k]);
  in.parameters = step_parameters<T>(numbers);
  in.sweeps = count_of(sweeps);
  in.tape_policy = static_cast<int>(tape_policy);
  return in;
}

// The regime and threads per vertex that Python chose, and what the device adds.
inline Choice choose(const Tensor& x, const std::vector<int64_t>& launch, bool reverse, int wanted = 0) {
  require(launch.size() == 3 && launch[0] >= kThread && launch[0] <= kColor, "diffvbd: bad launch");
  const int64_t lanes = launch[reverse ? 2 : 1];
  require(lanes == kFewLanes || lanes == kSomeLanes || lanes == kManyLanes, "diffvbd: bad launch");
  Choice out{};
  out.regime = static_cast<int>(launch[0]);
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
  const int64_t rows = tape_rows(in.tape_policy, keeps_positions(in.energies));
  const int64_t active = host.plan.num_active;
  if (launch[0] == kThread) return {in.sweeps, rows, active, in.scenes};
  return {in.scenes, in.sweeps, rows, active};
}

template <class T>
void check_tape(const Tensor& tape, const HostPlan& host, const StepInputs<T>& in, const std::vector<int64_t>& launch) {
  const std::vector<int64_t> shape = tape_shape(host, in, launch);
  bool same = tape.is_contiguous() && tape.dim() == 4;
  for (int i = 0; same && i < 4; ++i) same = tape.size(i) == shape[i];
  require(same, "diffvbd: the tape does not belong to this step");
}

// The adjoints of a sweep's tensors. wants: material, mass, rest, energy data.
template <class T>
struct Bars {
  Tensor x_start, x_prev, y, mu, lam, mass, rest, data;
  bool elastic;

  Bars(const Tensor& x, const StepInputs<T>& in, const HostPlan& host, const std::vector<bool>& wants) {
    require(wants.size() == 4, "diffvbd: expected 4 wishes");
    const int64_t b = in.scenes, v = host.plan.num_vertices, t = host.plan.num_tets;
    elastic = (in.energies & (kExactBlock | kPaperBlock)) != 0;
    const int64_t materials = in.mu.item == 0 && in.lam.item == 0 ? 1 : t;
    const auto wanted = [&](int i, const std::vector<int64_t>& shape, bool zeroed) {
      const std::vector<int64_t> sizes = wants[i] ? shape : std::vector<int64_t>{0};
      return zeroed ? zeros(x, sizes) : empty(x, sizes);
    };
    x_start = empty(x, {b, v, 3}), x_prev = empty(x, {b, v, 3}), y = empty(x, {b, v, 3});
    mu = wanted(0, {b, materials}, !elastic), lam = wanted(0, {b, materials}, !elastic);
    mass = wanted(1, {b, v}, false), rest = wanted(2, {b, t, kRestScalars}, !elastic);
    data = wanted(3, {b, in.data_size}, false);
  }
  // Null: not wanted, or nothing to write.
  StepAdjoints<T> pointers(const Tensor& x_bar) const {
    require(x_bar.is_contiguous() && x_bar.numel() == x_start.numel(), "diffvbd::sweep_backward: x_bar must be like x");
    const auto of = [](bool flag, const Tensor& a) { return flag && a.numel() ? diffvbd::data<T>(a) : nullptr; };
    StepAdjoints<T> out{};
    out.x_bar = diffvbd::data<const T>(x_bar);
    out.x_start = diffvbd::data<T>(x_start), out.x_prev = diffvbd::data<T>(x_prev), out.y = diffvbd::data<T>(y);
    out.mu = of(elastic, mu), out.lam = of(elastic, lam), out.rest = of(elastic, rest);
    out.mass = of(true, mass), out.data = of(true, data);
    return out;
  }
  auto tensors() const { return std::make_tuple(x_start, x_prev, y, mu, lam, mass, rest, data); }
};

// The kinds of adjoints that a reverse kernel is compiled for.
template <class T>
int wishes(const StepAdjoints<T>& out) {
  return (out.mu ? kMaterial : 0) | (out.rest ? kMaterial | kRest : 0);
}

}  // namespace diffvbd::cuda
