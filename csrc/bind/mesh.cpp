// Operators on a mesh: its plan, its rest shape, sums in a fixed order, and the search for neighboring points.
#include <cstdio>

#include "plan.h"

namespace diffvbd {
namespace {

// The rest scalars of the tets [B, T, 7] as their vertices see them.
DIFFVBD_OPERATOR(Tensor, pack_rest, In rest, In plan, Ints sizes) {
  const Device device(rest);
  const HostPlan host = plan_of(plan, rest, sizes);
  require(
      rest.dim() == 3 && rest.size(1) == view_of(host).num_tets && rest.size(2) == kRestScalars && rest.is_contiguous(),
      "diffvbd::pack_rest: expected contiguous rest of shape [scenes, tets, 7]");
  return dispatch_float(rest, [&]<class T>(T) {
    Tensor out = device.empty({rest.size(0), view_of(host).slots, kRestRowOfPlan, kLanesOfPlan});
    DIFFVBD_RUN(device, pack_rest<T>, view_of(host), rest.size(0), data<const T>(rest), data<T>(out));
    return out;
  });
}

#ifndef DIFFVBD_LAW_HEADER  // what reads no law

DIFFVBD_OPERATOR(Tensor, tet_gather, In values, In tets) {
  const Device device(values);
  require(values.dim() == 3 && values.is_contiguous() && is_beside(tets, values, ScalarType::Long) && tets.dim() == 2 &&
              tets.size(1) == 4,
          "diffvbd::tet_gather: expected values [scenes, vertices, C] and tets [T, 4] int64");
  return dispatch_float(values, [&]<class T>(T) {
    Tensor out = device.empty({values.size(0), tets.size(0), 4, values.size(2)});
    DIFFVBD_RUN(device, gather_rows<T>, data<const T>(values), data<const int64_t>(tets), values.size(0),
                values.size(1), tets.numel(), values.size(2), data<T>(out));
    return out;
  });
}

// With `positive` the values are masses: one that is not finite and > 0 raises on the CPU; CUDA would have to wait.
DIFFVBD_OPERATOR(Tensor, star_sum, In values, In star_ptr, In star, bool positive) {
  const Device device(values);
  require(values.dim() == 4 && values.size(2) == 4 && values.is_contiguous() &&
              is_beside(star_ptr, values, ScalarType::Long) && star_ptr.dim() == 1 && star_ptr.numel() > 0 &&
              is_index(star, values),
          "diffvbd::star_sum: expected values [scenes, tets, 4, C], star_ptr [V + 1] int64, star int32");
  return dispatch_float(values, [&]<class T>(T) {
    const int64_t b = values.size(0), n = values.size(1) * 4, c = values.size(3), v = star_ptr.size(0) - 1;
#ifndef USE_CUDA
    if (positive) check_masses(data<const T>(values), b, values.size(1), 4 * c);
#endif
    Tensor out = device.empty({b, v, c});
    DIFFVBD_RUN(device, sum_segments<T>, data<const T>(values), data<const int64_t>(star_ptr),
                data<const int32_t>(star), b, n, v, c, data<T>(out));
    return out;
  });
}

DIFFVBD_OPERATOR(Tensor, row_sum, In values) {
  const Device device(values);
  require(values.dim() == 2 && values.is_contiguous(), "diffvbd::row_sum: expected a contiguous matrix");
  return dispatch_float(values, [&]<class T>(T) {
    const int64_t rows = values.size(0), columns = values.size(1);
    Tensor out = device.empty({rows});
    DIFFVBD_ON_CUDA(const Tensor partial = device.empty({cuda::partial_sums(rows, columns)});)
    DIFFVBD_RUN(device, sum_rows<T>, data<const T>(values), rows, columns,
                DIFFVBD_ON_CUDA(data<T>(partial), ) data<T>(out));
    return out;
  });
}

// [B, V, C] -> [B, S, C]: sums of values[:, order[ptr[s] ... ptr[s + 1]]].
DIFFVBD_OPERATOR(Tensor, segment_sum, In values, In order, In ptr) {
  const Device device(values);
  require(values.dim() == 3 && values.is_contiguous(), "segment_sum: expected contiguous values [B, V, C]");
  const auto* rows = array<int32_t>("order", order, values, ScalarType::Int, order.numel());
  const auto* first = array<int32_t>("ptr", ptr, values, ScalarType::Int, 1, true);
  return dispatch_float(values, [&]<class T>(T) {
    const int64_t b = values.size(0), n = values.size(1), c = values.size(2), segments = ptr.numel() - 1;
    Tensor out = device.empty({b, segments, c});
    DIFFVBD_RUN(device, segment_sum<T>, data<const T>(values), rows, first, b, n, segments, c, data<T>(out));
    return out;
  });
}

// points [B, N, 3]; pairs [max_pairs, 3] int32: (scene, i, j), then rows of -1; count [1] int64: how many there are, or
// -1 where a point is not finite.
DIFFVBD_OPERATOR(Out<2>, neighbor_pairs, In points, double radius, int64_t max_pairs) {
  const Device device(points);
  require(points.dim() == 3 && points.size(2) == 3 && points.is_contiguous(),
          "points: expected contiguous points of shape [scenes, points, 3]");
  require(points.size(0) * points.size(1) <= std::numeric_limits<int32_t>::max(),
          "points: expected fewer than 2^31 in all scenes");
  // Its square must be a normal number.
  const double limit = points.scalar_type() == ScalarType::Double ? 1e150 : 1e18;
  if (!(radius >= 1 / limit && radius <= limit)) {
    char text[96];
    std::snprintf(text, sizeof text, "radius: expected a number in [%g, %g] m, got %g", 1 / limit, limit, radius);
    throw std::invalid_argument(text);
  }
  require(max_pairs >= 0 && max_pairs <= int64_t{1} << 30, "max_pairs: expected an integer in [0, 2^30]");
  return dispatch_float(points, [&]<class T>(T) {
    const int64_t scenes = points.size(0), n = points.size(1);
    Tensor pairs = device.empty({max_pairs, 3}, ScalarType::Int), count = device.empty({1}, ScalarType::Long);
#ifdef USE_CUDA
    const Tensor work = device.bytes(static_cast<int64_t>(cuda::neighbor_workspace_bytes<T>(scenes * n)));
    DIFFVBD_RUN(device, neighbor_pairs<T>, data<const T>(points), scenes, n, radius, data<int32_t>(pairs), max_pairs,
                data<int64_t>(count), work.data_ptr());
#else
    *data<int64_t>(count) =
        neighbor_pairs<T>(data<const T>(points), scenes, n, radius, data<int32_t>(pairs), max_pairs);
#endif
    return Out<2>(pairs, count);
  });
}

#ifndef USE_CUDA

// On the CPU: plan, color_ptr, color_vertices, star_ptr and star (cpu/plan.h); lanes: of the backend that sweeps.
DIFFVBD_OPERATOR(Out<5>, build_plan, In points, In tets, In active, int64_t lanes) {
  require(points.scalar_type() == ScalarType::Double && tets.scalar_type() == ScalarType::Long &&
              active.scalar_type() == ScalarType::Bool && points.is_contiguous() && tets.is_contiguous() &&
              active.is_contiguous() && points.dim() == 2 && points.size(1) == 3 && tets.dim() == 2 &&
              tets.size(1) == 4 && active.dim() == 1 && points.size(0) == active.size(0),
          "diffvbd::build_plan: expected points [V, 3] float64, tets [T, 4] int64, active [V] bool");
  const int64_t v = points.size(0), t = tets.size(0);
  require(4 * t <= std::numeric_limits<int32_t>::max() && v <= std::numeric_limits<int32_t>::max(),
          "mesh: too large, expected at most 2^31 (vertex, tet) pairs");
  const int64_t* tet = data<const int64_t>(tets);
  const Stars stars = build_stars(tet, t, v);
  int colors = 0;
  const Adjacency graph = build_adjacency(tet, stars);
  const std::vector<int32_t> color = color_vertices(stars, graph, data<const uint8_t>(active), &colors);
  require(lanes == kLanes || lanes == kSlice, "diffvbd::build_plan: expected 8 or 32 lanes");
  const auto build = lanes == kLanes ? build_plan : build_group_plan;
  const std::vector<int32_t> buffer = build(data<const double>(points), tet, t, stars, graph, color, colors);
  Plan plan{};
  PlanReader(buffer.data(), buffer.data()).blocks(plan, static_cast<int>(lanes));

  const Device device(tets);
  Tensor plan_out = device.empty({static_cast<int64_t>(buffer.size())}, ScalarType::Int);
  std::copy(buffer.begin(), buffer.end(), data<int32_t>(plan_out));
  Tensor color_ptr = device.empty({colors + 1}), members = device.empty({plan.num_active});
  for (int c = 0; c <= colors; ++c) data<int64_t>(color_ptr)[c] = plan.block_rank[plan.color_block[c]];
  int64_t n = 0;
  for (int64_t i = 0; i < plan.color_block[colors] * lanes; ++i) {
    if (plan.order[i] >= 0) data<int64_t>(members)[n++] = plan.order[i];
  }
  Tensor star_ptr = device.empty({v + 1}), star = device.empty({4 * t}, ScalarType::Int);
  std::copy(stars.ptr.begin(), stars.ptr.end(), data<int64_t>(star_ptr));
  std::copy(stars.entry.begin(), stars.entry.end(), data<int32_t>(star));
  return {plan_out, color_ptr, members, star_ptr, star};
}

#endif
#endif

}  // namespace
}  // namespace diffvbd
