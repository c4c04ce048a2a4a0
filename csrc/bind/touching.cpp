// Operators of the rigid correction of bodies that touch.
#include "touching.h"

namespace diffvbd {
namespace {

// In a system in which the bodies of a mask move, or, if that is empty, all. alone: only groups of one do, and the
// memory of a factor has room for no others.
template <class T>
void set_moving(contact::RigidInputs<T>& in, const Tensor& moving, bool alone, const Tensor& x) {
  if (!in.together() && alone) in.capacity = std::min<int64_t>(in.bodies(), 1);
  const bool all = moving.dim() == 1 && moving.size(0) == 0;
  const bool* mask =
      array<bool>("moving", moving, x, ScalarType::Bool, all ? 0 : in.scene.scenes * int64_t{in.bodies()});
  if (!all && moving.numel() > 0) in.moving = mask;
}

DIFFVBD_ON_CUDA(cuda::PairCapacity trust_radius_of(const TouchingFields& f) {
  return {f.pairs.size(0), f.lag.numel() > 0 ? f.lag_pairs.size(0) : 0};
})

// The Newton step of the rigid motions of all bodies of a scene, float64: centers of mass [scenes, bodies, 3], motion
// [scenes, bodies, 6], the factors of groups that touch, in the memory [scenes, bodies, 6, 6 most] that
// contact/groups.h says, and groups [scenes, 4, bodies]; of few bodies one factor [scenes, 6 bodies, 6 bodies], and no
// groups. moving [scenes, bodies]: only groups of these bodies move; or [0]: all do. alone: of many bodies only groups
// of one do, with factors [scenes, bodies, 6, 6].
DIFFVBD_OPERATOR(Out<4>, contact_rigid_system, DIFFVBD_PARAMETERS(TOUCHING) Ints data_count, double time_step,
                 double friction_eps, In moving, bool alone) {
  const TouchingFields f{DIFFVBD_ITEMS(TOUCHING)};
  const Device device(x);
  require_positions(x);
  const int64_t b = x.size(0), n = ptr.numel() - 1, six = contact::kUnknowns;
  const bool few = n <= contact::kFew;
  Tensor groups =
      device.empty(few ? std::vector<int64_t>{0} : std::vector<int64_t>{b, contact::kGroupRows, n}, ScalarType::Int);
  return dispatch_float(x, [&]<class T>(T) {
    auto in = touching_inputs<T>(f, {data_count, time_step, friction_eps}, nullptr, groups);
    set_moving(in, moving, alone, x);
    Tensor centers = device.empty({b, n, 3}, ScalarType::Double),
           motion = device.empty({b, n, six}, ScalarType::Double);
    Tensor factor = device.empty(
        few ? std::vector<int64_t>{b, six * n, six * n} : std::vector<int64_t>{b, n, six, six * int64_t{in.capacity}},
        ScalarType::Double);
    DIFFVBD_ON_CUDA(const Tensor work = device.bytes(cuda::rigid_system_bytes(in, trust_radius_of(f)));)
    DIFFVBD_RUN(device, rigid_system<T>, in, DIFFVBD_ON_CUDA(trust_radius_of(f), ) data<double>(centers),
                data<double>(motion), data<double>(factor),
                in.groups ? data<int32_t>(groups) : nullptr DIFFVBD_ON_CUDA(, work.data_ptr()));
    return Out<4>(centers, motion, factor, groups);
  });
}

// The state after the admissible fraction of each motion [scenes, bodies, 6]; that fraction [scenes, bodies], with a
// mask `moving` zero where a body has no motion; whether it has a motion; whether it was blocked, in a scene where some
// blocked body has moved on; and the translation that it did not take [m].
DIFFVBD_OPERATOR(Out<5>, contact_rigid_move, DIFFVBD_PARAMETERS(TOUCHING) In centers, In motion, Ints data_count,
                 double time_step, double friction_eps, In moving) {
  const TouchingFields f{DIFFVBD_ITEMS(TOUCHING)};
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    const Reader<T> read(x);
    const Tensor displacement = device.like_x(), none = device.empty({0});
    auto in = touching_inputs<T>(f, {data_count, time_step, friction_eps}, data_or_null<T>(displacement), none);
    set_moving(in, moving, false, x);
    const int64_t b = read.b, n = in.bodies();
    const double *center = read.doubles("centers", centers, 3 * b * n),
                 *motions = read.doubles("motion", motion, contact::kUnknowns * b * n);
    const Tensor end = device.like_x(), fraction = device.empty({b, n}, ScalarType::Double),
                 moved = device.empty({b, n}, ScalarType::Bool), blocked = device.empty({b, n}, ScalarType::Bool),
                 remaining = device.empty({b, n});
    const contact::RigidOutcome<T> out{data<double>(fraction), data<bool>(moved), data<bool>(blocked),
                                       data<T>(remaining)};
    DIFFVBD_ON_CUDA(const Tensor work = device.bytes(cuda::rigid_move_bytes(in, trust_radius_of(f)));)
    DIFFVBD_RUN(device, rigid_move<T>, in, DIFFVBD_ON_CUDA(trust_radius_of(f), ) center, motions, data<T>(displacement),
                out, data<T>(end) DIFFVBD_ON_CUDA(, work.data_ptr()));
    return Out<5>(end, fraction, moved, blocked, remaining);
  });
}

// Of the virtual work of two motions p and q of all corner points [scenes, N, 3] that pairs do: its derivatives by
// where these points are, by p and by q [scenes, N, 3] each; since [scenes, N, 3]: the first of lagged pairs alone, or
// empty; by kappa for each listed pair; and less those by what is lagged [lagged, 9]. This part of
// contact_rigid_reverse can so be tested by itself.
DIFFVBD_OPERATOR(Out<6>, contact_rigid_backward, DIFFVBD_PARAMETERS(TOUCHING) In p, In q, In groups, Ints data_count,
                 double time_step, double friction_eps) {
  const TouchingFields f{DIFFVBD_ITEMS(TOUCHING)};
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    const auto in = touching_inputs<T>(f, {data_count, time_step, friction_eps}, nullptr, groups);
    const Reader<T> read(x);
    const int64_t size = 3 * read.b * in.gate.corners;
    const contact::VirtualMotions<T> given{read.like("p", p, size), read.like("q", q, size)};
    const WorkTensors out(f, device);
    DIFFVBD_ON_CUDA(const Tensor pushing = device.empty({1 + f.pairs.size(0)}, ScalarType::Int);)
    DIFFVBD_RUN(device, rigid_backward<T>, in, given, out.view<T>(),
                out.sums<T>() DIFFVBD_ON_CUDA(, data<int32_t>(pushing)));
    return Out<6>(out.by_x, out.by_p, out.by_q, out.since, out.by_kappa, out.lag_bar);
  });
}

// The adjoint of corrections in sequence, each from `at` [scenes, V, 3] by its motion, fraction, factor and groups.
// x_bar [scenes, V, 3]: adjoint of the state after the last one. Returned: adjoints of the first `at`, x_prev, y and
// mass, of data as of rigid_backward(), of floor_lag, of colliders at the end and at the start of the step, minus the
// contribution of each listed pair to that of kappa, and of lag.
DIFFVBD_OPERATOR(Out<11>, contact_rigid_reverse, DIFFVBD_PARAMETERS(TOUCHING) Tensors at, Tensors motion,
                 Tensors fraction, Tensors factor, Tensors groups, In x_bar, Ints data_count, double time_step,
                 double friction_eps, bool wants_data) {
  const TouchingFields f{DIFFVBD_ITEMS(TOUCHING)};
  const Device device(x);
  for (const auto* each : {&motion, &fraction, &factor, &groups}) {
    require(each->size() == at.size() && !at.empty(),
            "diffvbd::contact_rigid_reverse: expected as many at, motion, fraction, factor and groups, one at least");
  }
  return dispatch_float(x, [&]<class T>(T) {
    const Reader<T> read(x);
    std::vector<contact::RigidInputs<T>> inputs;
    for (size_t k = 0; k < at.size(); ++k) {
      auto in = touching_inputs<T>(f, {data_count, time_step, friction_eps}, nullptr, groups[k]);
      const int64_t rows = read.b * in.bodies();
      in.scene.x = in.gate.x = read.vectors("at", at[k]);
      if (!in.together() && factor[k].dim() == 4) in.capacity = factor[k].size(3) / contact::kUnknowns;
      read.doubles("factor", factor[k], read.b * in.matrix_size());
      require(read.b == 0 || in.together() == (in.groups == nullptr),
              "diffvbd::contact_rigid: expected groups as contact_rigid_system returns them");
      read.doubles("motion", motion[k], contact::kUnknowns * rows), read.doubles("fraction", fraction[k], rows);
      inputs.push_back(in);
    }
    const auto& last = inputs.back();
    const int64_t b = read.b, v = read.v, corners = last.gate.corners;
    const WorkTensors pairs_out(f, device);
    const Tensor p = device.zeros({b, corners, 3}), q = device.zeros({b, corners, 3}),
                 displacement = device.empty({b, v, 3});
    const RigidBars bars(last.scene, true, wants_data, [&](Ints sizes, bool) { return device.zeros(sizes); });
    const Tensor floor_out = device.zeros({last.planes > 0 ? b : 0, v, last.planes, contact::kFloorLag});
    const Tensor collider_out = device.zeros({b, corners - v, 3}),
                 collider_prev_out = device.zeros({b, corners - v, 3});
    const contact::CorrectionAdjoints<T> out{bars.pointers<T>(nullptr, nullptr), data_or_null<T>(floor_out),
                                             data<T>(collider_out), data<T>(collider_prev_out)};
    const Tensor solution = device.empty({b, last.bodies(), contact::kUnknowns}, ScalarType::Double);
    DIFFVBD_ON_CUDA(const Tensor pushing = device.empty({b + f.pairs.size(0)}, ScalarType::Int);)
    const auto work = pairs_out.view<T>();
    const auto sums = pairs_out.sums<T>();
    const T* end_bar = read.vectors("x_bar", x_bar);
    for (size_t k = inputs.size(); k-- > 0;) {
      const auto& in = inputs[k];
      const auto *motions = data<const double>(motion[k]), *fractions = data<const double>(fraction[k]),
                 *factors = data<const double>(factor[k]);
      double* l = data<double>(solution);
#ifdef USE_CUDA
      const cuda::RigidReverse<T> own{motions,
                                      fractions,
                                      factors,
                                      end_bar,
                                      l,
                                      data<T>(p),
                                      data<T>(q),
                                      data<T>(displacement),
                                      work,
                                      sums,
                                      data<int32_t>(pushing),
                                      out};
      DIFFVBD_RUN(device, rigid_contact_backward<T>, in, own);
#else
      rigid_end_backward<T>(in, motions, fractions, end_bar, l, data<T>(displacement), out.vertices.mass);
      rigid_solve<T>(in, factors, l);
      rigid_virtual_motions<T>(in, motions, l, data<T>(p), data<T>(q));
      rigid_backward<T>(in, {data<T>(p), data<T>(q)}, work, sums);
      rigid_vertices_backward<T>(in, motions, l, data<T>(displacement), sums, out);
#endif
      end_bar = out.vertices.x;
    }
    return Out<11>(bars.x, bars.x_prev, bars.y, bars.mass, bars.shared, bars.own, floor_out, collider_out,
                   collider_prev_out, pairs_out.by_kappa, pairs_out.lag_bar);
  });
}

}  // namespace
}  // namespace diffvbd
