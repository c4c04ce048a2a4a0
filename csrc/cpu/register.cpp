// CPU implementations of the operators: tensors in, raw pointers on.
#include <torch/csrc/stable/library.h>

#include <limits>
#include <tuple>
#include <vector>

#include "../arguments.h"
#include "reductions.h"
#include "run.h"

namespace {

using diffvbd::Batched, diffvbd::batched, diffvbd::data, diffvbd::dispatch_float, diffvbd::require;
using torch::headeronly::ScalarType;
using torch::stable::Tensor;

Tensor zeros(const Tensor& like, const std::vector<int64_t>& sizes) { return torch::stable::new_zeros(like, sizes); }
Tensor empty(const Tensor& like, const std::vector<int64_t>& sizes) { return torch::stable::new_empty(like, sizes); }

diffvbd::Plan plan_of(const Tensor& buffer, const std::vector<int64_t>& sizes) {
  require(buffer.scalar_type() == ScalarType::Int && buffer.is_contiguous() && buffer.numel() >= diffvbd::kPlanHeader,
          "diffvbd: expected a plan made by build_plan");
  const diffvbd::Plan plan = diffvbd::view_plan(data<const int32_t>(buffer));
  require(sizes.size() == 3 && sizes[0] == plan.num_active && sizes[1] == plan.num_tets && sizes[2] == plan.slots,
          "diffvbd: the sizes are not those of the plan");
  return plan;
}

template <class T>
diffvbd::StepInputs<T> inputs(const diffvbd::Plan& plan, const Tensor& x_start, const Tensor& x_prev, const Tensor& y,
                              const Tensor& mu, const Tensor& lam, const Tensor& mass, const Tensor& rest,
                              const Tensor& energy_data, const Tensor& origin, int64_t energies,
                              const std::vector<int64_t>& data_count, const std::vector<double>& numbers,
                              int64_t sweeps, int64_t tape_policy, int64_t debug_step) {
  require(x_start.dim() == 3 && x_start.size(1) == plan.num_vertices && x_start.size(2) == 3,
          "diffvbd::sweep: expected x of shape [scenes, vertices, 3]");
  const int64_t b = x_start.size(0), v3 = int64_t{plan.num_vertices} * 3;
  diffvbd::StepInputs<T> in{};
  in.scenes = b;
  in.x_start = batched<T>(x_start, x_start, b, v3);
  in.x_prev = batched<T>(x_prev, x_start, b, v3);
  in.y = batched<T>(y, x_start, b, v3);
  in.origin = batched<T>(origin, x_start, b, v3);
  in.mu = batched<T>(mu, x_start, b, plan.num_tets);
  in.lam = batched<T>(lam, x_start, b, plan.num_tets);
  in.mass = batched<T>(mass, x_start, b, plan.num_vertices);
  in.rest = batched<T>(rest, x_start, b, int64_t{plan.slots} * 4 * diffvbd::kLanes);
  in.data = batched<T>(energy_data, x_start, b, diffvbd::energy_data_size(data_count, plan.num_vertices));
  for (int k = 0; k < diffvbd::kVertexEnergies; ++k) in.data_count[k] = static_cast<int>(data_count[k]);
  in.energies = static_cast<int>(energies);
  in.parameters = diffvbd::step_parameters<T>(numbers);
  in.sweeps = diffvbd::count_of(sweeps);
  in.tape_policy = static_cast<int>(tape_policy);
  in.debug_step = debug_step;
  return in;
}

std::tuple<Tensor, Tensor> sweep(const Tensor& x_start, const Tensor& x_prev, const Tensor& y, const Tensor& mu,
                                 const Tensor& lam, const Tensor& mass, const Tensor& rest, const Tensor& energy_data,
                                 const Tensor& origin, const Tensor& plan_buffer, std::vector<int64_t> sizes,
                                 int64_t energies, std::vector<int64_t> data_count, std::vector<double> numbers,
                                 int64_t sweeps, std::vector<int64_t> /*launch*/, int64_t tape_policy,
                                 int64_t debug_step, bool checked) {
  const diffvbd::Plan plan = plan_of(plan_buffer, sizes);
  return dispatch_float(x_start, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = inputs<T>(plan, x_start, x_prev, y, mu, lam, mass, rest, energy_data, origin, energies, data_count,
                              numbers, sweeps, tape_policy, debug_step);
    if (checked) diffvbd::check_values(plan, in);
    Tensor x = empty(x_start, {in.scenes, plan.num_vertices, 3});
    const int rows = diffvbd::tape_rows(in.tape_policy, diffvbd::filters(in.energies));
    Tensor tape = empty(x_start, {in.scenes, sweeps, rows, plan.num_active});
    diffvbd::run_forward<T>(plan, in, data<T>(x), data<T>(tape));
    return std::make_tuple(x, tape);
  });
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> sweep_backward(
    const Tensor& x_bar, const Tensor& x, const Tensor& x_prev, const Tensor& y, const Tensor& mu, const Tensor& lam,
    const Tensor& mass, const Tensor& rest, const Tensor& energy_data, const Tensor& origin, const Tensor& tape,
    const Tensor& plan_buffer, std::vector<int64_t> sizes, int64_t energies, std::vector<int64_t> data_count,
    std::vector<double> numbers, int64_t sweeps, std::vector<int64_t> /*launch*/, int64_t tape_policy,
    std::vector<bool> wants) {
  const diffvbd::Plan plan = plan_of(plan_buffer, sizes);
  require(wants.size() == 4 && tape_policy != diffvbd::kNoTape, "diffvbd::sweep_backward: bad arguments");
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = inputs<T>(plan, x, x_prev, y, mu, lam, mass, rest, energy_data, origin, energies, data_count,
                              numbers, sweeps, tape_policy, -1);
    require(x_bar.is_contiguous() && x_bar.numel() == x.numel(), "diffvbd::sweep_backward: x_bar must be like x");
    const int64_t b = in.scenes, v = plan.num_vertices, t = plan.num_tets;
    const int rows = diffvbd::tape_rows(in.tape_policy, diffvbd::filters(in.energies));
    require(tape.is_contiguous() && tape.numel() == b * sweeps * rows * plan.num_active,
            "diffvbd::sweep_backward: the tape does not belong to this step");
    const bool material = wants[0], of_mass = wants[1], of_rest = wants[2], of_data = wants[3];
    const Tensor none = empty(x, {0});
    Tensor x_start_bar = empty(x, {b, v, 3}), x_prev_bar = zeros(x, {b, v, 3}), y_bar = empty(x, {b, v, 3});
    Tensor mu_bar = material ? zeros(x, {b, t}) : none, lam_bar = material ? zeros(x, {b, t}) : none;
    Tensor mass_bar = of_mass ? zeros(x, {b, v}) : none, rest_bar = of_rest ? zeros(x, {b, t, 7}) : none;
    const int64_t size = diffvbd::energy_data_size(data_count, v);
    Tensor data_bar = of_data ? zeros(x, {b, size}) : none;
    const auto wanted = [&](bool flag, const Tensor& a) { return flag ? data<T>(a) : nullptr; };
    const diffvbd::StepAdjoints<T> out{data<T>(x_start_bar),      data<T>(x_prev_bar),       data<T>(y_bar),
                                       wanted(material, mu_bar),  wanted(material, lam_bar), wanted(of_mass, mass_bar),
                                       wanted(of_rest, rest_bar), wanted(of_data, data_bar)};
    diffvbd::run_reverse<T>(plan, in, data<const T>(x), data<const T>(x_bar), data<const T>(tape), out);
    return std::make_tuple(x_start_bar, x_prev_bar, y_bar, mu_bar, lam_bar, mass_bar, rest_bar, data_bar);
  });
}

Tensor pack_rest(const Tensor& rest, const Tensor& plan_buffer, std::vector<int64_t> sizes) {
  const diffvbd::Plan plan = plan_of(plan_buffer, sizes);
  require(rest.dim() == 3 && rest.size(1) == plan.num_tets && rest.size(2) == 7 && rest.is_contiguous(),
          "diffvbd::pack_rest: expected contiguous rest of shape [scenes, tets, 7]");
  return dispatch_float(rest, [&](auto scalar) {
    using T = decltype(scalar);
    const int64_t b = rest.size(0), size = int64_t{plan.slots} * 4 * diffvbd::kLanes;
    Tensor out = empty(rest, {b, plan.slots, 4, diffvbd::kLanes});
    for (int64_t i = 0; i < b; ++i) {
      diffvbd::pack_rest<T>(plan, data<const T>(rest) + i * plan.num_tets * 7, data<T>(out) + i * size);
    }
    return out;
  });
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> build_plan(const Tensor& points, const Tensor& tets,
                                                              const Tensor& active, int64_t lanes) {
  require(points.scalar_type() == ScalarType::Double && tets.scalar_type() == ScalarType::Long &&
              active.scalar_type() == ScalarType::Bool && points.is_contiguous() && tets.is_contiguous() &&
              active.is_contiguous() && points.size(0) == active.size(0),
          "diffvbd::build_plan: expected points [V, 3] float64, tets [T, 4] int64, active [V] bool");
  const int64_t v = points.size(0), t = tets.size(0);
  require(4 * t <= std::numeric_limits<int32_t>::max() && v <= std::numeric_limits<int32_t>::max(),
          "mesh: too large, expected at most 2^31 (vertex, tet) pairs");
  const int64_t* tet = data<const int64_t>(tets);
  const diffvbd::Stars stars = diffvbd::build_stars(tet, t, v);
  int colors = 0;
  const diffvbd::Adjacency graph = diffvbd::build_adjacency(tet, stars);
  const std::vector<int32_t> color = diffvbd::color_vertices(stars, graph, data<const uint8_t>(active), &colors);
  require(lanes == diffvbd::kLanes || lanes == diffvbd::kSlice, "diffvbd::build_plan: expected 8 or 32 lanes");
  const auto build = lanes == diffvbd::kLanes ? diffvbd::build_plan : diffvbd::build_group_plan;
  const std::vector<int32_t> buffer = build(data<const double>(points), tet, t, stars, graph, color, colors);
  diffvbd::Plan plan{};
  diffvbd::PlanReader(buffer.data(), buffer.data()).blocks(plan, static_cast<int>(lanes));

  Tensor plan_out = torch::stable::empty({static_cast<int64_t>(buffer.size())}, ScalarType::Int);
  std::copy(buffer.begin(), buffer.end(), data<int32_t>(plan_out));
  Tensor color_ptr = empty(tets, {colors + 1}), members = empty(tets, {plan.num_active});
  for (int c = 0; c <= colors; ++c) data<int64_t>(color_ptr)[c] = plan.block_rank[plan.color_block[c]];
  int64_t n = 0;
  for (int64_t i = 0; i < plan.color_block[colors] * lanes; ++i) {
    if (plan.order[i] >= 0) data<int64_t>(members)[n++] = plan.order[i];
  }
  Tensor star_ptr = empty(tets, {v + 1}), star = torch::stable::empty({4 * t}, ScalarType::Int);
  std::copy(stars.ptr.begin(), stars.ptr.end(), data<int64_t>(star_ptr));
  std::copy(stars.entry.begin(), stars.entry.end(), data<int32_t>(star));
  return {plan_out, color_ptr, members, star_ptr, star};
}

Tensor tet_gather(const Tensor& values, const Tensor& tets) {
  require(values.dim() == 3 && values.is_contiguous() && tets.is_contiguous() && tets.scalar_type() == ScalarType::Long,
          "diffvbd::tet_gather: expected values [scenes, vertices, C] and tets [T, 4] int64");
  return dispatch_float(values, [&](auto scalar) {
    using T = decltype(scalar);
    const int64_t b = values.size(0), v = values.size(1), c = values.size(2), n = tets.numel();
    Tensor out = empty(values, {b, tets.size(0), 4, c});
    for (int64_t i = 0; i < b; ++i) {
      diffvbd::gather_rows(data<const T>(values) + i * v * c, data<const int64_t>(tets), n, c,
                           data<T>(out) + i * n * c);
    }
    return out;
  });
}

Tensor star_sum(const Tensor& values, const Tensor& star_ptr, const Tensor& star, bool positive) {
  require(values.dim() == 4 && values.is_contiguous() && star.scalar_type() == ScalarType::Int,
          "diffvbd::star_sum: expected values [scenes, tets, 4, C]");
  return dispatch_float(values, [&](auto scalar) {
    using T = decltype(scalar);
    const int64_t b = values.size(0), n = values.size(1) * 4, c = values.size(3), v = star_ptr.size(0) - 1;
    if (positive) diffvbd::check_masses(data<const T>(values), b, values.size(1), 4 * c);
    Tensor out = empty(values, {b, v, c});
    for (int64_t i = 0; i < b; ++i) {
      diffvbd::sum_segments(data<const T>(values) + i * n * c, data<const int64_t>(star_ptr), data<const int32_t>(star),
                            v, c, data<T>(out) + i * v * c);
    }
    return out;
  });
}

Tensor row_sum(const Tensor& values) {
  require(values.dim() == 2 && values.is_contiguous(), "diffvbd::row_sum: expected a contiguous matrix");
  return dispatch_float(values, [&](auto scalar) {
    using T = decltype(scalar);
    const int64_t rows = values.size(0), columns = values.size(1);
    Tensor out = empty(values, {rows});
    for (int64_t i = 0; i < rows; ++i) {
      data<T>(out)[i] = diffvbd::pairwise_sum(data<const T>(values) + i * columns, columns);
    }
    return out;
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CPU, m) {
  m.impl("sweep", TORCH_BOX(&sweep));
  m.impl("sweep_backward", TORCH_BOX(&sweep_backward));
  m.impl("pack_rest", TORCH_BOX(&pack_rest));
  m.impl("build_plan", TORCH_BOX(&build_plan));
  m.impl("tet_gather", TORCH_BOX(&tet_gather));
  m.impl("star_sum", TORCH_BOX(&star_sum));
  m.impl("row_sum", TORCH_BOX(&row_sum));
}
