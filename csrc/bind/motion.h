// The tensors of motions and rooms of bodies, as the operators of all backends take them.
#pragma once

#include "../contact/trust_region.h"
#include "contact.h"
#include "detection.h"

namespace diffvbd {

// In the order of csrc/bind/schema.cpp; origin and fall may be empty.
struct MotionTensors {
  const Tensor &x, &origin, &mass, &move, &held, &order, &ptr;
};

template <class T>
contact::MotionInputs<T> motion_inputs(const MotionTensors& t) {
  require_positions(t.x);
  const int64_t b = t.x.size(0), v = t.x.size(1);
  require_like("move", t.move, t.x, 3 * b * v);
  require(is_beside(t.held, t.x, ScalarType::Bool) && t.held.numel() >= v && is_index(t.order, t.x) &&
              t.order.numel() == v && is_index(t.ptr, t.x) && t.ptr.numel() > 0,
          "diffvbd::contact_motion: expected held bool of the vertices, order [V] and ptr [bodies + 1] int32");
  require_countable(b * v, "diffvbd::contact_motion: too large, expected at most 2^31 vertices in all scenes");
  contact::MotionInputs<T> in{};
  in.x = data<const T>(t.x), in.move = data<const T>(t.move);
  in.origin = batched_or_null<T>("origin", t.origin, t.x, b, 3 * v);
  in.mass = batched<T>("mass", t.mass, t.x, b, v);
  in.pinned = data<const bool>(t.held);
  in.order = data<const int32_t>(t.order), in.ptr = data<const int32_t>(t.ptr);
  in.scenes = b;
  in.vertices = static_cast<int32_t>(v), in.bodies = static_cast<int32_t>(t.ptr.numel() - 1);
  return in;
}

template <class T>
contact::MotionInputs<T> motion_inputs(const MotionTensors& t, const Tensor& fall, const Tensor& held_bodies) {
  auto in = motion_inputs<T>(t);
  require(is_beside(held_bodies, t.x, ScalarType::Bool) && held_bodies.numel() == in.bodies,
          "diffvbd::contact_motion: expected held_bodies bool [bodies]");
  in.pinned_bodies = data<const bool>(held_bodies);
  if (fall.numel() > 0) {
    require_like("fall", fall, t.x, t.x.numel());
    in.gravity_move = data<const T>(fall);
  }
  return in;
}

// What coasting reads. It asks for no origin, which all vertices of a body have in common.
template <class T>
contact::MotionInputs<T> coast_inputs(const Tensor& x, const Tensor& mass, const Tensor& move, const Tensor& held,
                                      const Tensor& held_bodies, const Tensor& order, const Tensor& ptr, double chord) {
  require(chord != 0, "diffvbd::contact_coast: expected chord other than 0");
  return motion_inputs<T>({x, {}, mass, move, held, order, ptr}, {}, held_bodies);
}

// What rooms read beside motions and islands; floor may be empty.
struct RoomTensors {
  const Tensor &rigid, &ways, &sums, &floor, &most, &most_alone, &most_own, &least_own;
};

struct RoomNumbers {
  double dhat, share, least;
  bool self_contact;
};

// Planes of the floor [1 | B, 7 planes]; none where it is empty.
inline int64_t planes_of(const Tensor& floor) {
  const int64_t scalars = floor.dim() > 0 && floor.size(0) > 0 ? floor.numel() / floor.size(0) : 0;
  require(scalars % contact::kPlaneScalars == 0, "diffvbd::contact_rooms: expected floor [1 | B, 7 planes]");
  return scalars / contact::kPlaneScalars;
}

template <class T>
contact::RadiusInputs<T> room_inputs(const contact::MotionInputs<T>& motion, const contact::IslandInputs<T>& islands,
                                   const Tensor& x, const RoomTensors& t, const RoomNumbers& numbers) {
  const int64_t b = motion.scenes, bodies = motion.bodies;
  require_like("rigid", t.rigid, x, x.numel());
  require_like("ways", t.ways, x, contact::kDisplacements * b * bodies);
  require_like("sums", t.sums, x, 4 * b * bodies);
  for (const Tensor* room : {&t.most, &t.most_alone, &t.most_own, &t.least_own}) {
    require_like("rooms of bodies", *room, x, bodies);
  }
  contact::RadiusInputs<T> in{};
  in.motion = motion, in.islands = islands;
  in.rigid = data<const T>(t.rigid), in.displacements = data<const T>(t.ways), in.sums = data<const T>(t.sums);
  in.most = data<const T>(t.most), in.most_alone = data<const T>(t.most_alone);
  in.most_own = data<const T>(t.most_own), in.least_own = data<const T>(t.least_own);
  in.floor_planes = static_cast<int32_t>(planes_of(t.floor));
  in.floor = batched_or_null<T>("floor", t.floor, x, b, int64_t{in.floor_planes} * contact::kPlaneScalars);
  in.fraction = static_cast<T>(numbers.share), in.least = static_cast<T>(numbers.least);
  in.dhat = static_cast<T>(numbers.dhat), in.self_contact = numbers.self_contact;
  return in;
}

// Results, and what the passes work in: make(shape) allocates like x, integers(shape) int32.
struct RoomResults {
  Tensor island, room, own_room, over, work;

  template <class Make, class Integers>
  RoomResults(int64_t b, int64_t bodies, int64_t planes, const Make& make, const Integers& integers)
      : island(integers({b, bodies})),
        room(make({b, bodies + 1})),
        own_room(make({b, bodies + 1})),
        over(make({b, bodies})),
        work(make({b * (planes * contact::kPlaneScalars + 1 + 3 * bodies)})) {}
  template <class T>
  contact::RadiusWork<T> pointers(const contact::RadiusInputs<T>& in) const {
    const int64_t scenes = in.motion.scenes, rows = scenes * in.motion.bodies;
    contact::RadiusWork<T> out{};
    T* at = data<T>(work);
    const auto take = [&](T*& pointer, int64_t count) { pointer = at, at += count; };
    take(out.planes, scenes * in.planes() * contact::kPlaneScalars), take(out.pushed, scenes);
    take(out.stopped, rows), take(out.bent, rows), take(out.most, rows);
    out.island = data<int32_t>(island);
    out.trust_radius = data<T>(room), out.deformation_radius = data<T>(own_room), out.over = data<T>(over);
    return out;
  }
  std::tuple<Tensor, Tensor, Tensor, Tensor> tensors() const { return {island, room, own_room, over}; }
};

}  // namespace diffvbd
