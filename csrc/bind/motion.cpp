// Operators on wanted motions of bodies: rigid motions, trust-region radii, residual acceleration.
#include "../contact/motion.h"

#include "../contact/residual_acceleration.h"
#include "../contact/trust_region.h"
#include "contact.h"
#include "detect.h"

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
DIFFVBD_OPERATOR(Out<3>, contact_motion_backward, In bar, In x, In origin, In mass, In move, In pinned,
                 In pinned_bodies, In order, In ptr) {
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    auto in = motion_inputs<T>(x, origin, mass, move, pinned, order, ptr);
    const Reader<T> read(x);
    in.pinned_bodies = read.flags("pinned_bodies", pinned_bodies, in.bodies);
    Tensor x_bar = device.like_x(), move_bar = device.like_x(), mass_bar = device.empty({in.scenes, in.vertices});
    const contact::MotionAdjoints<T> out{read.vectors("bar", bar), data<T>(x_bar), data<T>(move_bar),
                                         data<T>(mass_bar)};
    DIFFVBD_RUN(device, reverse_motion<T>, in, out);
    return Out<3>(x_bar, mass_bar, move_bar);
  });
}

// Displacements `move` without the stretch of free bodies that rotate, see sweep/extrapolation.h. The origin cancels:
// it is the same for all vertices of a body.
DIFFVBD_OPERATOR(Tensor, contact_extrapolate, In x, In mass, In move, In pinned, In pinned_bodies, In order, In ptr,
                 double lookback) {
  const Device device(x);
  require(lookback != 0, "diffvbd::contact_extrapolate: expected lookback other than 0");
  return dispatch_float(x, [&]<class T>(T) {
    auto in = motion_inputs<T>(x, device.empty({0}), mass, move, pinned, order, ptr);
    in.pinned_bodies = Reader<T>(x).flags("pinned_bodies", pinned_bodies, in.bodies);
    Tensor extrapolated = device.like_x();
    DIFFVBD_RUN(device, extrapolate<T>, in, lookback, data<T>(extrapolated));
    return extrapolated;
  });
}
DIFFVBD_OPERATOR(Out<3>, contact_extrapolate_backward, In bar, In x, In mass, In move, In pinned, In pinned_bodies,
                 In order, In ptr, double lookback) {
  const Device device(x);
  require(lookback != 0, "diffvbd::contact_extrapolate: expected lookback other than 0");
  return dispatch_float(x, [&]<class T>(T) {
    auto in = motion_inputs<T>(x, device.empty({0}), mass, move, pinned, order, ptr);
    const Reader<T> read(x);
    in.pinned_bodies = read.flags("pinned_bodies", pinned_bodies, in.bodies);
    Tensor x_bar = device.like_x(), move_bar = device.like_x(), mass_bar = device.empty({in.scenes, in.vertices});
    const contact::MotionAdjoints<T> out{read.vectors("bar", bar), data<T>(x_bar), data<T>(move_bar),
                                         data<T>(mass_bar)};
    DIFFVBD_RUN(device, reverse_extrapolate<T>, in, lookback, out);
    return Out<3>(x_bar, mass_bar, move_bar);
  });
}

// Trust-region radii of bodies, see contact/trust_region.h: islands [B, bodies] int32, trust-region and deformation
// radii [B, bodies + 1], and wanted displacement over the largest radius [B, bodies].
DIFFVBD_OPERATOR(Out<4>, contact_trust_radii, In x, In origin, In mass, In move, In pinned, In order, In ptr, In rigid,
                 In displacements, In sums, In floor, In collider, In collider_next, In planes, In body, In radius,
                 In most, In most_alone, In most_own, In least_own, double dhat, double fraction, double least,
                 bool any_direction, bool self_contact) {
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    const Reader<T> read(x);
    contact::RadiusInputs<T> in{};
    in.motion = motion_inputs<T>(x, origin, mass, move, pinned, order, ptr);
    const int64_t b = read.b, bodies = in.motion.bodies, rows = b * bodies;
    const int64_t count = planes.size(0) + planes_of(floor);
    const Tensor island = device.empty({b, bodies}, ScalarType::Int), trust_radius = device.empty({b, bodies + 1}),
                 deformation_radius = device.empty({b, bodies + 1}), over = device.empty({b, bodies}),
                 memory = device.empty({b * (count * contact::kPlaneScalars + 1 + 3 * bodies)});
    in.islands = island_inputs<T>(x, origin, move, mass, collider, collider_next, planes, body, order, ptr, pinned,
                                  radius, trust_radius, bodies, dhat, any_direction);
    in.rigid = read.vectors("rigid", rigid);
    in.displacements = read.like("displacements", displacements, contact::kDisplacements * rows),
    in.sums = read.like("sums", sums, 4 * rows);
    in.most = read.like("most", most, bodies), in.most_alone = read.like("most_alone", most_alone, bodies);
    in.most_own = read.like("most_own", most_own, bodies), in.least_own = read.like("least_own", least_own, bodies);
    in.floor_planes = planes_of(floor), in.floor = floor_of(read, floor);
    in.fraction = static_cast<T>(fraction), in.least = static_cast<T>(least);
    in.dhat = static_cast<T>(dhat), in.self_contact = self_contact;
    contact::RadiusWork<T> work{};
    T* at = data<T>(memory);
    const auto take = [&](T*& pointer, int64_t size) { pointer = at, at += size; };
    take(work.planes, b * in.planes() * contact::kPlaneScalars), take(work.pushed, b);
    take(work.stopped, rows), take(work.bent, rows), take(work.most, rows);
    work.island = data<int32_t>(island);
    work.trust_radius = data<T>(trust_radius), work.deformation_radius = data<T>(deformation_radius),
    work.over = data<T>(over);
    DIFFVBD_ON_CUDA(const Tensor searched = device.bytes(cuda::islands_workspace_bytes<T>(in.islands));)
    DIFFVBD_RUN(device, find_trust_radii<T>, in, work DIFFVBD_ON_CUDA(, searched.data_ptr()));
    return Out<4>(island, trust_radius, deformation_radius, over);
  });
}

// Trust-region radii of the sweeps [scenes, vertices], see contact/trust_region.h; deformation_center and
// deformation_radius may be empty. more: factor of the truncated displacement and the stretch; least: smallest radius
// [m].
DIFFVBD_OPERATOR(Tensor, contact_sweep_radii, In x, In start, In begin, In move, In gravity_move, In apart,
                 In stretched, In center, In trust_radius, In deformation_center, In deformation_radius, In pinned,
                 In body_order, In body_ptr, double more, double least) {
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    const Reader<T> read(x);
    contact::SweepRadiusInputs<T> in{};
    read.by_body(in, body_order, body_ptr);
    in.x = read.positions(), in.start = read.vectors("start", start), in.begin = read.vectors("begin", begin);
    in.move = read.vectors("move", move), in.gravity_move = read.vectors("gravity_move", gravity_move);
    in.apart = read.like("apart", apart, in.scenes * in.bodies);
    in.stretched = read.like("stretched", stretched, in.scenes * in.bodies);
    in.center = read.vectors("center", center), in.trust_radius = read.of_vertices("trust_radius", trust_radius);
    if (deformation_radius.numel() > 0) {
      in.deformation_center = read.vectors("deformation_center", deformation_center),
      in.deformation_radius = read.of_vertices("deformation_radius", deformation_radius);
    }
    in.pinned = read.flags("pinned", pinned, read.v, true);
    in.more = static_cast<T>(more), in.least = static_cast<T>(least);
    Tensor out = device.empty({in.scenes, in.vertices});
    const Tensor wishes = device.empty({in.scenes, in.bodies}), most = device.empty({in.scenes});
    DIFFVBD_RUN(device, sweep_radii<T>, in, data<T>(wishes), data<T>(most), data<T>(out));
    return out;
  });
}

template <class T>
contact::ResidualInputs<T> residual_inputs(const Tensor& x, const Tensor& origin, const Tensor& h2a,
                                           const Tensor& force, const Tensor& mass, const Tensor& planes,
                                           const Tensor& pinned_bodies, const Tensor& order, const Tensor& ptr,
                                           double time_step) {
  const Reader<T> read(x);
  contact::ResidualInputs<T> in{};
  read.by_body(in.scene, order, ptr);
  in.scene.x = read.positions();
  in.scene.x_prev = {in.scene.x, 3 * read.v};  // a floor's damping, which reads it, is not asked for
  in.scene.mass = read.batch("mass", mass, read.v);
  in.scene.origin = read.batch_or_null("origin", origin, 3 * read.v);
  in.scene.time_step = time_step;
  in.pinned_bodies = read.flags("pinned_bodies", pinned_bodies, in.scene.bodies);
  in.h2a = read.batch("h2a", h2a, 3 * read.v);
  require(force.dim() == 3 && force.size(1) >= read.v,
          "diffvbd::contact_residual_acceleration: expected force of corner points");
  in.corners = force.size(1);
  in.force = read.like("force", force, 3 * read.b * in.corners);
  in.floor = floor_of(read, planes), in.planes = planes_of(planes);
  return in;
}

// Residual of h2a after contact forces, see contact/residual_acceleration.h; origin and planes may be empty. The
// adjoint: of x, empty without planes, h2a, force and mass, and of planes by body [scenes, bodies, 7 planes] where
// wanted.
DIFFVBD_OPERATOR(Tensor, contact_residual_acceleration, In x, In origin, In h2a, In force, In mass, In planes,
                 In pinned_bodies, In body_order, In body_ptr, double time_step) {
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    const auto in =
        residual_inputs<T>(x, origin, h2a, force, mass, planes, pinned_bodies, body_order, body_ptr, time_step);
    Tensor out = device.like_x();
    DIFFVBD_RUN(device, residual_acceleration<T>, in, data<T>(out));
    return out;
  });
}
DIFFVBD_OPERATOR(Out<5>, contact_residual_acceleration_backward, In bar, In x, In origin, In h2a, In force, In mass,
                 In planes, In pinned_bodies, In body_order, In body_ptr, double time_step, bool wants_planes) {
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    const auto in =
        residual_inputs<T>(x, origin, h2a, force, mass, planes, pinned_bodies, body_order, body_ptr, time_step);
    const int64_t b = in.scene.scenes, v = in.scene.vertices;
    const Tensor x_bar = device.empty({in.planes > 0 ? b : 0, v, 3}), h2a_bar = device.like_x(),
                 force_bar = device.zeros({b, in.corners, 3}), mass_bar = device.empty({b, v});
    const Tensor planes_bar =
        device.zeros({wants_planes ? b : 0, in.scene.bodies, int64_t{in.planes} * contact::kPlaneScalars});
    const contact::ResidualAdjoints<T> out{data_or_null<T>(x_bar), data<T>(h2a_bar), data<T>(force_bar),
                                           data<T>(mass_bar), data_or_null<T>(planes_bar)};
    DIFFVBD_RUN(device, residual_acceleration_backward<T>, in, Reader<T>(x).vectors("bar", bar), out);
    return Out<5>(x_bar, h2a_bar, force_bar, mass_bar, planes_bar);
  });
}

}  // namespace
}  // namespace diffvbd
