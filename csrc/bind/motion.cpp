// Operators on how bodies want to move, and how far they may: rigid motions and trust-region radii.
#include "../contact/motion.h"

#include "../contact/trust_region.h"
#include "contact.h"

namespace diffvbd {
namespace {

template <class T>
contact::MotionInputs<T> motion_inputs(const Tensor& x, const Tensor& origin, const Tensor& mass, const Tensor& move,
                                       const Tensor& pinned, const Tensor& order, const Tensor& ptr) {
  const Reader<T> read(x);
  require(read.b * read.v <= std::numeric_limits<int32_t>::max(),
          "diffvbd::contact_motion: too large, expected at most 2^31 vertices in all scenes");
  contact::MotionInputs<T> in{};
  read.by_body(in, order, ptr);
  in.x = read.positions(), in.move = read.vectors("move", move);
  in.origin = read.batch_or_null("origin", origin, 3 * read.v);
  in.mass = read.batch("mass", mass, read.v);
  in.pinned = read.flags("pinned", pinned, read.v, true);
  return in;
}

// Rigid motion of each body [B, V, 3] in the wanted displacements; the longest displacements [5, B, bodies] and the
// sums [B, bodies, 4] of contact/motion.h. origin and gravity_move may be empty.
DIFFVBD_OPERATOR(Out<3>, contact_motion, In x, In origin, In mass, In move, In gravity_move, In pinned,
                 In pinned_bodies, In order, In ptr) {
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    auto in = motion_inputs<T>(x, origin, mass, move, pinned, order, ptr);
    in.pinned_bodies = Reader<T>(x).flags("pinned_bodies", pinned_bodies, in.bodies);
    in.gravity_move = Reader<T>(x).vectors_or_null("gravity_move", gravity_move);
    Tensor rigid = device.like_x(), displacements = device.empty({contact::kDisplacements, in.scenes, in.bodies});
    Tensor sums = device.empty({in.scenes, in.bodies, 4});
    DIFFVBD_RUN(device, find_motion<T>, in, data<T>(rigid), data<T>(displacements), data<T>(sums));
    return Out<3>(rigid, displacements, sums);
  });
}
// Islands of bodies [B, bodies] int32, their translations [B, bodies, 3], trust-region and deformation radii [B,
// bodies + 1], see contact/trust_region.h. pinned [N]; floor: planes in the data of FloorBarrier, or empty.
DIFFVBD_OPERATOR(Out<4>, contact_trust_radii, In x, In origin, In mass, In move, In pinned, In order, In ptr,
                 In displacements, In sums, In floor, In collider, In collider_next, In planes, In body, In radius,
                 In most, In most_own, double dhat, double fraction, double least, bool self_contact) {
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    const Reader<T> read(x);
    contact::RadiusInputs<T> in{};
    in.motion = motion_inputs<T>(x, origin, mass, move, pinned, order, ptr);
    const int64_t b = read.b, bodies = in.motion.bodies, rows = b * bodies, n = body.numel(), colliders = n - read.v;
    require(read.v <= n && b * n <= std::numeric_limits<int32_t>::max(),
            "contact: expected body of shape [N], N >= vertices, and at most 2^31 corner points in all scenes");
    const Tensor island = device.empty({b, bodies}, ScalarType::Int), u = device.empty({b, bodies, 3}),
                 trust_radius = device.empty({b, bodies + 1}), deformation_radius = device.empty({b, bodies + 1}),
                 memory = device.empty({b});
    contact::IslandInputs<T>& of = in.islands;
    of.x = in.motion.x, of.move = in.motion.move, of.origin = read.vectors_or_null("origin", origin);
    of.mass = in.motion.mass.data, of.mass_scene = in.motion.mass.scene;
    of.collider = read.like("collider", collider, 3 * b * colliders);
    of.collider_next = read.like("collider_next", collider_next, 3 * b * colliders);
    of.planes = read.index("planes", planes, 3 * planes.size(0)), of.body = read.index("body", body, n);
    of.body_order = in.motion.order, of.body_ptr = in.motion.ptr;
    of.pinned = read.flags("pinned", pinned, n), of.radius = read.like("radius", radius, n);
    of.scenes = b, of.vertices = in.motion.vertices, of.corners = static_cast<int32_t>(n);
    of.num_planes = static_cast<int32_t>(planes.size(0)), of.mesh_bodies = in.motion.bodies;
    of.half = static_cast<T>(dhat / 2), of.floor = floor_of(read, floor), of.floor_planes = planes_of(floor);
    in.displacements = read.like("displacements", displacements, contact::kDisplacements * rows),
    in.sums = read.like("sums", sums, 4 * rows);
    in.most = read.like("most", most, bodies), in.most_own = read.like("most_own", most_own, bodies);
    in.fraction = static_cast<T>(fraction), in.least = static_cast<T>(least);
    in.dhat = static_cast<T>(dhat), in.self_contact = self_contact;
    contact::RadiusWork<T> work{};
    work.pushed = data<T>(memory);
    work.island = data<int32_t>(island), work.u = data<T>(u);
    work.trust_radius = data<T>(trust_radius), work.deformation_radius = data<T>(deformation_radius);
    DIFFVBD_ON_CUDA(const Tensor searched = device.bytes(cuda::islands_workspace_bytes<T>(of));)
    DIFFVBD_RUN(device, find_trust_radii<T>, in, work DIFFVBD_ON_CUDA(, searched.data_ptr()));
    return Out<4>(island, u, trust_radius, deformation_radius);
  });
}

}  // namespace
}  // namespace diffvbd
