// Operators that search: pairs of primitives, alone and within the trust regions of a substep; intersections of
// surfaces.
#include <cmath>

#include "../contact/detection.h"
#include "../contact/motion.h"
#include "../contact/trust_region.h"
#include "contact.h"

namespace diffvbd {
namespace {

// Surfaces, as a search reads them; trust_radius and deformation_radius set the search distance.
template <class T>
contact::Surfaces<T> surfaces_of(const Tensor& x, const Tensor& origin, const Tensor& collider,
                                 const Tensor& collider_next, const Tensor& rest, const Tensor& radius,
                                 const Tensor& triangles, const Tensor& edges, const Tensor& points,
                                 const Tensor& planes, const Tensor& body, const Tensor& pinned, int64_t mesh_bodies,
                                 bool self_contact, bool between_bodies) {
  const Reader<T> read(x);
  const int64_t b = read.b, n = body.numel();
  require(read.v <= n && mesh_bodies >= 0, "contact: expected body of shape [N], N >= vertices, and mesh_bodies >= 0");
  const auto primitives = [&](const char* name, const Tensor& t, int64_t each, int32_t& count) {
    require(b * t.numel() <= std::numeric_limits<int32_t>::max(),
            "contact: too large, expected at most 2^31 corners of primitives");
    count = static_cast<int32_t>(t.size(0));
    return read.index(name, t, each * count);
  };
  contact::Surfaces<T> out{};
  out.x = read.positions(), out.origin = read.vectors_or_null("origin", origin);
  out.collider = read.like("collider", collider, 3 * b * (n - read.v));
  out.collider_next = read.like("collider_next", collider_next, 3 * b * (n - read.v));
  out.rest = read.like("rest", rest, 3 * n), out.radius = read.like("radius", radius, n);
  out.triangles = primitives("triangles", triangles, 3, out.num_triangles);
  out.edges = primitives("edges", edges, 2, out.num_edges);
  out.points = primitives("points", points, 1, out.num_points);
  out.planes = primitives("planes", planes, 3, out.num_planes);
  out.body = read.index("body", body, n), out.pinned = read.flags("pinned", pinned, n);
  require(b * n + 1 <= std::numeric_limits<int32_t>::max(),
          "contact: too large, expected at most 2^31 corner points in all scenes");
  out.scenes = b;
  out.vertices = static_cast<int32_t>(read.v), out.corners = static_cast<int32_t>(n);
  out.mesh_bodies = count_of(mesh_bodies);
  out.self_contact = self_contact, out.between_bodies = between_bodies;
  const double base = static_cast<double>(out.key_base());
  require(3.0 * static_cast<double>(b) * base * base < 0x1p63, "contact: too many scenes of this size");
  return out;
}

void require_capacity(int64_t capacity) {
  require(capacity >= 0 && 4 * capacity <= std::numeric_limits<int32_t>::max(),
          "contact: expected 0 <= capacity < 2^29");
}

// The pairs of `in`, whose radii are known; results as in contact/detection.h. trim (CPU): the list has as many rows as
// there are pairs, and no more than the capacity. On CUDA to know their number would wait.
template <class T>
Out<8> detected(const Device& device, contact::Surfaces<T> in, const Tensor& x, const Tensor& face_counts,
                const Tensor& point_weights, double dhat, int64_t capacity, bool trim) {
  require_capacity(capacity);
  require(std::isfinite(dhat), "contact: expected a finite dhat");
  const Reader<T> read(x);
  in.counts = read.index("face_counts", face_counts, int64_t{in.num_triangles} + in.num_edges);
  in.weights = read.like("point_weights", point_weights, in.num_points);
  in.dhat = static_cast<T>(dhat);
  const int64_t b = in.scenes, n = in.corners;
  Tensor near_corners = device.empty({b, n, contact::kNearRow}, ScalarType::Int);
  Tensor near_values = device.empty({b, n, contact::kNearValues}), smallest = device.empty({b});
  Tensor counts = device.empty({contact::kCounts}, ScalarType::Long);
  contact::Detected<T> out{};
  out.near_corners = data<int32_t>(near_corners), out.near_values = data<T>(near_values);
  out.counts = data<int64_t>(counts), out.smallest = data<T>(smallest);
  out.capacity = capacity;
#ifndef USE_CUDA
  const std::vector<uint64_t> keys = detect<T>(in, out);
  // Rows that no pair fills would cost more than the search where there is room for many.
  if (trim) out.capacity = std::min(capacity, static_cast<int64_t>(keys.size()));
#endif
  Tensor pairs = device.empty({out.capacity, contact::kPairRow}, ScalarType::Int);
  Tensor constants = device.empty({out.capacity, contact::kConstants});
  Tensor ptr = device.empty({b * n + 1}, ScalarType::Int), entry = device.empty({4 * out.capacity}, ScalarType::Int);
  out.pairs = data<int32_t>(pairs), out.constants = data<T>(constants);
  out.ptr = data<int32_t>(ptr), out.entry = data<int32_t>(entry);
#ifdef USE_CUDA
  const Tensor work = device.bytes(static_cast<int64_t>(cuda::detect_workspace_bytes<T>(in, capacity)));
  DIFFVBD_RUN(device, detect<T>, in, out, work.data_ptr());
#else
  store_list<T>(in, keys, out);
#endif
  return {pairs, constants, ptr, entry, near_corners, near_values, counts, smallest};
}

// mesh_bodies: body labels from there on are colliders; radii [scenes, mesh_bodies + 1]: how far the vertices of a body
// may go before the next detection, and the largest.
DIFFVBD_OPERATOR(Out<8>, contact_detect, In x, In origin, In collider, In collider_next, In trust_radius,
                 In deformation_radius, In rest, In radius, In triangles, In edges, In points, In planes, In body,
                 In pinned, In face_counts, In point_weights, int64_t mesh_bodies, bool self_contact,
                 bool between_bodies, double dhat, int64_t capacity, bool trim) {
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    auto in = surfaces_of<T>(x, origin, collider, collider_next, rest, radius, triangles, edges, points, planes, body,
                             pinned, mesh_bodies, self_contact, between_bodies);
    const int64_t radii = in.scenes * (in.mesh_bodies + int64_t{1});
    in.trust_radius = Reader<T>(x).like("trust_radius", trust_radius, radii);
    in.deformation_radius = Reader<T>(x).like("deformation_radius", deformation_radius, radii);
    return detected(device, in, x, face_counts, point_weights, dhat, capacity, trim);
  });
}

// The motion of bodies (contact/motion.h): a displacement [B, V, 3], the longest ones [5, B, bodies] and sums
// [B, bodies, 4]. Their islands [B, bodies] int32 with translations [B, bodies, 3] and both radii [B, bodies + 1]
// (contact/trust_region.h). Then the pairs within these radii. gravity_move may be empty; floor: planes in the data of
// FloorBarrier, or empty.
DIFFVBD_OPERATOR(Out<15>, contact_find, In x, In origin, In collider, In collider_next, In mass, In move,
                 In gravity_move, In floor, In rest, In radius, In triangles, In edges, In points, In planes, In body,
                 In pinned, In face_counts, In point_weights, In pinned_bodies, In body_order, In body_ptr, In most,
                 In most_own, bool self_contact, bool between_bodies, double dhat, double factor, double least,
                 int64_t capacity, bool trim) {
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    const Reader<T> read(x);
    contact::MotionInputs<T> motion{};
    read.by_body(motion, body_order, body_ptr);
    const int64_t b = read.b, bodies = motion.bodies;
    auto surfaces = surfaces_of<T>(x, origin, collider, collider_next, rest, radius, triangles, edges, points, planes,
                                   body, pinned, bodies, self_contact, between_bodies);
    motion.x = surfaces.x, motion.move = read.vectors("move", move);
    motion.gravity_move = read.vectors_or_null("gravity_move", gravity_move);
    motion.origin = read.batch_or_null("origin", origin, 3 * read.v), motion.mass = read.batch("mass", mass, read.v);
    motion.pinned = surfaces.pinned, motion.pinned_bodies = read.flags("pinned_bodies", pinned_bodies, bodies);
    const Tensor rigid = device.like_x(), longest = device.empty({contact::kDisplacements, b, bodies}),
                 sums = device.empty({b, bodies, 4});
    DIFFVBD_RUN(device, find_motion<T>, motion, data<T>(rigid), data<T>(longest), data<T>(sums));

    contact::RadiusInputs<T> in{};
    in.motion = motion;
    contact::IslandInputs<T>& of = in.islands;
    of.x = motion.x, of.move = motion.move, of.origin = surfaces.origin;
    of.mass = motion.mass.data, of.mass_scene = motion.mass.scene;
    of.collider = surfaces.collider, of.collider_next = surfaces.collider_next;
    of.planes = surfaces.planes, of.body = surfaces.body, of.body_order = motion.order, of.body_ptr = motion.ptr;
    of.pinned = surfaces.pinned, of.radius = surfaces.radius;
    of.scenes = b, of.vertices = motion.vertices, of.corners = surfaces.corners;
    of.num_planes = surfaces.num_planes, of.mesh_bodies = motion.bodies;
    of.half = static_cast<T>(dhat / 2), of.floor = floor_of(read, floor), of.floor_planes = planes_of(floor);
    in.displacements = data<T>(longest), in.sums = data<T>(sums);
    in.most = read.like("most", most, bodies), in.most_own = read.like("most_own", most_own, bodies);
    in.factor = static_cast<T>(factor), in.least = static_cast<T>(least);
    in.dhat = static_cast<T>(dhat), in.self_contact = self_contact;
    const Tensor island = device.empty({b, bodies}, ScalarType::Int), u = device.empty({b, bodies, 3}),
                 trust_radius = device.empty({b, bodies + 1}), deformation_radius = device.empty({b, bodies + 1}),
                 memory = device.empty({b});
    const contact::RadiusWork<T> work{data<T>(memory), data<int32_t>(island), data<T>(u), data<T>(trust_radius),
                                      data<T>(deformation_radius)};
    DIFFVBD_ON_CUDA(const Tensor searched = device.bytes(cuda::islands_workspace_bytes<T>(of));)
    DIFFVBD_RUN(device, find_trust_radii<T>, in, work DIFFVBD_ON_CUDA(, searched.data_ptr()));

    surfaces.trust_radius = work.trust_radius, surfaces.deformation_radius = work.deformation_radius;
    return std::tuple_cat(detected(device, surfaces, x, face_counts, point_weights, dhat, capacity, trim),
                          Out<7>(rigid, longest, sums, island, u, trust_radius, deformation_radius));
  });
}

// Results as in contact/intersect.h.
DIFFVBD_OPERATOR(Out<3>, contact_intersections, In x, In origin, In collider, In rest, In radius, In triangles,
                 In edges, In points, In planes, In body, In pinned, int64_t mesh_bodies, bool self_contact,
                 bool between_bodies, int64_t capacity) {
  const Device device(x);
  require_capacity(capacity);
  return dispatch_float(x, [&]<class T>(T) {
    const auto in = surfaces_of<T>(x, origin, collider, collider, rest, radius, triangles, edges, points, planes, body,
                                   pinned, mesh_bodies, self_contact, between_bodies);
    Tensor pairs = device.empty({capacity, contact::kCrossingRow}, ScalarType::Int);
    Tensor first = device.empty({in.scenes, 2, 2}, ScalarType::Int);
    Tensor counts = device.empty({in.scenes, 2}, ScalarType::Long);
    const contact::Intersections out{capacity, data<int32_t>(pairs), data<int64_t>(counts), data<int32_t>(first)};
    DIFFVBD_ON_CUDA(const Tensor work = device.bytes(cuda::intersections_workspace_bytes<T>(in, capacity));)
    DIFFVBD_RUN(device, find_intersections<T>, in, out DIFFVBD_ON_CUDA(, work.data_ptr()));
    return Out<3>(pairs, counts, first);
  });
}

}  // namespace
}  // namespace diffvbd
