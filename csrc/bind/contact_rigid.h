// The tensors of the rigid correction of bodies that touch, as the operators of all backends take them.
#pragma once

#include <algorithm>
#include <tuple>
#include <vector>

#include "../subspace/contact_rigid_reverse.h"
#include "../subspace/contact_rigid.h"
#include "contact_start.h"
#include "rigid.h"

namespace diffvbd {

// move [B, V, 3]: what is tried, memory of the operator; empty where nothing is. groups [B, 4, bodies]: as
// contact/groups.h has them; empty where they do not matter, or all bodies are one.
template <class T>
contact::RigidInputs<T> touching_inputs(const TouchingFields& t, const std::vector<int64_t>& data_count,
                                        double time_step, double friction_eps, const Tensor& move,
                                        const Tensor& groups) {
  require_positions(t.x);
  contact::RigidInputs<T> in{};
  const int64_t b = t.x.size(0), v = t.x.size(1), colliders = t.collider.dim() == 3 ? t.collider.size(1) : 0;
  const int64_t bodies = t.ptr.numel() - 1, corners = v + colliders;
  in.scene = rigid_inputs<T>({t.x, t.x_prev, t.y, t.mass, t.energy_data, t.origin, t.order, t.ptr, t.x, t.order},
                             data_count, time_step, false);
  require(t.order.numel() == v, "diffvbd::contact_rigid: expected order of all vertices");
  require(is_beside(t.free, t.x, ScalarType::Bool) && t.free.numel() == bodies,
          "diffvbd::contact_rigid: expected free bool [bodies]");
  require(is_beside(t.held, t.x, ScalarType::Bool) && is_index(t.body, t.x) && t.held.numel() == corners &&
              t.body.numel() == corners,
          "diffvbd::contact_rigid: expected held and body of all corner points");
  in.free = data<const bool>(t.free);
  contact::AdvanceInputs<T>& gate = in.gate;
  gate.x = data<const T>(t.x), gate.move = move.numel() > 0 ? data<const T>(move) : nullptr;
  gate.origin = in.scene.origin.data;
  require_like("center", t.center, t.x, 3 * b * v);
  require_like("room", t.room, t.x, b * v);
  gate.center = data<const T>(t.center), gate.trust_radius = data<const T>(t.room);
  require_like("collider", t.collider, t.x, 3 * b * colliders);
  require_like("collider_prev", t.collider_prev, t.x, 3 * b * colliders);
  gate.collider = gate.collider_next = data<const T>(t.collider);
  in.collider_prev = data<const T>(t.collider_prev);
  gate.pinned = data<const bool>(t.held), gate.body = data<const int32_t>(t.body);
  gate.listed = pair_list(t.pairs, t.pair_ptr, t.pair_entry, t.x, corners);
  require_like("constants", t.constants, t.x, t.pairs.size(0) * contact::kConstants);
  gate.constants = data<const T>(t.constants);
  gate.scenes = b;
  gate.vertices = static_cast<int32_t>(v), gate.corners = static_cast<int32_t>(corners);
  gate.bodies = static_cast<int32_t>(bodies);
  gate.whole = true;
  if (t.lag.numel() > 0) {
    in.lagged = pair_list(t.lag_pairs, t.lag_ptr, t.lag_entry, t.x, corners);
    require_like("lag", t.lag, t.x, t.lag_pairs.size(0) * contact::kLagScalars);
    in.lag = data<const T>(t.lag);
  }
  in.kappa = batched<T>("kappa", t.kappa, t.x, b, 1);
  if (t.floor_lag.numel() > 0 && v > 0) {
    in.planes = static_cast<int32_t>(t.floor_lag.numel() / t.floor_lag.size(0) / (v * contact::kFloorLag));
    in.floor_lag = batched<T>("floor_lag", t.floor_lag, t.x, b, v * in.planes * contact::kFloorLag);
  }
  if (groups.numel() > 0) {
    require(is_index(groups, t.x) && groups.numel() == contact::kGroupRows * b * bodies,
            "diffvbd::contact_rigid: expected groups int32 [scenes, 4, bodies]");
    in.groups = data<const int32_t>(groups);
  }
  in.capacity = contact::most_grouped(bodies);
  in.has_friction = 0 < friction_eps;
  in.friction_eps = in.has_friction ? friction_eps : 1;
  return in;
}

// Bodies of a group that the memory of its factor has room for. alone: only groups of one move.
inline int64_t room_of_groups(int64_t bodies, bool alone) {
  return alone ? std::min<int64_t>(bodies, 1) : contact::most_grouped(bodies);
}
// Of the factor, and of the groups.
inline std::vector<int64_t> matrix_shape(int64_t scenes, int64_t bodies, bool alone) {
  const int64_t six = contact::kUnknowns;
  if (bodies <= contact::kFew) return {scenes, six * bodies, six * bodies};
  return {scenes, bodies, six, six * room_of_groups(bodies, alone)};
}
// Inputs of a system in which the bodies of a mask move, or, if that is empty, all.
template <class T>
contact::RigidInputs<T> moving_inputs(contact::RigidInputs<T> in, const Tensor& moving, bool alone, const Tensor& x) {
  if (!in.together()) in.capacity = room_of_groups(in.bodies(), alone);
  const bool all = moving.dim() == 1 && moving.size(0) == 0;
  require(is_beside(moving, x, ScalarType::Bool) &&
              (all || (moving.dim() == 2 && moving.size(0) == in.scene.scenes && moving.size(1) == in.bodies())),
          "diffvbd::contact_rigid: expected moving bool [scenes, bodies], or [0]");
  if (all || moving.numel() == 0) return in;
  in.moving = data<const bool>(moving);
  return in;
}
inline std::vector<int64_t> groups_shape(int64_t scenes, int64_t bodies) {
  if (bodies <= contact::kFew) return {0};
  return {scenes, contact::kGroupRows, bodies};
}

template <class T>
void require_motion(const contact::RigidInputs<T>& in, const Tensor& centers, const Tensor& motion, const Tensor& x) {
  const int64_t rows = in.scene.scenes * in.bodies();
  require(is_beside(centers, x, ScalarType::Double) && centers.numel() == 3 * rows &&
              is_beside(motion, x, ScalarType::Double) && motion.numel() == contact::kUnknowns * rows,
          "diffvbd::contact_rigid_move: expected float64 centers [scenes, bodies, 3] and motion [scenes, bodies, 6]");
}

template <class T>
void require_of_bodies(const contact::RigidInputs<T>& in, const Tensor& t, const Tensor& x, int64_t each) {
  require(
      is_beside(t, x, ScalarType::Double) && t.numel() == each * in.scene.scenes * in.bodies(),
      "diffvbd::contact_rigid: expected float64 motion and solution [scenes, bodies, 6] and share [scenes, bodies]");
}

template <class T>
contact::VirtualMotions<T> virtual_motions(const contact::RigidInputs<T>& in, const Tensor& p, const Tensor& q,
                                           const Tensor& x) {
  const int64_t size = 3 * in.scene.scenes * in.gate.corners;
  require_like("p", p, x, size);
  require_like("q", q, x, size);
  return {data<const T>(p), data<const T>(q)};
}

// What contact_rigid_move returns; make(sizes, dtype).
struct RigidOutcomeTensors {
  Tensor x, share, moved, held, left;
  template <class T, class Make>
  RigidOutcomeTensors(const contact::RigidInputs<T>& in, const Tensor& like, const Make& make)
      : x(make({in.scene.scenes, in.scene.vertices, 3}, like.scalar_type())),
        share(make({in.scene.scenes, in.bodies()}, ScalarType::Double)),
        moved(make({in.scene.scenes, in.bodies()}, ScalarType::Bool)),
        held(make({in.scene.scenes, in.bodies()}, ScalarType::Bool)),
        left(make({in.scene.scenes, in.bodies()}, like.scalar_type())) {}
  template <class T>
  contact::RigidOutcome<T> view() const {
    return {data<double>(share), data<bool>(moved), data<bool>(held), data<T>(left)};
  }
  std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> all() const { return {x, share, moved, held, left}; }
};

// What contact_rigid_backward returns, and the rows of pairs; make(sizes, zeroed). pushes: bytes.
struct RigidWorkTensors {
  Tensor barrier, pushes, friction, by_x, by_p, by_q, since, by_kappa, lag_bar;
  template <class Make>
  RigidWorkTensors(const TouchingFields& f, const Tensor& pushes, Make&& make)
      : barrier(make({f.pairs.size(0), 4, contact::kWorkScalars}, false)),
        pushes(pushes),
        friction(make({f.lag.numel() > 0 ? f.lag_pairs.size(0) : 0, 4, contact::kWorkScalars}, false)),
        by_x(make({f.x.size(0), f.body.size(0), 3}, false)),
        by_p(make({f.x.size(0), f.body.size(0), 3}, false)),
        by_q(make({f.x.size(0), f.body.size(0), 3}, false)),
        since(make({friction.size(0) > 0 ? f.x.size(0) : 0, f.body.size(0), 3}, false)),
        by_kappa(make({f.pairs.size(0)}, true)),
        lag_bar(make({friction.size(0), contact::kLagScalars}, true)) {}
  template <class T>
  contact::RigidWork<T> view() const {
    return {data<T>(barrier), data<T>(by_kappa), data<uint8_t>(pushes), data<T>(friction),
            data<T>(lag_bar), barrier.size(0),   friction.size(0)};
  }
  template <class T>
  contact::PointWork<T> sums() const {
    return {data<T>(by_x), data<T>(by_p), data<T>(by_q), since.numel() > 0 ? data<T>(since) : nullptr};
  }
  std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> all() const {
    return {by_x, by_p, by_q, since, by_kappa, lag_bar};
  }
};

// What contact_rigid_reverse returns, and the memory that it works in; make(sizes, zeroed).
struct RigidReverseTensors {
  RigidWorkTensors pairs;
  Tensor p, q, way;
  RigidBars bars;
  Tensor floor_lag, collider, collider_prev;
  template <class T, class Make>
  RigidReverseTensors(const TouchingFields& f, const contact::RigidInputs<T>& in,
                      const std::vector<int64_t>& data_count, bool wants_data, const Tensor& pushes, Make&& make)
      : pairs(f, pushes, make),
        p(make({in.scene.scenes, in.gate.corners, 3}, true)),
        q(make({in.scene.scenes, in.gate.corners, 3}, true)),
        way(make({in.scene.scenes, in.scene.vertices, 3}, false)),
        bars(in.scene, data_count, true, wants_data,
             [&](const std::vector<int64_t>& sizes, bool) { return make(sizes, true); }),
        floor_lag(make({in.planes > 0 ? in.scene.scenes : 0, in.scene.vertices, in.planes, contact::kFloorLag}, true)),
        collider(make({in.scene.scenes, in.gate.corners - in.gate.vertices, 3}, true)),
        collider_prev(make({in.scene.scenes, in.gate.corners - in.gate.vertices, 3}, true)) {}
  template <class T>
  contact::CorrectionAdjoints<T> out() const {
    return {
        {nullptr, nullptr, data<T>(bars.x), data<T>(bars.x_prev), data<T>(bars.y), data<T>(bars.mass),
         bars.shared.numel() > 0 ? data<T>(bars.shared) : nullptr, bars.own.numel() > 0 ? data<T>(bars.own) : nullptr,
         static_cast<int32_t>(bars.shared.size(2)), static_cast<int32_t>(bars.own.size(2))},
        floor_lag.numel() > 0 ? data<T>(floor_lag) : nullptr,
        data<T>(collider),
        data<T>(collider_prev)};
  }
  // Of vertices x, x_prev, y, mass, data (two) and floor_lag, of colliders at the end and before, and of pairs by_kappa
  // and lag_bar.
  std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> all() const {
    return {bars.x,    bars.x_prev, bars.y,        bars.mass,      bars.shared,  bars.own,
            floor_lag, collider,    collider_prev, pairs.by_kappa, pairs.lag_bar};
  }
};

// What a reverse solves with, of a forward with these groups; `in` learns how it is stored.
template <class T>
void require_factor(contact::RigidInputs<T>& in, const Tensor& factor, const Tensor& x) {
  if (!in.together() && factor.dim() == 4) in.capacity = factor.size(3) / contact::kUnknowns;
  require(is_beside(factor, x, ScalarType::Double) && factor.numel() == in.scene.scenes * in.matrix_size() &&
              (in.scene.scenes == 0 || in.together() == (in.groups == nullptr)),
          "diffvbd::contact_rigid: expected factor and groups as contact_rigid_system returns them");
}

// The corrections of which contact_rigid_reverse is the adjoint, the first one first.
struct Corrections {
  const std::vector<Tensor>&x, &motion, &share, &factor, &groups;

  // Inputs of each. none: empty.
  template <class T>
  std::vector<contact::RigidInputs<T>> inputs(const TouchingFields& f, const std::vector<int64_t>& data_count,
                                              double time_step, double friction_eps, const Tensor& none) const {
    for (const auto* each : {&motion, &share, &factor, &groups}) {
      require(each->size() == x.size() && !x.empty(),
              "diffvbd::contact_rigid_reverse: expected as many at, motion, share, factor and groups, one at least");
    }
    std::vector<contact::RigidInputs<T>> out;
    for (size_t k = 0; k < x.size(); ++k) out.push_back(of<T>(k, f, data_count, time_step, friction_eps, none));
    return out;
  }

 private:
  template <class T>
  contact::RigidInputs<T> of(size_t k, const TouchingFields& f, const std::vector<int64_t>& data_count,
                             double time_step, double friction_eps, const Tensor& none) const {
    require_like("at", x[k], f.x, f.x.numel());
    auto in = touching_inputs<T>(f, data_count, time_step, friction_eps, none, groups[k]);
    in.scene.x = in.gate.x = data<const T>(x[k]);
    require_factor(in, factor[k], f.x);
    require_of_bodies(in, motion[k], f.x, contact::kUnknowns);
    require_of_bodies(in, share[k], f.x, 1);
    return in;
  }
};

}  // namespace diffvbd
