// The tensors of the start of a part, as the operators of all backends take them.
#pragma once

#include "../contact/start.h"
#include "../contact/translation.h"
#include "contact.h"

namespace diffvbd {

// In the order of csrc/bind/schema.cpp; planes, lowest and origin may be empty.
struct TranslationTensors {
  const Tensor &move, &mass, &x, &origin, &planes, &held, &body, &body_order, &body_ptr, &island, &lowest;
};
struct StartTensors {
  const Tensor &x, &move, &goal, &u, &near, &origin, &planes, &held, &body;
};

inline void require_vectors(const Tensor& t, const Tensor& x) {
  require(t.is_contiguous() && t.dim() == 3 && t.size(0) == x.size(0) && t.size(1) == x.size(1) && t.size(2) == 3 &&
              t.scalar_type() == x.scalar_type() && t.get_device_index() == x.get_device_index(),
          "diffvbd: expected contiguous vectors like x [scenes, vertices, 3]");
}

template <class T>
contact::TranslationInputs<T> translation_inputs(const TranslationTensors& t) {
  require_vectors(t.move, t.x);
  require_vectors(t.x, t.move);
  const int64_t b = t.x.size(0), v = t.x.size(1), bodies = t.body_ptr.numel() - 1;
  require(t.held.scalar_type() == ScalarType::Bool && t.held.numel() >= v && t.body.numel() >= v &&
              t.island.numel() == b * bodies && t.body_order.numel() == v,
          "diffvbd::contact_translation: bad arguments");
  contact::TranslationInputs<T> in{};
  if (t.planes.numel() > 0) {
    in.floor = lowest_inputs<T>(t.x, t.origin, t.planes, t.body_order, t.body_ptr, t.island);
    require(in.floor.num_planes <= contact::kMostPlanes && t.lowest.numel() == b * bodies * in.floor.num_planes,
            "diffvbd::contact_translation: expected the lowest vertices of at most 8 planes");
    in.lowest = data<const int32_t>(t.lowest);
  }
  in.move = data<const T>(t.move);
  const auto mass = batched<T>(t.mass, t.x, b, v);
  in.mass = mass.data;
  in.mass_scene = mass.scene;
  in.held = data<const bool>(t.held);
  in.body_order = data<const int32_t>(t.body_order);
  in.body_ptr = data<const int32_t>(t.body_ptr);
  in.island = data<const int32_t>(t.island);
  in.body = data<const int32_t>(t.body);
  in.scenes = b;
  in.vertices = static_cast<int32_t>(v);
  in.bodies = static_cast<int32_t>(bodies);
  return in;
}

template <class T>
contact::StartInputs<T> start_inputs(const StartTensors& t, double gamma, double cap, double filter_eta) {
  require_vectors(t.move, t.x);
  require_vectors(t.goal, t.x);
  const int64_t b = t.x.size(0), v = t.x.size(1);
  require(t.u.dim() == 3 && t.u.is_contiguous() && t.near.dim() == 3 && t.near.is_contiguous() &&
              t.near.size(2) == contact::kNearValues && t.held.numel() >= v && t.body.numel() >= v,
          "diffvbd::contact_start: bad arguments");
  contact::StartInputs<T> in{};
  in.x = data<const T>(t.x);
  in.move = data<const T>(t.move);
  in.goal = data<const T>(t.goal);
  in.u = data<const T>(t.u);
  in.near = data<const T>(t.near);
  in.origin = batched<T>(t.origin, t.x, b, 3 * v);
  if (t.planes.numel() > 0) {
    in.floor_scalars = static_cast<int32_t>(t.planes.numel() / t.planes.size(0));
    in.floor = batched<T>(t.planes, t.x, b, in.floor_scalars);
  }
  in.pinned = data<const bool>(t.held);
  in.body = data<const int32_t>(t.body);
  in.scenes = b;
  in.corners = t.near.size(1);
  in.vertices = static_cast<int32_t>(v);
  in.bodies = static_cast<int32_t>(t.u.size(1));
  in.gamma = static_cast<T>(gamma);
  in.cap = static_cast<T>(cap);
  in.parameters.filter_eta = static_cast<T>(filter_eta);
  in.parameters.time_step = T(1);  // a filter does not read it
  return in;
}

}  // namespace diffvbd
