// Operators on whole bodies: the rigid correction, the beginning of a step, and the rise of potentials.
#include "body.h"

#include "../subspace/begin.h"
#include "../subspace/coarse.h"

namespace diffvbd {
namespace {

#ifndef DIFFVBD_LAW_HEADER  // what reads no law

// The rigid correction of each body that is listed, and the velocity (x - x_prev) / h. groups: how many bodies a
// thread, a part of a warp, a block and the whole device work on (CUDA).
DIFFVBD_OPERATOR(Out<2>, rigid, DIFFVBD_PARAMETERS(RIGID) Ints groups, Ints data_count, double time_step) {
  const Device device(x);
  const RigidFields f{DIFFVBD_ITEMS(RIGID)};
  return dispatch_float(x, [&]<class T>(T) {
    const auto in = rigid_inputs<T>(f, data_count, time_step);
    const Tensor out = device.like_x(), v = device.like_x();
    DIFFVBD_ON_CUDA(const Teams teams(groups, in.bodies, device, x);)
    DIFFVBD_RUN(device, rigid_correct<T>, in, DIFFVBD_ON_CUDA(teams.groups, ) order.numel() < in.vertices, data<T>(out),
                data<T>(v) DIFFVBD_ON_CUDA(, teams.work()));
    return Out<2>(out, v);
  });
}

// v_bar: empty where there is none. Adjoints of x, x_prev (empty without energies and v_bar), y, mass, and of data:
// [scenes, bodies, scalars of a scene] and [scenes, vertices, scalars of a vertex].
DIFFVBD_OPERATOR(Out<6>, rigid_backward, DIFFVBD_PARAMETERS(RIGID) In x_bar, In v_bar, Ints groups, Ints data_count,
                 double time_step, bool wants_data) {
  const Device device(x);
  const RigidFields f{DIFFVBD_ITEMS(RIGID)};
  return dispatch_float(x, [&]<class T>(T) {
    const auto in = rigid_inputs<T>(f, data_count, time_step);
    const Reader<T> read(x);
    const RigidBars bars(in, v_bar.numel() > 0, wants_data, device);
    DIFFVBD_ON_CUDA(const Teams teams(groups, in.bodies, device, x);)
    const auto out = bars.pointers(read.vectors("x_bar", x_bar), read.vectors_or_null("v_bar", v_bar));
    DIFFVBD_RUN(device, rigid_reverse<T>, in, DIFFVBD_ON_CUDA(teams.groups, ) order.numel() < in.vertices,
                out DIFFVBD_ON_CUDA(, teams.work()));
    return Out<6>(bars.x, bars.x_prev, bars.y, bars.mass, bars.shared, bars.own);
  });
}

#endif

struct BeginSettings {
  Ints data_count;
  double time_step, filter_eta, lookback;
  int64_t from;
  bool filters;
};
int64_t corrected_bodies(const BeginFields& f) { return f.ptr.numel() - 1; }
int64_t other_bodies(const BeginFields& f) { return f.other_ptr.numel() - 1; }

// x_start and y: [B, V, 3] that the bodies read and the kernels write.
template <class T>
start::Inputs<T> begin_inputs(const BeginFields& t, const BeginSettings& q, const Tensor& x_start, const Tensor& y,
                              const Tensor& from_predictor, const Tensor& alone) {
  const Reader<T> read(t.x);
  start::Inputs<T> in{};
  in.bodies = rigid_inputs<T>({x_start, t.x, y, t.mass, t.energy_data, t.origin, t.order, t.ptr, t.spread, t.other},
                              q.data_count, q.time_step);
  const int64_t b = read.b, v = read.v;
  in.x = in.bodies.x_prev;
  in.v = read.batch("v", t.v, 3 * v);
  in.acceleration = read.batch("acceleration", t.acceleration, 3 * v, 3);
  in.prescribed = read.batch_or_null("prescribed", t.prescribed, 3 * v);
  in.pinned = read.flags("pinned", t.pinned, v);
  require(q.from >= start::kInertia && q.from <= start::kLower, "diffvbd::begin: expected start 0, 1 or 2");
  in.others = static_cast<int32_t>(other_bodies(t));
  in.from_predictor = q.from == start::kLower ? read.bytes("from_predictor", from_predictor, b * in.others)
                                              : data<const uint8_t>(from_predictor);
  require(alone.numel() == 0 || q.filters, "diffvbd::begin: expected filters with alone");
  in.alone = alone.numel() > 0 ? read.bytes("alone", alone, b * corrected_bodies(t)) : nullptr;
  require(!q.filters || (in.bodies.data_count[0] > 0 &&
                         in.bodies.data_count[0] <= FloorStart::kMostPlanes * FloorBarrier::stride),
          "diffvbd::begin: expected 1 to 8 planes");
  in.from = static_cast<int>(q.from);
  in.some_alone = t.order.numel() < v;
  in.filters = q.filters;
  require(q.lookback != 0, "diffvbd::begin: expected lookback other than 0");
  in.lookback = q.lookback;
  in.parameters.time_step = T(q.time_step);
  in.parameters.filter_eta = T(q.filter_eta);
  return in;
}

// Two states of the bodies that are corrected, or of the others.
template <class T>
start::Candidates<T> candidates(const BeginFields& t, const BeginSettings& q, bool corrected, const Tensor& x_start,
                                const Tensor& other, const Tensor& y) {
  const Reader<T> read(t.x);
  start::Candidates<T> in{};
  const Tensor &order = corrected ? t.order : t.other_order, &ptr = corrected ? t.ptr : t.other_ptr;
  const Tensor &listed = corrected ? t.tets : t.other_tets, &tet_ptr = corrected ? t.tet_ptr : t.other_tet_ptr;
  in.bodies = rigid_inputs<T>({x_start, t.x, y, t.mass, t.energy_data, t.origin, order, ptr, t.spread, t.other},
                              q.data_count, q.time_step, false);
  const int64_t tets = t.rest.dim() == 3 ? t.rest.size(1) : 0;
  in.other = data<const T>(other);
  in.tets = read.index("tets", listed, 5 * listed.size(0));
  in.tet_ptr = data<const int32_t>(tet_ptr);
  if (tets > 0) {
    const auto material = material_of(t);
    for (int m = 0; m < kMaterialScalars; ++m) in.material[m] = read.batch(kMaterialNames[m], *material[m], tets, 1);
    in.rest = read.batch("rest", t.rest, kRestScalars * tets);
  }
  return in;
}

void require_states(const BeginFields& f) {
  const auto agree = [&](const Tensor& ptr, const Tensor& tet_ptr) {
    return is_index(ptr, f.x) && is_index(tet_ptr, f.x) && ptr.numel() > 0 && tet_ptr.numel() == ptr.numel();
  };
  require_positions(f.x);
  require(agree(f.ptr, f.tet_ptr) && agree(f.other_ptr, f.other_tet_ptr),
          "diffvbd::begin: expected ptr, tet_ptr, other_ptr and other_tet_ptr int32 [bodies + 1]");
}

// Predictor and start of the sweeps. lookback: as in sweep/extrapolation.h. kind: of the start of bodies that are not
// corrected, 0 x + h v, 1 y, 2 the lower potential of the two; from_predictor [scenes, other bodies]: 1 where that is
// y; alone [scenes, bodies]: with parts, 1 where the vertices of a body that is corrected start each by itself.
DIFFVBD_OPERATOR(Out<4>, begin, DIFFVBD_PARAMETERS(BEGIN) Ints groups, Ints other_groups, Ints data_count,
                 double time_step, double filter_eta, double lookback, int64_t kind, bool filters, bool parts) {
  const BeginFields f{DIFFVBD_ITEMS(BEGIN)};
  require_states(f);
  const Device device(x);
  const BeginSettings settings{data_count, time_step, filter_eta, lookback, kind, filters};
  return dispatch_float(x, [&]<class T>(T) {
    const bool chooses = kind == start::kLower && other_bodies(f) > 0, may_part = parts && corrected_bodies(f) > 0;
    const Tensor x_start = device.like_x(), y = device.like_x();
    const Tensor from_y = chooses && filters ? device.like_x() : y, apart = may_part ? device.like_x() : y;
    const Tensor from_predictor =
        device.empty({kind == start::kLower ? x.size(0) : 0, other_bodies(f)}, ScalarType::Byte);
    const Tensor alone = device.empty({parts ? x.size(0) : 0, corrected_bodies(f)}, ScalarType::Byte);
    const auto in = begin_inputs<T>(f, settings, x_start, y, from_predictor, alone);
    start::Candidates<T> two{}, parting{};
    if (chooses) two = candidates<T>(f, settings, false, x_start, from_y, y);
    if (may_part) parting = candidates<T>(f, settings, true, x_start, apart, y);
    const StartChoice<T> of_others{chooses ? &two : nullptr, data<T>(from_y), data_or_null<uint8_t>(from_predictor)};
    const StartChoice<T> of_corrected{may_part ? &parting : nullptr, data<T>(apart), data_or_null<uint8_t>(alone)};
#ifdef USE_CUDA
    const Teams teams(groups, in.bodies.bodies, device, x), others(other_groups, other_bodies(f), device, x);
    DIFFVBD_RUN(device, begin<T>, in, teams.groups, of_corrected, others.groups, of_others, data<T>(x_start),
                data<T>(y), (teams.memory.numel() > 0 ? teams : others).work());
#else
    diffvbd::begin<T>(in, of_corrected, of_others, data<T>(x_start), data<T>(y));
#endif
    return Out<4>(x_start, y, from_predictor, alone);
  });
}

#ifndef DIFFVBD_LAW_HEADER

// wants: acceleration, prescribed, energy_data. Of data: from corrections as of rigid_backward(), and of the planes by
// vertex [scenes, vertices, scalars of the planes].
DIFFVBD_OPERATOR(Out<8>, begin_backward, DIFFVBD_PARAMETERS(BEGIN) In x_start_bar, In y_bar, In from_predictor,
                 In alone, Ints groups, Ints data_count, double time_step, double filter_eta, double lookback,
                 int64_t kind, bool filters, Flags wants) {
  const BeginFields f{DIFFVBD_ITEMS(BEGIN)};
  require_states(f);
  require(wants.size() == 3, "diffvbd::begin_backward: expected 3 wishes");
  const Device device(x);
  const BeginSettings settings{data_count, time_step, filter_eta, lookback, kind, filters};
  return dispatch_float(x, [&]<class T>(T) {
    // extrapolated positions and predictor of the corrected bodies, recomputed
    const Tensor extrapolated = order.numel() > 0 ? device.like_x() : x, y = order.numel() > 0 ? device.like_x() : x;
    const auto in = begin_inputs<T>(f, settings, extrapolated, y, from_predictor, alone);
    const Reader<T> read(x);
    const int64_t b = read.b, v_ = read.v;
    const auto [of_scene, of_vertex] = scalars_of_data(in.bodies.data_count);
    const auto state = [&](bool wish) { return wish ? device.like_x() : device.empty({0}); };
    const Tensor x_out = state(true), v_out = state(true), acceleration_out = state(wants[0]),
                 prescribed_out = state(wants[1]), mass_out = device({b, v_}, in.some_alone),
                 shared = device.zeros({b, wants[2] ? in.bodies.bodies : 0, of_scene}),
                 own = device.zeros({b, wants[2] ? v_ : 0, of_vertex}),
                 planes = device.zeros({b, wants[2] && filters ? v_ : 0, in.bodies.data_count[0]}),
                 x_prev_out = state(in.bodies.data.data != nullptr && order.numel() > 0);
    start::Adjoints<T> a{};
    a.x_start = read.vectors("x_start_bar", x_start_bar), a.y = read.vectors("y_bar", y_bar);
    a.x = data<T>(x_out), a.v = data<T>(v_out), a.mass = data<T>(mass_out);
    a.acceleration = data_or_null<T>(acceleration_out), a.prescribed = data_or_null<T>(prescribed_out);
    a.planes = data_or_null<T>(planes), a.shared = data_or_null<T>(shared), a.own = data_or_null<T>(own);
    a.x_prev = data_or_null<T>(x_prev_out);
    a.shared_count = static_cast<int32_t>(of_scene), a.own_count = static_cast<int32_t>(of_vertex);
    DIFFVBD_ON_CUDA(const Teams teams(groups, in.bodies.bodies, device, x);)
    DIFFVBD_RUN(device, begin_backward<T>, in, DIFFVBD_ON_CUDA(teams.groups, ) a, data<T>(extrapolated),
                data<T>(y) DIFFVBD_ON_CUDA(, teams.work()));
    return Out<8>(x_out, v_out, acceleration_out, prescribed_out, mass_out, shared, own, planes);
  });
}

#endif

// Increase of the potential of each body from x to `to`, and the sum of the sizes of its terms [scenes, bodies, 2],
// float64; infinite where a vertex comes too near a plane. order, ptr: vertices that move, by body; material [1 |
// scenes, blocks, 2, lanes], rest [1 | scenes, blocks, 7, lanes] and corner (four times a vertex) [blocks, 4, lanes] of
// their tets, in blocks by body.
DIFFVBD_OPERATOR(Tensor, potential_increase, In x, In to, In x_prev, In y, In mass, In energy_data, In origin,
                 In material, In rest, In order, In ptr, In other, In corner, In block_ptr, Ints data_count,
                 double time_step) {
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    const Reader<T> read(x);
    coarse::IncreaseInputs<T> in{};
    in.bodies = rigid_inputs<T>({x, x_prev, y, mass, energy_data, origin, order, ptr, order, other}, data_count,
                                time_step, false);
    const int64_t blocks = corner.size(0), bodies = in.bodies.bodies;
    in.to = read.vectors("to", to);
    in.corner = read.index("corner", corner, blocks * 4 * coarse::kBlockTets);
    in.block_ptr = read.index("block_ptr", block_ptr, bodies + 1);
    in.rest = read.batch("rest", rest, blocks * kRestScalars * coarse::kBlockTets);
    in.material = read.batch("material", material, blocks * kMaterialScalars * coarse::kBlockTets);
    in.blocks = blocks, in.listed = order.numel();
#ifndef USE_CUDA
    require(in.bodies.ptr[bodies] <= in.listed, "diffvbd::potential_increase: expected order with all vertices of ptr");
#endif
    const Tensor out = device.empty({read.b, bodies, 2}, ScalarType::Double);
    DIFFVBD_ON_CUDA(const Tensor work = device.empty({cuda::energy_increase_workspace(in)}, ScalarType::Double);)
    DIFFVBD_RUN(device, energy_increase, in, DIFFVBD_ON_CUDA(data<double>(work), ) data<double>(out));
    return out;
  });
}

}  // namespace
}  // namespace diffvbd
