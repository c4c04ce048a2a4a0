// The tensors of what contact leaves of an acceleration, as the operators of all backends take them.
#pragma once

#include <tuple>

#include "../contact/residual_acceleration.h"
#include "arguments.h"

namespace diffvbd {

// In the order of csrc/bind/schema.cpp; origin and planes may be empty.
struct UnsupportedTensors {
  const Tensor &x, &origin, &lift, &force, &mass, &planes, &held_bodies, &body_order, &body_ptr;
};

template <class T>
contact::ResidualInputs<T> unsupported_inputs(const UnsupportedTensors& t, double time_step) {
  contact::ResidualInputs<T> in{};
  require_positions(t.x);
  const int64_t b = t.x.size(0), v = t.x.size(1), bodies = t.body_ptr.numel() - 1;
  require(
      is_index(t.body_order, t.x) && is_index(t.body_ptr, t.x) && t.body_order.numel() == v && bodies >= 0 &&
          is_beside(t.held_bodies, t.x, ScalarType::Bool) && t.held_bodies.numel() == bodies,
      "diffvbd::contact_unsupported: expected body_order and body_ptr int32 and held_bodies bool of all bodies of x");
  in.scene.x = data<const T>(t.x);
  in.scene.x_prev = {in.scene.x, 3 * v};  // a floor's damping, which reads it, is not asked for
  in.scene.mass = batched<T>("mass", t.mass, t.x, b, v);
  in.scene.origin = batched_or_null<T>("origin", t.origin, t.x, b, 3 * v);
  in.scene.order = data<const int32_t>(t.body_order), in.scene.ptr = data<const int32_t>(t.body_ptr);
  in.scene.scenes = b;
  in.scene.vertices = static_cast<int32_t>(v), in.scene.bodies = static_cast<int32_t>(bodies);
  in.scene.time_step = time_step;
  in.pinned_bodies = data<const bool>(t.held_bodies);
  in.h2_a = batched<T>("lift", t.lift, t.x, b, 3 * v);
  require(t.force.dim() == 3 && t.force.size(0) == b && t.force.size(1) >= v && t.force.size(2) == 3 &&
              is_like(t.force, t.x),
          "diffvbd::contact_unsupported: expected force like x, [scenes, corner points, 3]");
  in.force = data<const T>(t.force), in.corners = t.force.size(1);
  if (t.planes.numel() > 0) {
    const int64_t scalars = t.planes.dim() > 0 ? t.planes.numel() / t.planes.size(0) : 0;
    require(scalars % contact::kPlaneScalars == 0, "diffvbd::contact_unsupported: expected planes [scenes, 7 planes]");
    in.floor = batched<T>("planes", t.planes, t.x, b, scalars);
    in.planes = static_cast<int32_t>(scalars / contact::kPlaneScalars);
  }
  return in;
}

// What contact_unsupported_backward returns: made by empty(sizes), or by zeros(sizes) where that is zero at first.
struct UnsupportedBars {
  Tensor x, lift, force, mass, planes;
  template <class T, class Empty, class Zeros>
  UnsupportedBars(const contact::ResidualInputs<T>& in, bool wants_planes, const Empty& empty, Zeros&& zeros)
      : x(empty({in.planes > 0 ? in.scene.scenes : 0, in.scene.vertices, 3})),
        lift(empty({in.scene.scenes, in.scene.vertices, 3})),
        force(zeros({in.scene.scenes, in.corners, 3})),
        mass(empty({in.scene.scenes, in.scene.vertices})),
        planes(
            zeros({wants_planes ? in.scene.scenes : 0, in.scene.bodies, int64_t{in.planes} * contact::kPlaneScalars})) {
  }
  template <class T>
  contact::ResidualAdjoints<T> pointers() const {
    const auto or_null = [](const Tensor& t) { return t.numel() > 0 ? data<T>(t) : nullptr; };
    return {or_null(x), data<T>(lift), data<T>(force), data<T>(mass), or_null(planes)};
  }
  std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> tensors() const { return {x, lift, force, mass, planes}; }
};

}  // namespace diffvbd
