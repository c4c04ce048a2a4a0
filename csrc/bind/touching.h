// Bodies that touch, as the operators of their corrections take them.
#pragma once

#include "../subspace/rigid_step.h"
#include "body.h"
#include "contact.h"

namespace diffvbd {

struct TouchingSettings {
  Ints data_count;
  double time_step, friction_eps;
  bool majorizes = false;  // friction
};

template <class T>
contact::RigidInputs<T> touching_inputs(const TouchingFields& t, const TouchingSettings& q) {
  const Reader<T> read(t.x);
  const int64_t b = read.b, v = read.v, colliders = read.colliders(t.collider), corners = v + colliders;
  contact::RigidInputs<T> in{};
  in.scene = rigid_inputs<T>({t.x, t.x_prev, t.y, t.mass, t.energy_data, t.origin, t.order, t.ptr, t.x, t.order},
                             q.data_count, q.time_step, false);
  const int64_t bodies = in.scene.bodies;
  in.free = read.flags("free", t.free, bodies);
  contact::AdvanceInputs<T>& gate = in.gate;
  gate.x = read.positions();
  gate.origin = in.scene.origin.data;
  gate.center = read.vectors("center", t.center), gate.trust_radius = read.of_vertices("trust_radius", t.trust_radius);
  gate.collider = gate.collider_next = read.like("collider", t.collider, 3 * b * colliders);
  in.collider_prev = read.like("collider_prev", t.collider_prev, 3 * b * colliders);
  gate.pinned = read.flags("pinned", t.pinned, corners), gate.body = read.index("body", t.body, corners);
  gate.listed = pair_list(t.pairs, t.pair_ptr, t.pair_entry, t.x, b * corners);
  gate.constants = pair_constants<T>(t.constants, t.pairs, t.x);
  gate.scenes = b;
  gate.vertices = static_cast<int32_t>(v), gate.corners = static_cast<int32_t>(corners);
  gate.bodies = static_cast<int32_t>(bodies);
  gate.unit_of = gate.body, gate.units_of_scene = gate.bodies;
  if (t.lag.numel() > 0) {
    in.lagged = pair_list(t.lag_pairs, t.lag_ptr, t.lag_entry, t.x, b * corners);
    in.lag = read.like("lag", t.lag, t.lag_pairs.size(0) * contact::kLagScalars);
  }
  in.kappa = read.batch("kappa", t.kappa, 1);
  if (t.floor_lag.numel() > 0 && v > 0) {
    in.planes = static_cast<int32_t>(t.floor_lag.numel() / t.floor_lag.size(0) / (v * contact::kFloorLag));
    in.floor_lag = read.batch("floor_lag", t.floor_lag, v * in.planes * contact::kFloorLag);
  }
  in.friction_eps = 0 < q.friction_eps ? q.friction_eps : 1;
  in.friction_bend = q.majorizes ? 0 : 1;
  return in;
}

inline int64_t lagged_pairs(const TouchingFields& f) { return f.lag.numel() > 0 ? f.lag_pairs.size(0) : 0; }

// Memory of a correction and, if it makes them, of its trials. more(take, scenes, vertices, bodies): what else it
// takes, vertices and bodies of all scenes.
template <class T, class More>
Tensor memory_of_trials(const TouchingFields& f, const Device& device, contact::TrialStep<T>& s, bool trials,
                        const More& more) {
  const int64_t b = f.x.size(0), vertices = b * s.in.scene.vertices, units = b * s.in.bodies();
  s.all.listed = f.pairs.size(0), s.all.lagged = lagged_pairs(f);
  const Tensor out = workspace(device, [&](auto& take) {
    s.all.parts(take, vertices);
    s.m.parts(take, s.all.rows(), b, vertices, units, trials);
    more(take, b, vertices, units);
  });
  s.in.gate.move = s.m.move;
  s.m.state.motion = s.m.motions, s.m.state.first = false;
  return out;
}

// The work of pairs in two virtual motions, and the rows that it goes through.
struct WorkTensors {
  Tensor barrier, pushes, friction, by_x, by_p, by_q, since, by_kappa, lag_bar;
  WorkTensors(const TouchingFields& f, const Device& device) {
    const int64_t b = f.x.size(0), corners = f.body.size(0), listed = f.pairs.size(0), lagged = lagged_pairs(f);
    barrier = device.empty({listed, 4, contact::kWorkScalars});
    pushes = device.empty({listed}, ScalarType::Byte);
    friction = device.empty({lagged, 4, contact::kWorkScalars});
    by_x = device.empty({b, corners, 3}), by_p = device.empty({b, corners, 3}), by_q = device.empty({b, corners, 3});
    since = device.empty({lagged > 0 ? b : 0, corners, 3});
    by_kappa = device.zeros({listed}), lag_bar = device.zeros({lagged, contact::kLagScalars});
  }
  template <class T>
  contact::RigidWork<T> view() const {
    return {data<T>(barrier), data<T>(by_kappa), data<uint8_t>(pushes), data<T>(friction),
            data<T>(lag_bar), barrier.size(0),   friction.size(0)};
  }
  template <class T>
  contact::PointWork<T> sums() const {
    return {data<T>(by_x), data<T>(by_p), data<T>(by_q), data_or_null<T>(since)};
  }
};

}  // namespace diffvbd
