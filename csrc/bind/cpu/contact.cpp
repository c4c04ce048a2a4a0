// CPU implementations of detection, islands and sums over segments: tensors in, raw pointers on.
#include <torch/csrc/stable/library.h>

#include <algorithm>
#include <tuple>
#include <vector>

#include "../../cpu/detect.h"
#include "../../cpu/motion.h"
#include "../detection.h"

namespace {

using diffvbd::data, diffvbd::dispatch_float;
using torch::headeronly::ScalarType;
using torch::stable::Tensor;

Tensor empty(const Tensor& like, const std::vector<int64_t>& sizes) { return torch::stable::new_empty(like, sizes); }
Tensor integers(const std::vector<int64_t>& sizes) { return torch::stable::empty(sizes, ScalarType::Int); }

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> contact_detect(
    const Tensor& x, const Tensor& origin, const Tensor& collider, const Tensor& collider_next, const Tensor& rest,
    const Tensor& radius, const Tensor& triangles, const Tensor& edges, const Tensor& points, const Tensor& planes,
    const Tensor& body, const Tensor& held, const Tensor& room, const Tensor& own_room, int64_t mesh_bodies,
    bool self_contact, bool between_bodies, double dhat, int64_t capacity, bool trim) {
  diffvbd::require_capacity(capacity);
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    auto in = diffvbd::surfaces_of<T>(x, origin, collider, collider_next, rest, radius, triangles, edges, points,
                                      planes, body, held, mesh_bodies, self_contact, between_bodies);
    diffvbd::set_reach(in, x, room, own_room, dhat);
    const int64_t b = in.scenes, n = in.corners;
    Tensor near_corners = integers({b, n, diffvbd::contact::kNearRow}), ptr = integers({b * n + 1});
    Tensor near_values = empty(x, {b, n, diffvbd::contact::kNearValues}), smallest = empty(x, {b});
    Tensor counts = torch::stable::empty({diffvbd::contact::kCounts}, ScalarType::Long);
    diffvbd::contact::Detected<T> out{};
    out.near_corners = data<int32_t>(near_corners), out.near_values = data<T>(near_values);
    out.counts = data<int64_t>(counts), out.smallest = data<T>(smallest);
    const std::vector<uint64_t> keys = diffvbd::detect<T>(in, out);
    // Rows that no pair fills would cost more than the search where there is room for many.
    out.capacity = trim ? std::min(capacity, static_cast<int64_t>(keys.size())) : capacity;
    Tensor pairs = integers({out.capacity, diffvbd::contact::kPairRow});
    Tensor constants = empty(x, {out.capacity, diffvbd::contact::kConstants}), entry = integers({4 * out.capacity});
    out.pairs = data<int32_t>(pairs), out.constants = data<T>(constants);
    out.ptr = data<int32_t>(ptr), out.entry = data<int32_t>(entry);
    diffvbd::store_list<T>(in, keys, out);
    return std::make_tuple(pairs, constants, ptr, entry, near_corners, near_values, counts, smallest);
  });
}

std::tuple<Tensor, Tensor, Tensor> contact_intersections(const Tensor& x, const Tensor& origin, const Tensor& collider,
                                                         const Tensor& rest, const Tensor& radius,
                                                         const Tensor& triangles, const Tensor& edges,
                                                         const Tensor& points, const Tensor& planes, const Tensor& body,
                                                         const Tensor& held, int64_t mesh_bodies, bool self_contact,
                                                         bool between_bodies, int64_t capacity) {
  diffvbd::require_capacity(capacity);
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::surfaces_of<T>(x, origin, collider, collider, rest, radius, triangles, edges, points,
                                            planes, body, held, mesh_bodies, self_contact, between_bodies);
    Tensor pairs = integers({capacity, diffvbd::contact::kCrossingRow}), first = integers({in.scenes, 2, 2});
    Tensor counts = torch::stable::empty({in.scenes, 2}, ScalarType::Long);
    diffvbd::find_intersections<T>(in, {capacity, data<int32_t>(pairs), data<int64_t>(counts), data<int32_t>(first)});
    return std::make_tuple(pairs, counts, first);
  });
}

Tensor contact_islands(const Tensor& x, const Tensor& origin, const Tensor& move, const Tensor& mass,
                       const Tensor& collider, const Tensor& collider_next, const Tensor& planes, const Tensor& body,
                       const Tensor& body_order, const Tensor& body_ptr, const Tensor& held, const Tensor& radius,
                       const Tensor& room, int64_t mesh_bodies, double dhat, bool any_direction) {
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::island_inputs<T>(x, origin, move, mass, collider, collider_next, planes, body, body_order,
                                              body_ptr, held, radius, room, mesh_bodies, dhat, any_direction);
    Tensor island = integers({in.scenes, in.mesh_bodies});
    diffvbd::find_islands<T>(in, data<int32_t>(island));
    return island;
  });
}

Tensor segment_sum(const Tensor& values, const Tensor& order, const Tensor& ptr) {
  diffvbd::check_segments(values, order, ptr);
  return dispatch_float(values, [&](auto scalar) {
    using T = decltype(scalar);
    const int64_t b = values.size(0), n = values.size(1), c = values.size(2), segments = ptr.numel() - 1;
    Tensor out = empty(values, {b, segments, c});
    diffvbd::segment_sum<T>(data<const T>(values), data<const int32_t>(order), data<const int32_t>(ptr), b, n, segments,
                            c, data<T>(out));
    return out;
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CPU, m) {
  m.impl("contact_detect", TORCH_BOX(&contact_detect));
  m.impl("contact_intersections", TORCH_BOX(&contact_intersections));
  m.impl("contact_islands", TORCH_BOX(&contact_islands));
  m.impl("segment_sum", TORCH_BOX(&segment_sum));
}
