// CPU implementations of the operators on a mesh: its plan, its rest shape, sums over stars in a fixed order.
#include <torch/csrc/stable/library.h>

#include <algorithm>
#include <limits>
#include <tuple>
#include <vector>

#include "../../cpu/reductions.h"
#include "sweep.h"

namespace {

using diffvbd::data, diffvbd::dispatch_float, diffvbd::empty, diffvbd::is_beside, diffvbd::is_index, diffvbd::plan_of,
    diffvbd::require;
using torch::headeronly::ScalarType;
using torch::stable::Tensor;

Tensor pack_rest(const Tensor& rest, const Tensor& plan_buffer, std::vector<int64_t> sizes) {
  const diffvbd::Plan plan = plan_of(plan_buffer, sizes);
  require(
      rest.dim() == 3 && rest.size(1) == plan.num_tets && rest.size(2) == diffvbd::kRestScalars && rest.is_contiguous(),
      "diffvbd::pack_rest: expected contiguous rest of shape [scenes, tets, 7]");
  return dispatch_float(rest, [&](auto scalar) {
    using T = decltype(scalar);
    const int64_t b = rest.size(0), size = int64_t{plan.slots} * diffvbd::kPairRest * diffvbd::kLanes;
    Tensor out = empty(rest, {b, plan.slots, diffvbd::kPairRest, diffvbd::kLanes});
    for (int64_t i = 0; i < b; ++i) {
      diffvbd::pack_rest<T>(plan, data<const T>(rest) + i * plan.num_tets * diffvbd::kRestScalars,
                            data<T>(out) + i * size);
    }
    return out;
  });
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> build_plan(const Tensor& points, const Tensor& tets,
                                                              const Tensor& active, int64_t lanes) {
  require(points.scalar_type() == ScalarType::Double && tets.scalar_type() == ScalarType::Long &&
              active.scalar_type() == ScalarType::Bool && points.is_contiguous() && tets.is_contiguous() &&
              active.is_contiguous() && points.dim() == 2 && points.size(1) == 3 && tets.dim() == 2 &&
              tets.size(1) == 4 && active.dim() == 1 && points.size(0) == active.size(0),
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
  require(values.dim() == 3 && values.is_contiguous() && is_beside(tets, values, ScalarType::Long) && tets.dim() == 2 &&
              tets.size(1) == 4,
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
  require(values.dim() == 4 && values.size(2) == 4 && values.is_contiguous() &&
              is_beside(star_ptr, values, ScalarType::Long) && star_ptr.dim() == 1 && star_ptr.numel() > 0 &&
              is_index(star, values),
          "diffvbd::star_sum: expected values [scenes, tets, 4, C], star_ptr [V + 1] int64, star int32");
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
  m.impl("pack_rest", TORCH_BOX(&pack_rest));
  m.impl("build_plan", TORCH_BOX(&build_plan));
  m.impl("tet_gather", TORCH_BOX(&tet_gather));
  m.impl("star_sum", TORCH_BOX(&star_sum));
  m.impl("row_sum", TORCH_BOX(&row_sum));
}
