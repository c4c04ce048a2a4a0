// CUDA implementations of detection, islands and sums over segments: tensors in, raw pointers on.
#include "../../cuda/contact.h"

#include <torch/csrc/stable/accelerator.h>
#include <torch/csrc/stable/library.h>

#include <tuple>

#include "../../cuda/arrays.h"
#include "../detection.h"
#include "binding.h"

namespace {

namespace contact = diffvbd::contact;
namespace cuda = diffvbd::cuda;
using cuda::check, cuda::current_stream, cuda::empty, diffvbd::data, diffvbd::dispatch_float;
using torch::headeronly::ScalarType;
using torch::stable::Tensor;
using torch::stable::accelerator::DeviceGuard;

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> contact_detect(
    const Tensor& x, const Tensor& origin, const Tensor& collider, const Tensor& collider_next, const Tensor& rest,
    const Tensor& radius, const Tensor& triangles, const Tensor& edges, const Tensor& points, const Tensor& planes,
    const Tensor& body, const Tensor& held, const Tensor& room, const Tensor& own_room, int64_t mesh_bodies,
    bool self_contact, bool between_bodies, double dhat, int64_t capacity,
    bool /* trim: to know the number of pairs would wait */) {
  const DeviceGuard guard(x.get_device_index());
  diffvbd::require_capacity(capacity);
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    auto in = diffvbd::surfaces_of<T>(x, origin, collider, collider_next, rest, radius, triangles, edges, points,
                                      planes, body, held, mesh_bodies, self_contact, between_bodies);
    diffvbd::set_reach(in, x, room, own_room, dhat);
    const int64_t b = in.scenes, n = in.corners;
    Tensor pairs = empty(x, {capacity, contact::kPairRow}, ScalarType::Int);
    Tensor constants = empty(x, {capacity, contact::kConstants});
    Tensor ptr = empty(x, {b * n + 1}, ScalarType::Int), entry = empty(x, {4 * capacity}, ScalarType::Int);
    Tensor near_corners = empty(x, {b, n, contact::kNearRow}, ScalarType::Int);
    Tensor near_values = empty(x, {b, n, contact::kNearValues}), smallest = empty(x, {b});
    Tensor counts = empty(x, {contact::kCounts}, ScalarType::Long);
    const auto bytes = static_cast<int64_t>(cuda::detect_workspace_bytes<T>(in, capacity));
    const Tensor work = empty(x, {bytes}, ScalarType::Byte);
    check(cuda::detect<T>(in,
                          {capacity, data<int32_t>(pairs), data<T>(constants), data<int32_t>(ptr), data<int32_t>(entry),
                           data<int32_t>(near_corners), data<T>(near_values), data<int64_t>(counts), data<T>(smallest)},
                          work.data_ptr(), current_stream(x)),
          "detection");
    return std::make_tuple(pairs, constants, ptr, entry, near_corners, near_values, counts, smallest);
  });
}

std::tuple<Tensor, Tensor, Tensor> contact_intersections(const Tensor& x, const Tensor& origin, const Tensor& collider,
                                                         const Tensor& rest, const Tensor& radius,
                                                         const Tensor& triangles, const Tensor& edges,
                                                         const Tensor& points, const Tensor& planes, const Tensor& body,
                                                         const Tensor& held, int64_t mesh_bodies, bool self_contact,
                                                         bool between_bodies, int64_t capacity) {
  const DeviceGuard guard(x.get_device_index());
  diffvbd::require_capacity(capacity);
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::surfaces_of<T>(x, origin, collider, collider, rest, radius, triangles, edges, points,
                                            planes, body, held, mesh_bodies, self_contact, between_bodies);
    Tensor pairs = empty(x, {capacity, contact::kCrossingRow}, ScalarType::Int);
    Tensor first = empty(x, {in.scenes, 2, 2}, ScalarType::Int), counts = empty(x, {in.scenes, 2}, ScalarType::Long);
    const auto bytes = static_cast<int64_t>(cuda::intersections_workspace_bytes<T>(in, capacity));
    const Tensor work = empty(x, {bytes}, ScalarType::Byte);
    check(cuda::find_intersections<T>(in, {capacity, data<int32_t>(pairs), data<int64_t>(counts), data<int32_t>(first)},
                                      work.data_ptr(), current_stream(x)),
          "the search for intersections");
    return std::make_tuple(pairs, counts, first);
  });
}

Tensor contact_islands(const Tensor& x, const Tensor& origin, const Tensor& move, const Tensor& mass,
                       const Tensor& collider, const Tensor& collider_next, const Tensor& planes, const Tensor& body,
                       const Tensor& body_order, const Tensor& body_ptr, const Tensor& held, const Tensor& radius,
                       const Tensor& room, int64_t mesh_bodies, double dhat, bool any_direction) {
  const DeviceGuard guard(x.get_device_index());
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::island_inputs<T>(x, origin, move, mass, collider, collider_next, planes, body, body_order,
                                              body_ptr, held, radius, room, mesh_bodies, dhat, any_direction);
    Tensor island = empty(x, {in.scenes, in.mesh_bodies}, ScalarType::Int);
    const auto bytes = static_cast<int64_t>(cuda::islands_workspace_bytes<T>(in));
    const Tensor work = empty(x, {bytes}, ScalarType::Byte);
    check(cuda::find_islands<T>(in, data<int32_t>(island), work.data_ptr(), current_stream(x)), "the islands");
    return island;
  });
}

Tensor segment_sum(const Tensor& values, const Tensor& order, const Tensor& ptr) {
  const DeviceGuard guard(values.get_device_index());
  diffvbd::check_segments(values, order, ptr);
  return dispatch_float(values, [&](auto scalar) {
    using T = decltype(scalar);
    const int64_t b = values.size(0), n = values.size(1), c = values.size(2), segments = ptr.numel() - 1;
    Tensor out = empty(values, {b, segments, c});
    check(cuda::segment_sum<T>(data<const T>(values), data<const int32_t>(order), data<const int32_t>(ptr), b, n,
                               segments, c, data<T>(out), current_stream(values)),
          "segment_sum");
    return out;
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CUDA, m) {
  m.impl("contact_detect", TORCH_BOX(&contact_detect));
  m.impl("contact_intersections", TORCH_BOX(&contact_intersections));
  m.impl("contact_islands", TORCH_BOX(&contact_islands));
  m.impl("segment_sum", TORCH_BOX(&segment_sum));
}
