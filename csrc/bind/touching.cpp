// Operators of the rigid correction of bodies that touch.
#include "touching.h"

namespace diffvbd {
namespace {

// The memory of a correction, which lives as long as this, and its inputs.
template <class T>
struct Correcting {
  contact::RigidStep<T> step;
  Tensor memory;

  Correcting(const TouchingFields& f, const TouchingSettings& settings, const Device& device, bool trials) {
    step.in = touching_inputs<T>(f, settings);
    memory = memory_of_trials(f, device, step, trials, [&](auto& take, int64_t scenes, int64_t, int64_t units) {
      step.r.parts(take, scenes, units, step.in.matrix_size());
    });
    step.in.groups = step.r.groups;
  }
};

// majorizes: friction has the stiffness of the block of a vertex, with which no motion is too long, and not its exact
// derivative.
//
// One correction of all bodies. The state after the admissible fraction of each motion [scenes, V, 3]; what each body
// took [scenes, bodies, 2]: that fraction, zero where none was found, and a number of the island whose common shift
// it took whole, or -1; and the translation that it did not take [m].
DIFFVBD_OPERATOR(Out<3>, contact_rigid_correct, DIFFVBD_PARAMETERS(TOUCHING) Ints data_count, double time_step,
                 double friction_eps, bool majorizes) {
  const TouchingFields f{DIFFVBD_ITEMS(TOUCHING)};
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    Correcting<T> work(f, {data_count, time_step, friction_eps, majorizes}, device, true);
    contact::RigidStep<T>& s = work.step;
    const int64_t b = x.size(0), n = s.in.bodies();
    const Tensor end = device.like_x(), taken = device.empty({b, n, 2}, ScalarType::Double),
                 fraction = device.empty({b, n}, ScalarType::Double), remaining = device.empty({b, n});
    s.out = {data<double>(taken), data<T>(remaining)};
    s.fraction = data<double>(fraction), s.x_end = data<T>(end);
    if (b * n > 0) DIFFVBD_RUN(device, contact_rigid_correct<T>, s);
    return Out<3>(end, taken, remaining);
  });
}

// The adjoint of a correction. taken: What it returned. x_bar [scenes, V, 3]: adjoint of the state after it. Returned:
// adjoints of x, x_prev, y and mass, of data as of rigid_backward(), of floor_lag, of colliders at the end and at the
// start of the step, minus the contribution of each listed pair to that of kappa, and of lag.
DIFFVBD_OPERATOR(Out<11>, contact_rigid_reverse, DIFFVBD_PARAMETERS(TOUCHING) In taken, In x_bar, Ints data_count,
                 double time_step, double friction_eps, bool majorizes, bool wants_data) {
  const TouchingFields f{DIFFVBD_ITEMS(TOUCHING)};
  const Device device(x);
  return dispatch_float(x, [&]<class T>(T) {
    const Reader<T> read(x);
    Correcting<T> memory(f, {data_count, time_step, friction_eps, majorizes}, device, false);
    contact::RigidStep<T>& s = memory.step;
    const int64_t b = read.b, v = read.v, corners = s.in.gate.corners, n = s.in.bodies();
    const WorkTensors pairs_out(f, device);
    const Tensor p = device.zeros({b, corners, 3}), q = device.zeros({b, corners, 3}),
                 displacement = device.empty({b, v, 3});
    const RigidBars bars(s.in.scene, true, wants_data, [&](Ints sizes, bool) { return device.zeros(sizes); });
    const Tensor floor_out = device.zeros({s.in.planes > 0 ? b : 0, v, s.in.planes, contact::kFloorLag});
    const Tensor collider_out = device.zeros({b, corners - v, 3}),
                 collider_prev_out = device.zeros({b, corners - v, 3});
    const Tensor moving = device.empty({b, n}, ScalarType::Bool), bar = device.empty({b, n, 3}, ScalarType::Double);
    s.in.moving = data<bool>(moving);
    const contact::VirtualMotions<T> given{data<T>(p), data<T>(q)};
    contact::RigidReverse<T> r{s,
                               {s.in, given, pairs_out.view<T>(), pairs_out.sums<T>()},
                               read.doubles("taken", taken, 2 * b * n),
                               data<bool>(moving),
                               data<double>(bar),
                               read.vectors("x_bar", x_bar),
                               data<T>(p),
                               data<T>(q),
                               data<T>(displacement),
                               {bars.pointers<T>(nullptr, nullptr), data_or_null<T>(floor_out), data<T>(collider_out),
                                data<T>(collider_prev_out)}};
    if (b * n > 0) DIFFVBD_RUN(device, contact_rigid_reverse<T>, r);
    return Out<11>(bars.x, bars.x_prev, bars.y, bars.mass, bars.shared, bars.own, floor_out, collider_out,
                   collider_prev_out, pairs_out.by_kappa, pairs_out.lag_bar);
  });
}

}  // namespace
}  // namespace diffvbd
