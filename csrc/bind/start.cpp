// Operators of the start of a substep with contact, of the pairs that its sweeps can reach, and of what is lagged from
// the start of the step.
#include "../contact/start.h"

#include "../contact/pair_list.h"
#include "contact.h"

namespace diffvbd {
namespace {

// The start of a substep (contact/start.h): x [scenes, vertices, 3]; center of each vertex's trust region, and of its
// deformation, or empty; trust-region radius, deformation radius or empty, and step fraction [scenes, vertices];
// whether its displacement was truncated; and how many pairs a prescribed motion brings too close. rigid: the rigid
// motion of each body as a displacement [scenes, vertices, 3], or empty without deformation radii. trust_radius,
// deformation_radius [scenes, bodies + 1]. closed: fraction of a gap to a floor that a displacement may close.
DIFFVBD_OPERATOR(Out<8>, contact_start, In x, In move, In u, In rigid, In trust_radius, In deformation_radius, In floor,
                 In origin, In collider, In collider_next, In pinned, In body, In unit, In pairs, In constants, In ptr,
                 In entry, double closed) {
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    const Reader<T> read(x);
    const int64_t b = read.b, v = read.v, corners = v + read.colliders(collider);
    require(u.dim() == 3, "diffvbd::contact_start: expected u [scenes, bodies, 3]");
    const int64_t bodies = u.size(1);
    contact::StartStep<T> s{};
    contact::AdvanceInputs<T>& gate = s.in.gate;
    gate.x = gate.center = read.positions(), gate.u = read.like("u", u, 3 * b * bodies);
    gate.origin = read.vectors_or_null("origin", origin);
    gate.collider = read.like("collider", collider, 3 * b * (corners - v));
    gate.collider_next = read.like("collider_next", collider_next, 3 * b * (corners - v));
    gate.pinned = read.flags("pinned", pinned, corners), gate.body = read.index("body", body, corners);
    gate.unit_of = read.index("unit", unit, v);
    gate.listed = pair_list(pairs, ptr, entry, x, b * corners);
    gate.constants = pair_constants<T>(constants, pairs, x);
    gate.scenes = b;
    gate.vertices = static_cast<int32_t>(v), gate.corners = static_cast<int32_t>(corners);
    gate.bodies = static_cast<int32_t>(bodies);
    gate.units_of_scene = gate.vertices, gate.careful = true;
    s.in.move = read.vectors("move", move), s.in.rigid = read.vectors_or_null("rigid", rigid);
    s.in.trust_radius = read.like("trust_radius", trust_radius, b * (bodies + 1));
    const bool own = rigid.dim() == 3;
    if (own) s.in.deformation_radius = read.like("deformation_radius", deformation_radius, b * (bodies + 1));
    s.in.floor = floor_of(read, floor), s.in.floor_planes = planes_of(floor), s.in.closed = static_cast<T>(closed);
    const Tensor memory = workspace(device, [&](auto& take) { s.m.parts(take, b * v); });
    gate.move = s.m.wanted;
    const Tensor start = device.like_x(), center = device.like_x(), own_center = device.empty({own ? b : 0, v, 3}),
                 radius = device.empty({b, v}), own_radius = device.empty({own ? b : 0, v}),
                 fraction = device.empty({b, v}), truncated = device.empty({b, v}, ScalarType::Bool),
                 infeasible = device.zeros({b}, ScalarType::Long);
    s.out = {data<T>(start),
             data<T>(center),
             data<T>(radius),
             data_or_null<T>(own_radius),
             data<T>(fraction),
             data<bool>(truncated),
             data_or_null<T>(own_center),
             data<int64_t>(infeasible)};
#ifdef USE_CUDA
    const Tensor work = device.bytes(cuda::advance_workspace_bytes<T>(gate, pairs.size(0)));
    DIFFVBD_RUN(device, start_substep<T>, s, pairs.size(0), work.data_ptr(),
                device.attribute(cudaDevAttrMultiProcessorCount));
#else
    start_substep<T>(s);
#endif
    return Out<8>(start, center, own_center, radius, own_radius, fraction, truncated, infeasible);
  });
}

// --- near pairs ------------------------------------------------------------------------------------------------------

// What is left of the trust-region radii about x [scenes, vertices], and the pairs that can matter within them
// (contact/pair_list.h): their rows in the list, and their list. own_center and own_radius may be empty. exact: of
// their number, on the CPU; else as long as the whole list, with -1 in empty rows.
DIFFVBD_OPERATOR(Out<6>, contact_near, In x, In origin, In collider, In center, In own_center, In trust_radius,
                 In own_radius, In pinned, In pairs, In constants, In ptr, In entry, bool exact) {
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    const Reader<T> read(x);
    const int64_t colliders = read.colliders(collider), corners = read.b * (read.v + colliders);
    const contact::PairList all = pair_list(pairs, ptr, entry, x, corners);
    contact::NearInputs<T> in{};
    in.x = read.positions(), in.origin = read.vectors_or_null("origin", origin);
    in.collider = read.like("collider", collider, 3 * read.b * colliders);
    in.center = read.vectors("center", center), in.own_center = read.vectors_or_null("own_center", own_center);
    in.trust_radius = read.of_vertices("trust_radius", trust_radius);
    in.own_radius = own_radius.numel() > 0 ? read.of_vertices("own_radius", own_radius) : nullptr;
    require(!in.own_center == !in.own_radius, "diffvbd::contact_near: expected own_center and own_radius, or neither");
    in.pinned = read.flags("pinned", pinned, read.v, true);
    in.pairs = all.pairs, in.ptr = all.ptr, in.entry = all.entry;
    in.constants = pair_constants<T>(constants, pairs, x);
    in.count = pairs.size(0), in.corners = corners;
    in.vertices = static_cast<int32_t>(read.v), in.colliders = static_cast<int32_t>(colliders);
    const Tensor radius = device.empty({read.b, read.v});
    int64_t capacity = in.count;
#ifndef USE_CUDA
    require(std::is_sorted(in.ptr, in.ptr + ptr.numel()) && *in.ptr >= 0 && in.ptr[corners] <= entry.numel(),
            "diffvbd::contact_near: expected ptr that ascends up to the number of entries");
    const std::vector<T> gaps = find_gaps(in, read.b, data<T>(radius));
    if (exact) capacity = std::count_if(gaps.begin(), gaps.end(), contact::is_near<T>);
#endif
    const Tensor rows = device.empty({capacity}, ScalarType::Long),
                 constants_out = device.empty({capacity, contact::kConstants}),
                 pairs_out = device.empty({capacity, contact::kPairRow}, ScalarType::Int),
                 ptr_out = device.empty({ptr.numel()}, ScalarType::Int),
                 entry_out = device.empty({4 * capacity}, ScalarType::Int);
    const contact::NearList<T> out{data<int64_t>(rows),      data<int32_t>(pairs_out), data<int32_t>(ptr_out),
                                   data<int32_t>(entry_out), data<T>(constants_out),   capacity};
#ifdef USE_CUDA
    const Tensor work = device.bytes(cuda::near_workspace_bytes(in));
    DIFFVBD_RUN(device, find_near<T>, in, read.b, data<T>(radius), out, work.data_ptr());
#else
    copy_near(in, gaps, out);
#endif
    return Out<6>(radius, rows, pairs_out, constants_out, ptr_out, entry_out);
  });
}

// --- lagged values ---------------------------------------------------------------------------------------------------

// Normal force, 1 where active, normal and weights of each pair [pairs, 9]; the force that each bears, and the pair
// that bears its own [pairs]. The adjoint: of corner points [B, N, 3] and of kappa.
DIFFVBD_OPERATOR(Out<3>, contact_lag, In x, In origin, In collider, In kappa, In pairs, In constants, In ptr, In entry,
                 In body) {
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    const auto in = lag_inputs<T>(x, origin, collider, kappa, pairs, constants, ptr, entry);
    const int64_t count = pairs.size(0);
    const int32_t* bodies = Reader<T>(x).index("body", body, in.corners);
    Tensor lag = device.empty({count, contact::kLagScalars}), force = device.empty({count}),
           bearer = device.empty({count}, ScalarType::Long);
    DIFFVBD_RUN(device, pair_lag<T>, in, data<const T>(x), x.size(0), count, data<T>(lag));
    DIFFVBD_RUN(device, pair_loads<T>, in.listed, in.corners, bodies, data<const T>(lag), x.size(0), count,
                data<T>(force), data<int64_t>(bearer));
    return Out<3>(lag, force, bearer);
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

}  // namespace
}  // namespace diffvbd
