// Operators of the coarse correction of bodies that touch.
#include "../subspace/contact_coarse.h"

#include "touching.h"

namespace diffvbd {
namespace {

// free: the bodies of the mesh that have a vertex to move.
template <class T>
contact::CoarseInputs<T> coarse_inputs(const TouchingFields& f, const SpaceFields& s, const TouchingSettings& q) {
  contact::CoarseInputs<T> c{};
  c.in = touching_inputs<T>(f, q);
  c.in.bends = true;
  const Reader<T> read(f.x);
  const int64_t entries = s.function.numel(), functions = s.function_ptr.numel() - 1, tets = s.tets.size(0);
  contact::CoarseSpace& space = c.space;
  space.vertex_ptr = read.index("vertex_ptr", s.vertex_ptr, read.v + 1);
  space.function = read.index("function", s.function, entries), space.entry = read.index("entry", s.entry, entries);
  space.function_ptr = read.index("function_ptr", s.function_ptr, functions + 1);
  space.vertex = read.index("vertex", s.vertex, entries), space.own = read.index("own", s.own, 4 * functions);
  space.body_ptr = read.index("body_ptr", s.body_ptr, c.in.bodies() + 1);
  space.body_function = read.index("body_function", s.body_function, functions);
  space.functions = static_cast<int32_t>(functions);
  c.weight = read.like("weight", s.weight, entries);
  c.num_tets = tets;
  if (tets == 0) return c;
  c.tets = array<int64_t>("tets", s.tets, f.x, ScalarType::Long, 4 * tets);
  c.star_ptr = array<int64_t>("star_ptr", s.star_ptr, f.x, ScalarType::Long, read.v + 1);
  c.star = read.index("star", s.star, 4 * tets);
  const auto material = material_of(s);
  for (int m = 0; m < kMaterialScalars; ++m) c.material[m] = read.batch(kMaterialNames[m], *material[m], tets, 1);
  c.rest = read.batch("rest", s.rest, kRestScalars * tets);
  return c;
}

// P' g [scenes, F, 3] and the matrices [scenes, 3F, 3F], float64. packed [1 | scenes, 9 cells]: those of all bodies
// without vertex energies and pairs.
DIFFVBD_OPERATOR(Out<2>, contact_coarse_system, DIFFVBD_PARAMETERS(TOUCHING) DIFFVBD_PARAMETERS(SPACE) In packed,
                 Ints data_count, double time_step, double friction_eps) {
  const TouchingFields f{DIFFVBD_ITEMS(TOUCHING)};
  const SpaceFields s{DIFFVBD_ITEMS(SPACE)};
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    const auto c = coarse_inputs<T>(f, s, {data_count, time_step, friction_eps});
    const Reader<T> read(x);
    const int64_t b = read.b, v = read.v, n = c.size();
    contact::RowMemory rows{f.pairs.size(0), lagged_pairs(f)};
    contact::SystemMemory memory;
    const Tensor work = workspace(device, [&](auto& take) {
      rows.parts(take, b * v);
      memory.parts(take, rows.rows(), b * v);
    });
    const Tensor r = device.empty({b, n / 3, 3}, ScalarType::Double),
                 matrix = device.empty({b, n, n}, ScalarType::Double);
    const auto own = read.batch("packed", packed, packed.dim() == 2 ? packed.size(1) : 0);
    DIFFVBD_RUN(device, contact_coarse_system<T>, c, own, rows, memory, data<double>(r), data<double>(matrix));
    return Out<2>(r, matrix);
  });
}

// The state after the fraction of -P a that each island takes, and that fraction of each body [scenes, bodies],
// float64. info [scenes] int32: not 0 where the matrix was not positive definite, and nothing moves.
DIFFVBD_OPERATOR(Out<2>, contact_coarse_move, DIFFVBD_PARAMETERS(TOUCHING) DIFFVBD_PARAMETERS(SPACE) In a, In r,
                 In info, Ints data_count, double time_step, double friction_eps) {
  const TouchingFields f{DIFFVBD_ITEMS(TOUCHING)};
  const SpaceFields s{DIFFVBD_ITEMS(SPACE)};
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    contact::CoarseStep<T> step;
    step.c = coarse_inputs<T>(f, s, {data_count, time_step, friction_eps});
    step.in = step.c.in;
    const Reader<T> read(x);
    const int64_t b = read.b, n = step.in.bodies();
    const Tensor end = device.like_x(), fraction = device.empty({b, n}, ScalarType::Double);
    const Tensor memory = memory_of_trials(
        f, device, step, true,
        [&](auto& take, int64_t, int64_t vertices, int64_t bodies) { step.own.parts(take, vertices, bodies); });
    step.a = read.doubles("a", a, b * step.c.size()), step.r = read.doubles("r", r, b * step.c.size());
    step.info = read.index("info", info, b);
    step.fraction = data<double>(fraction), step.x_end = data<T>(end);
    DIFFVBD_RUN(device, contact_coarse_move<T>, step);
    return Out<2>(end, fraction);
  });
}

// P' of the adjoint of the displacement [scenes, F, 3], float64, from that of the state after it [scenes, V, 3].
DIFFVBD_OPERATOR(Tensor, contact_coarse_restrict, DIFFVBD_PARAMETERS(TOUCHING) DIFFVBD_PARAMETERS(SPACE) In x_bar,
                 In fraction, Ints data_count, double time_step, double friction_eps) {
  const TouchingFields f{DIFFVBD_ITEMS(TOUCHING)};
  const SpaceFields s{DIFFVBD_ITEMS(SPACE)};
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    const auto c = coarse_inputs<T>(f, s, {data_count, time_step, friction_eps});
    const Reader<T> read(x);
    const Tensor out = device.empty({read.b, c.size() / 3, 3}, ScalarType::Double);
    DIFFVBD_RUN(device, contact_coarse_restrict<T>, c, read.vectors("x_bar", x_bar),
                read.doubles("fraction", fraction, read.b * c.in.bodies()), data<double>(out));
    return out;
  });
}

// The adjoints of contact_rigid_reverse in its order, then of the tets' material [scenes, tets, 2] and rest shape
// [scenes, tets, 7], and of packed [scenes, 9 cells]; wants: data, material, rest, packed. l [scenes, F, 3]: the
// solution for what contact_coarse_restrict returns.
DIFFVBD_OPERATOR(Out<14>, contact_coarse_reverse, DIFFVBD_PARAMETERS(TOUCHING) DIFFVBD_PARAMETERS(SPACE) In packed,
                 In a, In l, In fraction, In x_bar, Ints data_count, double time_step, double friction_eps,
                 Flags wants) {
  require(wants.size() == 4, "diffvbd::contact_coarse_reverse: expected 4 wishes");
  const TouchingFields f{DIFFVBD_ITEMS(TOUCHING)};
  const SpaceFields s{DIFFVBD_ITEMS(SPACE)};
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    auto c = coarse_inputs<T>(f, s, {data_count, time_step, friction_eps});
    const Reader<T> read(x);
    const int64_t b = read.b, v = read.v, corners = c.in.gate.corners, tets_listed = c.num_tets,
                  cells = packed.dim() == 2 ? packed.size(1) / 9 : 0;
    c.space.cells = static_cast<int32_t>(cells);
    const WorkTensors pairs_out(f, device);
    const Tensor p = device.empty({b, corners, 3}), q = device.empty({b, corners, 3});
    const RigidBars bars(c.in.scene, true, wants[0], [&](Ints sizes, bool) { return device.zeros(sizes); });
    const Tensor floor_out = device.zeros({c.in.planes > 0 ? b : 0, v, c.in.planes, contact::kFloorLag});
    const Tensor collider_out = device.zeros({b, corners - v, 3}),
                 collider_prev_out = device.zeros({b, corners - v, 3});
    const Tensor material_out = device.empty({b, wants[1] ? tets_listed : 0, kMaterialScalars}),
                 rest_out = device.empty({b, wants[2] ? tets_listed : 0, kRestScalars}),
                 packed_out = device.empty({b, wants[3] ? 9 * cells : 0});
    const contact::CoarseAdjoints<T> out{{bars.pointers<T>(nullptr, nullptr), data_or_null<T>(floor_out),
                                          data<T>(collider_out), data<T>(collider_prev_out)},
                                         data_or_null<T>(material_out),
                                         data_or_null<T>(rest_out),
                                         data_or_null<T>(packed_out)};
    const auto work = pairs_out.view<T>();
    const auto sums = pairs_out.sums<T>();
    const double *own_a = read.doubles("a", a, b * c.size()), *own_l = read.doubles("l", l, b * c.size()),
                 *own_fraction = read.doubles("fraction", fraction, b * c.in.bodies());
    const contact::VirtualMotions<T> given{data<T>(p), data<T>(q)};
    DIFFVBD_RUN(device, contact_coarse_motions<T>, c, own_a, own_l, own_fraction, data<T>(p), data<T>(q));
    const contact::WorkStep<T> pair_work{c.in, given, work, sums};
    DIFFVBD_RUN(device, work_of_pairs<T>, pair_work);
    DIFFVBD_RUN(device, contact_coarse_reverse<T>, c, own_a, own_l, own_fraction, read.vectors("x_bar", x_bar), given,
                sums, out);
    return Out<14>(bars.x, bars.x_prev, bars.y, bars.mass, bars.shared, bars.own, floor_out, collider_out,
                   collider_prev_out, pairs_out.by_kappa, pairs_out.lag_bar, material_out, rest_out, packed_out);
  });
}

}  // namespace
}  // namespace diffvbd
