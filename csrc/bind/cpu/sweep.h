// What the CPU registrations share: tensors to the arrays of a step and of its adjoint.
#pragma once

#include <tuple>
#include <vector>

#include "../../cpu/run.h"
#include "../arguments.h"

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
  const Plan plan = view_plan(data<const int32_t>(buffer));
  require(sizes.size() == 3 && sizes[0] == plan.num_active && sizes[1] == plan.num_tets && sizes[2] == plan.slots,
          "diffvbd: the sizes are not those of the plan");
  return plan;
}

template <class T>
StepInputs<T> inputs(const Plan& plan, const Tensor& x_start, const Tensor& x_prev, const Tensor& y, const Tensor& mu,
                     const Tensor& lam, const Tensor& mass, const Tensor& rest, const Tensor& energy_data,
                     const Tensor& origin, int64_t energies, const std::vector<int64_t>& data_count,
                     const std::vector<double>& numbers, int64_t sweeps, int64_t tape_policy, int64_t debug_step) {
  require(x_start.dim() == 3 && x_start.size(1) == plan.num_vertices && x_start.size(2) == 3,
          "diffvbd::sweep: expected x of shape [scenes, vertices, 3]");
  const int64_t b = x_start.size(0), v3 = int64_t{plan.num_vertices} * 3;
  StepInputs<T> in{};
  in.scenes = b;
  in.x_start = batched<T>(x_start, x_start, b, v3);
  in.x_prev = batched<T>(x_prev, x_start, b, v3);
  in.y = batched<T>(y, x_start, b, v3);
  in.origin = batched<T>(origin, x_start, b, v3);
  in.mu = batched<T>(mu, x_start, b, plan.num_tets);
  in.lam = batched<T>(lam, x_start, b, plan.num_tets);
  in.mass = batched<T>(mass, x_start, b, plan.num_vertices);
  in.rest = batched<T>(rest, x_start, b, int64_t{plan.slots} * 4 * kLanes);
  in.data = batched<T>(energy_data, x_start, b, energy_data_size(data_count, plan.num_vertices));
  for (int k = 0; k < kVertexEnergies; ++k) in.data_count[k] = static_cast<int>(data_count[k]);
  in.energies = static_cast<int>(energies);
  in.parameters = step_parameters<T>(numbers);
  in.sweeps = count_of(sweeps);
  in.tape_policy = static_cast<int>(tape_policy);
  in.debug_step = debug_step;
  return in;
}

template <class T>
std::vector<int64_t> tape_shape(const Plan& plan, const StepInputs<T>& in) {
  return {in.scenes, in.sweeps, tape_rows(in.tape_policy, keeps_positions(in.energies)), plan.num_active};
}

template <class T>
void check_tape(const Tensor& tape, const Plan& plan, const StepInputs<T>& in) {
  int64_t size = 1;
  for (const int64_t n : tape_shape(plan, in)) size *= n;
  require(tape.is_contiguous() && tape.numel() == size, "diffvbd: the tape does not belong to this step");
}

// The adjoints of a sweep's tensors. wants: material, mass, rest, energy data.
struct Bars {
  Tensor x_start, x_prev, y, mu, lam, mass, rest, data;

  Bars(const Tensor& x, const Plan& plan, const std::vector<int64_t>& data_count, const std::vector<bool>& wants) {
    require(wants.size() == 4, "diffvbd: expected 4 wishes");
    const int64_t b = x.size(0), v = plan.num_vertices, t = plan.num_tets;
    const auto wanted = [&](int i, std::vector<int64_t> shape) {
      return zeros(x, wants[i] ? shape : std::vector<int64_t>{0});
    };
    x_start = empty(x, {b, v, 3}), x_prev = zeros(x, {b, v, 3}), y = empty(x, {b, v, 3});
    mu = wanted(0, {b, t}), lam = wanted(0, {b, t});
    mass = wanted(1, {b, v}), rest = wanted(2, {b, t, kRestScalars});
    data = wanted(3, {b, energy_data_size(data_count, v)});
  }
  // A wish for data that a scene does not have is null, too.
  template <class T>
  StepAdjoints<T> pointers() const {
    const auto of = [](const Tensor& a) { return a.numel() ? diffvbd::data<T>(a) : nullptr; };
    StepAdjoints<T> out{};
    out.x_start = of(x_start), out.x_prev = of(x_prev), out.y = of(y);
    out.mu = of(mu), out.lam = of(lam), out.mass = of(mass), out.rest = of(rest), out.data = of(data);
    return out;
  }
  auto tensors() const { return std::make_tuple(x_start, x_prev, y, mu, lam, mass, rest, data); }
};

}  // namespace diffvbd
