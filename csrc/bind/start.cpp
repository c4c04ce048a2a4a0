// Operators of the start of a substep with contact: translations of islands, displacements above a floor, step
// fractions; values lagged from the start of a step; and lists of pairs.
#include "../contact/start.h"

#include "../contact/above_floor.h"
#include "../contact/advance.h"
#include "../contact/islands.h"
#include "../contact/pair_list.h"
#include "contact.h"

namespace diffvbd {
namespace {

// --- translations of islands -----------------------------------------------------------------------------------------

// Support vertex of each body's island above each plane of a floor: the one of the smallest gap. planes: data of
// FloorBarrier.
DIFFVBD_OPERATOR(Tensor, contact_support_vertices, In x, In origin, In planes, In body_order, In body_ptr, In island) {
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    const auto in = support_vertex_inputs<T>(x, origin, planes, body_order, body_ptr, island);
    Tensor out = device.empty({in.scenes, in.bodies, in.num_planes}, ScalarType::Int);
    const Tensor own = device.empty({in.scenes, in.bodies, in.num_planes}, ScalarType::Int);
    DIFFVBD_RUN(device, support_vertices<T>, in, data<int32_t>(own), data<int32_t>(out));
    return out;
  });
}

template <class T>
contact::TranslationInputs<T> translation_inputs(const Tensor& move, const Tensor& mass, const Tensor& x,
                                                 const Tensor& origin, const Tensor& planes, const Tensor& pinned,
                                                 const Tensor& body, const Tensor& order, const Tensor& ptr,
                                                 const Tensor& island, const Tensor& support_vertex) {
  const Reader<T> read(x);
  contact::TranslationInputs<T> in{};
  in.body_order = read.index("body_order", order, read.v), in.body_ptr = read.index("body_ptr", ptr, 1, true);
  in.scenes = read.b;
  in.vertices = static_cast<int32_t>(read.v), in.bodies = static_cast<int32_t>(ptr.numel() - 1);
  in.island = read.index("island", island, in.scenes * in.bodies);
  in.pinned = read.flags("pinned", pinned, read.v, true), in.body = read.index("body", body, read.v, true);
  in.move = read.vectors("move", move);
  const auto masses = read.batch("mass", mass, read.v);
  in.mass = masses.data, in.mass_scene = masses.scene;
  if (planes.numel() > 0) {
    in.floor = support_vertex_inputs<T>(x, origin, planes, order, ptr, island);
    require(in.floor.num_planes <= contact::kMostPlanes, "diffvbd::contact_translation: expected at most 8 planes");
    in.support_vertex = read.index("support_vertex", support_vertex, in.scenes * in.bodies * in.floor.num_planes);
  }
  return in;
}

// Translation of each body's island [scenes, bodies, 3], see contact/islands.h; without a floor planes and
// support_vertex are empty. The adjoint: of move, mass, x and planes.
DIFFVBD_OPERATOR(Tensor, contact_translation, In move, In mass, In x, In origin, In planes, In pinned, In body,
                 In body_order, In body_ptr, In island, In support_vertex) {
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    const auto in = translation_inputs<T>(move, mass, x, origin, planes, pinned, body, body_order, body_ptr, island,
                                          support_vertex);
    Tensor out = device.empty({in.scenes, in.bodies, 3});
    const Tensor sums = device.empty({in.scenes, in.bodies, 4});
    DIFFVBD_RUN(device, translation<T>, in, data<T>(sums), data<T>(out));
    return out;
  });
}
DIFFVBD_OPERATOR(Out<4>, contact_translation_backward, In u_bar, In move, In mass, In x, In origin, In planes,
                 In pinned, In body, In body_order, In body_ptr, In island, In support_vertex) {
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    const auto in = translation_inputs<T>(move, mass, x, origin, planes, pinned, body, body_order, body_ptr, island,
                                          support_vertex);
    const int64_t b = in.scenes, v = in.vertices, scalars = int64_t{in.floor.num_planes} * contact::kPlaneScalars;
    const T* given = Reader<T>(x).like("u_bar", u_bar, 3 * b * in.bodies);
    Tensor move_bar = device.like_x(), mass_bar = device.empty({b, v});
    Tensor x_bar = device.zeros({b, v, 3}), planes_bar = device.zeros({b, scalars});
    const Tensor sums = device.empty({b, in.bodies, 4}), zeroed = device.zeros({b, in.bodies, 6 + scalars});
    DIFFVBD_RUN(device, translation_backward<T>, in, given, data<T>(sums), data<T>(zeroed), data<T>(move_bar),
                data<T>(mass_bar), data<T>(x_bar), data<T>(planes_bar));
    return Out<4>(move_bar, mass_bar, x_bar, planes_bar);
  });
}

// Step fractions at the start, see contact/advance.h: of vertices [scenes, vertices], or of whole bodies [scenes,
// bodies]; infeasible: number of pairs that prescribed motion brings too close. center, trust_radius: the trust region
// of a vertex; deformation_center and deformation_radius likewise, or empty.
DIFFVBD_OPERATOR(Out<2>, contact_advance, In x, In move, In u, In center, In origin, In collider, In collider_next,
                 In pinned, In body, In trust_radius, In deformation_center, In deformation_radius, In pairs,
                 In constants, In ptr, In entry, bool careful, bool whole) {
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    const Reader<T> read(x);
    const int64_t b = read.b, v = read.v, corners = v + read.colliders(collider);
    require(u.dim() == 3, "diffvbd::contact_advance: expected u [scenes, bodies, 3]");
    contact::AdvanceInputs<T> in{};
    in.x = read.positions(), in.move = read.vectors("move", move), in.u = read.like("u", u, 3 * b * u.size(1));
    in.center = read.vectors("center", center), in.origin = read.vectors_or_null("origin", origin);
    in.collider = read.like("collider", collider, 3 * b * (corners - v));
    in.collider_next = read.like("collider_next", collider_next, 3 * b * (corners - v));
    in.pinned = read.flags("pinned", pinned, corners), in.body = read.index("body", body, corners);
    in.trust_radius = read.of_vertices("trust_radius", trust_radius);
    if (deformation_radius.numel() > 0) {
      in.deformation_center = read.vectors("deformation_center", deformation_center),
      in.deformation_radius = read.of_vertices("deformation_radius", deformation_radius);
    }
    in.listed = pair_list(pairs, ptr, entry, x, b * corners);
    in.constants = pair_constants<T>(constants, pairs, x);
    in.scenes = b;
    in.vertices = static_cast<int32_t>(v), in.corners = static_cast<int32_t>(corners);
    in.bodies = static_cast<int32_t>(u.size(1));
    in.careful = careful, in.whole = whole;
    Tensor fraction = device.empty({b, whole ? in.bodies : in.vertices}),
           infeasible = device.empty({1}, ScalarType::Long);
#ifdef USE_CUDA
    const Tensor work = device.bytes(cuda::advance_workspace_bytes<T>(in, pairs.size(0)));
    DIFFVBD_RUN(device, advance<T>, in, pairs.size(0), data<T>(fraction), data<int64_t>(infeasible), work.data_ptr(),
                device.attribute(cudaDevAttrMultiProcessorCount));
#else
    *data<int64_t>(infeasible) = advance<T>(in, data<T>(fraction));
#endif
    return Out<2>(fraction, infeasible);
  });
}

// --- lists of pairs --------------------------------------------------------------------------------------------------

// constants with the current gaps of the pairs, see contact/pair_list.h.
DIFFVBD_OPERATOR(Tensor, contact_refresh_gaps, In x, In origin, In collider, In trust_radius, In pairs, In constants,
                 In ptr) {
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    const Reader<T> read(x);
    const int64_t colliders = read.colliders(collider);
    contact::GapInputs<T> in{};
    in.x = read.positions(), in.origin = read.vectors_or_null("origin", origin);
    in.collider = read.like("collider", collider, 3 * read.b * colliders),
    in.trust_radius = read.of_vertices("trust_radius", trust_radius);
    in.pairs = read.index("pairs", pairs, pairs.size(0) * contact::kPairRow);
    read.index("ptr", ptr, read.b * (read.v + colliders) + 1);
    in.constants = pair_constants<T>(constants, pairs, x);
    in.vertices = static_cast<int32_t>(read.v), in.colliders = static_cast<int32_t>(colliders);
    Tensor out = device.empty({pairs.size(0), contact::kConstants});
    DIFFVBD_RUN(device, refresh_gaps<T>, in, pairs.size(0), data<T>(out));
    return out;
  });
}

// Compact list of the pairs that `keep` selects, and their indices (contact/pair_list.h); exact: of their number, on
// the CPU; else as long as the whole list, with -1 in empty rows.
DIFFVBD_OPERATOR(Out<5>, contact_compact, In keep, In pairs, In constants, In ptr, In entry, bool exact) {
  const Device device(constants);
  return dispatch_float(constants, [&]<class T>(T) {
    const contact::PairList all = pair_list(pairs, ptr, entry, constants, ptr.numel() - 1);
    const contact::CompactInputs<T> in{array<bool>("keep", keep, constants, ScalarType::Bool, pairs.size(0)),
                                       all.pairs,
                                       all.ptr,
                                       all.entry,
                                       pair_constants<T>(constants, pairs, constants),
                                       pairs.size(0),
                                       ptr.numel() - 1};
    require(in.corners >= 0, "diffvbd::contact_compact: expected pairs made by contact_detect");
    int64_t capacity = in.count;
#ifndef USE_CUDA
    require(std::is_sorted(in.ptr, in.ptr + ptr.numel()) && *in.ptr >= 0 && in.ptr[in.corners] <= entry.numel(),
            "diffvbd::contact_compact: expected ptr that ascends up to the number of entries");
    std::vector<int32_t> kept(in.count + 1);
    for (int64_t i = 0; i < in.count; ++i) kept[i + 1] = kept[i] + contact::stays(in, i);
    if (exact) capacity = kept.back();
#endif
    const Tensor rows = device.empty({capacity}, ScalarType::Long),
                 constants_out = device.empty({capacity, contact::kConstants}),
                 pairs_out = device.empty({capacity, contact::kPairRow}, ScalarType::Int),
                 ptr_out = device.empty({ptr.numel()}, ScalarType::Int),
                 entry_out = device.empty({4 * capacity}, ScalarType::Int);
    const contact::CompactList<T> out{data<int64_t>(rows),      data<int32_t>(pairs_out), data<int32_t>(ptr_out),
                                      data<int32_t>(entry_out), data<T>(constants_out),   capacity};
#ifdef USE_CUDA
    const Tensor work = device.bytes(cuda::compact_list_bytes(in));
    DIFFVBD_RUN(device, compact_list<T>, in, out, work.data_ptr());
#else
    for (int64_t i = 0; i < in.count; ++i) {
      if (contact::stays(in, i)) contact::copy_pair(in, i, kept[i], out);
    }
    for (int64_t i = kept.back(); i < out.capacity; ++i) contact::leave_empty(i, out);
    int32_t at = 0;
    for (int64_t i = 0; i < in.corners; ++i) {
      out.ptr[i] = at;
      contact::each_entry(in, kept.data(), i, [&](int32_t own) { out.entry[at++] = own; });
    }
    out.ptr[in.corners] = at;
#endif
    return Out<5>(rows, pairs_out, constants_out, ptr_out, entry_out);
  });
}

// --- lagged values ---------------------------------------------------------------------------------------------------

// Normal force, 1 where active, normal and weights of each pair [pairs, 9]; the adjoint: of corner points [B, N, 3] and
// of kappa.
DIFFVBD_OPERATOR(Tensor, contact_lag, In x, In origin, In collider, In kappa, In pairs, In constants, In ptr,
                 In entry) {
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    const auto in = lag_inputs<T>(x, origin, collider, kappa, pairs, constants, ptr, entry);
    Tensor out = device.empty({pairs.size(0), contact::kLagScalars});
    DIFFVBD_RUN(device, pair_lag<T>, in, data<const T>(x), x.size(0), pairs.size(0), data<T>(out));
    return out;
  });
}
DIFFVBD_OPERATOR(Out<2>, contact_lag_backward, In bar, In x, In origin, In collider, In kappa, In pairs, In constants,
                 In ptr, In entry) {
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    const auto in = lag_inputs<T>(x, origin, collider, kappa, pairs, constants, ptr, entry);
    const T* given = Reader<T>(x).like("bar", bar, pairs.size(0) * contact::kLagScalars);
    const int64_t b = x.size(0);
    Tensor points = device.empty({b, in.corners, 3}), kappa_bar = device.empty({b});
    DIFFVBD_ON_CUDA(const Tensor slots = device.empty({pairs.size(0), cuda::kLagSlots});)
    DIFFVBD_RUN(device, pair_lag_backward<T>, in, data<const T>(x), b, DIFFVBD_ON_CUDA(pairs.size(0), ) given,
                DIFFVBD_ON_CUDA(data<T>(slots), ) data<T>(points), data<T>(kappa_bar));
    return Out<2>(points, kappa_bar);
  });
}

// friction, damping [1 | B], or empty.
template <class T>
contact::LagCoefficients<T> lag_coefficients(const Tensor& friction, const Tensor& damping, const Reader<T>& read) {
  return {read.batch_or_null("friction", friction, 1), read.batch_or_null("damping", damping, 1)};
}

// Friction, damping, normal and weights of each pair [pairs, 9], by the coefficients of its scene, which may be empty,
// and the forces of pairs on corner points [B, N, 3]; the adjoint, of which either bar may be empty.
DIFFVBD_OPERATOR(Out<2>, contact_friction_lag, In x, In origin, In collider, In kappa, In friction, In damping,
                 In pairs, In constants, In ptr, In entry) {
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    const auto in = lag_inputs<T>(x, origin, collider, kappa, pairs, constants, ptr, entry);
    const auto by = lag_coefficients(friction, damping, Reader<T>(x));
    Tensor lag = device.empty({pairs.size(0), contact::kLagScalars}), push = device.empty({x.size(0), in.corners, 3});
    DIFFVBD_ON_CUDA(const Tensor slots = device.empty({pairs.size(0), cuda::kLagSlots});)
    DIFFVBD_RUN(device, lagged_friction<T>, in, by, data<const T>(x), x.size(0), pairs.size(0), data<T>(lag),
                DIFFVBD_ON_CUDA(data<T>(slots), ) data<T>(push));
    return Out<2>(lag, push);
  });
}
DIFFVBD_OPERATOR(Out<4>, contact_friction_lag_backward, In lag_bar, In push_bar, In x, In origin, In collider, In kappa,
                 In friction, In damping, In pairs, In constants, In ptr, In entry) {
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    const auto in = lag_inputs<T>(x, origin, collider, kappa, pairs, constants, ptr, entry);
    const Reader<T> read(x);
    const auto by = lag_coefficients(friction, damping, read);
    const int64_t b = x.size(0), rows = pairs.size(0) * contact::kLagScalars;
    const contact::LaggedFrictionBars<T> given{
        lag_bar.numel() ? read.like("lag_bar", lag_bar, rows) : nullptr,
        push_bar.numel() ? read.like("push_bar", push_bar, 3 * b * in.corners) : nullptr, in.corners};
    Tensor points = device.empty({b, in.corners, 3}), kappa_bar = device.empty({b});
    Tensor friction_bar = device.empty({friction.numel() ? b : 0});
    Tensor damping_bar = device.empty({damping.numel() ? b : 0});
    DIFFVBD_ON_CUDA(const Tensor slots = device.empty({pairs.size(0), cuda::kLagSlots});)
    DIFFVBD_RUN(device, lagged_friction_backward<T>, in, by, given, data<const T>(x), b,
                DIFFVBD_ON_CUDA(pairs.size(0), data<T>(slots), ) data<T>(points), data<T>(kappa_bar),
                data_or_null<T>(friction_bar), data_or_null<T>(damping_bar));
    return Out<4>(points, kappa_bar, friction_bar, damping_bar);
  });
}

// --- displacements above a floor, and step fractions -----------------------------------------------------------------

template <class T>
contact::AboveFloorInputs<T> above_floor_inputs(const Tensor& x, const Tensor& u, const Tensor& displacement,
                                                const Tensor& planes, const Tensor& origin, const Tensor& pinned,
                                                const Tensor& order, const Tensor& ptr) {
  const Reader<T> read(x);
  contact::AboveFloorInputs<T> in{};
  read.by_body(in.scene, order, ptr);
  in.scene.x = read.positions();
  in.scene.origin = read.batch_or_null("origin", origin, 3 * read.v);
  in.displacement = read.vectors("displacement", displacement);
  if (u.numel() > 0) in.u = read.like("u", u, 3 * in.scene.scenes * in.scene.bodies);
  in.floor = floor_of(read, planes), in.planes = planes_of(planes);
  in.pinned = read.flags("pinned", pinned, read.v, true);
  return in;
}

// Displacements of whole bodies relative to u, limited by a floor, and stopped bodies [scenes, bodies], see
// contact/above_floor.h; u, planes and origin may be empty. The adjoint: of x, u, displacement and, by body, planes.
DIFFVBD_OPERATOR(Out<2>, contact_above_floor, In x, In u, In displacement, In planes, In origin, In pinned,
                 In body_order, In body_ptr) {
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    const auto in = above_floor_inputs<T>(x, u, displacement, planes, origin, pinned, body_order, body_ptr);
    Tensor body_move = device.like_x(), stopped = device.empty({in.scene.scenes, in.scene.bodies}, ScalarType::Bool);
    device.bodies(contact::AboveFloorDisplacements<T>{in, data<T>(body_move), data<bool>(stopped)});
    return Out<2>(body_move, stopped);
  });
}
DIFFVBD_OPERATOR(Out<4>, contact_above_floor_backward, In bar, In x, In u, In displacement, In planes, In origin,
                 In pinned, In body_order, In body_ptr, bool wants_planes) {
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    const auto in = above_floor_inputs<T>(x, u, displacement, planes, origin, pinned, body_order, body_ptr);
    const int64_t b = in.scene.scenes, bodies = in.scene.bodies;
    Tensor x_bar = device.like_x(), displacement_bar = device.like_x(), u_bar = device.empty({in.u ? b : 0, bodies, 3});
    Tensor planes_bar = device.zeros({b, bodies, wants_planes ? in.planes * contact::kPlaneScalars : 0});
    device.bodies(contact::ReverseAboveFloor<T>{in, Reader<T>(x).vectors("bar", bar), data<T>(x_bar), data<T>(u_bar),
                                                data<T>(displacement_bar), data_or_null<T>(planes_bar)});
    return Out<4>(x_bar, u_bar, displacement_bar, planes_bar);
  });
}

// Index data of the operators below: pinned vertices, bodies with one, the body of each vertex, and vertices by body.
#define DIFFVBD_BODIES In pinned, In pinned_bodies, In body, In body_order, In body_ptr
struct IndexTensors {
  const Tensor &pinned, &pinned_bodies, &body, &order, &ptr;
};
template <class T>
contact::StartInputs<T> start_inputs(const Tensor& x, const IndexTensors& index) {
  const Reader<T> read(x);
  contact::StartInputs<T> in{};
  read.by_body(in.scene, index.order, index.ptr);
  in.scene.x = read.positions();
  in.pinned = read.flags("pinned", index.pinned, read.v, true), in.body = read.index("body", index.body, read.v, true);
  in.pinned_bodies = read.flags("pinned_bodies", index.pinned_bodies, in.scene.bodies);
  return in;
}

// Inputs of a path up to the rigid displacement.
struct PathTensors {
  const Tensor &x, &move, &u, &body_move, &rigid_fraction, &planes, &origin;
};
template <class T>
contact::StartInputs<T> start_inputs(const PathTensors& t, const IndexTensors& index, double filter_eta) {
  auto in = start_inputs<T>(t.x, index);
  const Reader<T> read(t.x);
  const int64_t bodies = in.scene.scenes * in.scene.bodies;
  in.move = read.vectors("move", t.move), in.body_move = read.vectors("body_move", t.body_move);
  in.u = read.like("u", t.u, 3 * bodies), in.rigid_fraction = read.like("rigid_fraction", t.rigid_fraction, bodies);
  in.scene.origin = read.batch_or_null("origin", t.origin, 3 * read.v);
  in.floor = floor_of(read, t.planes), in.floor_scalars = planes_of(t.planes) * contact::kPlaneScalars;
  require(in.floor_scalars <= FloorStart::kMostPlanes * contact::kPlaneScalars,
          "diffvbd::contact_start: expected at most 8 planes");
  in.parameters.filter_eta = static_cast<T>(filter_eta);
  in.parameters.time_step = T(1);  // a filter does not read it
  return in;
}

// Decisions at the start of a substep, see contact/start.h; planes, origin and deformation_radius may be empty. state
// uint8 [scenes, vertices]: MoveState.
DIFFVBD_OPERATOR(Out<5>, contact_rigid_moves, In x, In move, In u, In displacement, In body_move, In stretch,
                 In trust_radius, In deformation_radius, DIFFVBD_BODIES) {
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    auto in = start_inputs<T>(x, {pinned, pinned_bodies, body, body_order, body_ptr});
    const Reader<T> read(x);
    const int64_t b = in.scene.scenes, v = in.scene.vertices, bodies = in.scene.bodies;
    in.move = read.vectors("move", move), in.body_move = read.vectors("body_move", body_move);
    in.u = read.like("u", u, 3 * b * bodies);
    const bool own = deformation_radius.numel() > 0;
    Tensor limit = device.empty({b, bodies}), displacements = device.like_x(), center = device.like_x();
    Tensor trust_radii = device.empty({b, v}), deformation_radii = device.empty({own ? b : 0, v});
    device.bodies(contact::RigidMoves<T>{
        in, read.vectors("displacement", displacement), read.like("stretch", stretch, b * bodies),
        read.like("trust_radius", trust_radius, b * (bodies + 1)),
        own ? read.like("deformation_radius", deformation_radius, b * (bodies + 1)) : nullptr, data<T>(limit),
        data<T>(displacements), data<T>(center), data<T>(trust_radii), data<T>(deformation_radii)});
    return Out<5>(limit, displacements, center, trust_radii, deformation_radii);
  });
}

DIFFVBD_OPERATOR(Out<4>, contact_deformations, In x, In move, In u, In body_move, In rigid_fraction, In limit,
                 In stopped, In deformation_radius, In planes, In origin, DIFFVBD_BODIES, double filter_eta) {
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    const auto in = start_inputs<T>({x, move, u, body_move, rigid_fraction, planes, origin},
                                    {pinned, pinned_bodies, body, body_order, body_ptr}, filter_eta);
    const Reader<T> read(x);
    const int64_t b = in.scene.scenes, bodies = in.scene.bodies;
    Tensor base = device.like_x(), target = device.like_x(), displacement = device.like_x();
    Tensor state = device.empty({b, in.scene.vertices}, ScalarType::Byte);
    const contact::Deformations<T> act{in,
                                       read.like("limit", limit, b * bodies),
                                       deformation_radius.numel() > 0
                                           ? read.like("deformation_radius", deformation_radius, b * (bodies + 1))
                                           : nullptr,
                                       read.flags("stopped", stopped, b * bodies),
                                       data<T>(displacement),
                                       data<uint8_t>(state)};
    device.vertices(contact::Wishes<T>{in, data<T>(base), data<T>(target), data<T>(displacement)});
    device.bodies(act);
    return Out<4>(base, target, displacement, state);
  });
}

DIFFVBD_OPERATOR(Out<2>, contact_freeze, In displacement, In state, In increases) {
  const Device device(displacement);
  return dispatch_float(displacement, [&]<class T>(T) {
    const Reader<T> read(displacement);
    const int64_t rows = read.b * read.v;
    contact::StartInputs<T> in{};
    in.scene.scenes = read.b, in.scene.vertices = static_cast<int32_t>(read.v);
    Tensor displacement_out = device.like_x(), state_out = device.empty({read.b, read.v}, ScalarType::Byte);
    device.vertices(contact::Freeze<T>{in, read.positions(), read.bytes("state", state, rows),
                                       read.flags("increases", increases, rows), data<T>(displacement_out),
                                       data<uint8_t>(state_out)});
    return Out<2>(displacement_out, state_out);
  });
}

DIFFVBD_OPERATOR(Out<2>, contact_blocked, In base, In displacement, In fraction, In state, DIFFVBD_BODIES) {
  const Device device(base);
  return dispatch_float(base, [&]<class T>(T) {
    auto in = start_inputs<T>(base, {pinned, pinned_bodies, body, body_order, body_ptr});
    const Reader<T> read(base);
    in.fraction = read.of_vertices("fraction", fraction);
    Tensor to = device.like_x(), state_out = device.empty({read.b, read.v}, ScalarType::Byte);
    device.bodies(contact::BlockedBodies<T>{in, read.positions(), read.vectors("displacement", displacement),
                                            read.bytes("state", state, read.b * read.v), data<T>(to),
                                            data<uint8_t>(state_out)});
    return Out<2>(to, state_out);
  });
}

DIFFVBD_OPERATOR(Out<3>, contact_gravity_moves, In x, In move, In gravity_move, In u, In body_move, In rigid_fraction,
                 In fraction, In state, In planes, In origin, DIFFVBD_BODIES, double filter_eta) {
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    auto in = start_inputs<T>({x, move, u, body_move, rigid_fraction, planes, origin},
                              {pinned, pinned_bodies, body, body_order, body_ptr}, filter_eta);
    const Reader<T> read(x);
    in.gravity_move = read.vectors("gravity_move", gravity_move), in.fraction = read.of_vertices("fraction", fraction);
    Tensor went = device.empty({read.b, read.v}), at = device.like_x(), displacement = device.like_x();
    device.vertices(contact::GravityMoves<T>{in, read.bytes("state", state, read.b * read.v), data<T>(went),
                                             data<T>(at), data<T>(displacement)});
    return Out<3>(went, at, displacement);
  });
}

// Positions at the start of the sweeps, and vertices truncated by pairs, see contact/start.h. The adjoint: of x, move,
// gravity_move, u, body_move and planes, all for each vertex.
DIFFVBD_OPERATOR(Out<2>, contact_start, In x, In move, In gravity_move, In u, In body_move, In rigid_fraction,
                 In fraction, In last_fraction, In stopped, In planes, In origin, DIFFVBD_BODIES, double filter_eta) {
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    auto in = start_inputs<T>({x, move, u, body_move, rigid_fraction, planes, origin},
                              {pinned, pinned_bodies, body, body_order, body_ptr}, filter_eta);
    const Reader<T> read(x);
    in.gravity_move = read.vectors("gravity_move", gravity_move);
    in.fraction = read.of_vertices("fraction", fraction),
    in.last_fraction = read.of_vertices("last_fraction", last_fraction);
    Tensor end = device.like_x(), is_truncated = device.empty({read.b, read.v}, ScalarType::Bool);
    device.vertices(contact::Starts<T>{in, read.flags("stopped", stopped, in.scene.scenes * in.scene.bodies),
                                       data<T>(end), data<bool>(is_truncated)});
    return Out<2>(end, is_truncated);
  });
}
DIFFVBD_OPERATOR(Out<6>, contact_start_backward, In bar, In x, In move, In gravity_move, In u, In body_move,
                 In rigid_fraction, In fraction, In last_fraction, In planes, In origin, DIFFVBD_BODIES,
                 double filter_eta, bool wants_planes) {
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    auto in = start_inputs<T>({x, move, u, body_move, rigid_fraction, planes, origin},
                              {pinned, pinned_bodies, body, body_order, body_ptr}, filter_eta);
    const Reader<T> read(x);
    in.gravity_move = read.vectors("gravity_move", gravity_move);
    in.fraction = read.of_vertices("fraction", fraction),
    in.last_fraction = read.of_vertices("last_fraction", last_fraction);
    const Tensor x_bar = device.like_x(), move_bar = device.like_x(), gravity_move_bar = device.like_x(),
                 u_bar = device.like_x(), body_move_bar = device.like_x(),
                 planes_bar = device.empty({read.b, read.v, wants_planes ? in.floor_scalars : 0});
    device.vertices(contact::ReverseStarts<T>{
        in,
        {read.vectors("bar", bar), data<T>(x_bar), data<T>(move_bar), data<T>(gravity_move_bar), data<T>(u_bar),
         data<T>(body_move_bar), data_or_null<T>(planes_bar)}});
    return Out<6>(x_bar, move_bar, gravity_move_bar, u_bar, body_move_bar, planes_bar);
  });
}

}  // namespace
}  // namespace diffvbd
