// The tensors of the rooms of sweeps, as the operators of all backends take them.
#pragma once

#include "../contact/trust_region.h"
#include "arguments.h"

namespace diffvbd {

// In the order of csrc/bind/schema.cpp; own_center and own_room may be empty.
struct SweepRoomTensors {
  const Tensor &x, &start, &begin, &move, &fall, &apart, &stretched, &center, &room, &own_center, &own_room, &held,
      &body_order, &body_ptr;
};

template <class T>
contact::SweepRadiusInputs<T> sweep_room_inputs(const SweepRoomTensors& t, double more, double least) {
  require_positions(t.x);
  const int64_t b = t.x.size(0), v = t.x.size(1), bodies = t.body_ptr.numel() - 1;
  require(is_index(t.body_order, t.x) && is_index(t.body_ptr, t.x) && t.body_order.numel() == v && bodies >= 0 &&
              is_beside(t.held, t.x, ScalarType::Bool) && t.held.numel() >= v,
          "diffvbd::contact_sweep_rooms: expected body_order and body_ptr int32 and held bool of all vertices of x");
  contact::SweepRadiusInputs<T> in{};
  const auto of_vertices = [&](const char* name, const Tensor& given, int64_t each) {
    require_like(name, given, t.x, each * b * v);
    return data<const T>(given);
  };
  in.x = data<const T>(t.x), in.start = of_vertices("start", t.start, 3), in.begin = of_vertices("begin", t.begin, 3);
  in.move = of_vertices("move", t.move, 3), in.gravity_move = of_vertices("fall", t.fall, 3);
  require_like("apart", t.apart, t.x, b * bodies);
  require_like("stretched", t.stretched, t.x, b * bodies);
  in.apart = data<const T>(t.apart), in.stretched = data<const T>(t.stretched);
  in.center = of_vertices("center", t.center, 3), in.trust_radius = of_vertices("room", t.room, 1);
  if (t.own_room.numel() > 0) {
    in.deformation_center = of_vertices("own_center", t.own_center, 3), in.deformation_radius = of_vertices("own_room", t.own_room, 1);
  }
  in.pinned = data<const bool>(t.held);
  in.order = data<const int32_t>(t.body_order), in.ptr = data<const int32_t>(t.body_ptr);
  in.scenes = b, in.vertices = v, in.bodies = bodies;
  in.more = static_cast<T>(more), in.least = static_cast<T>(least);
  return in;
}

}  // namespace diffvbd
