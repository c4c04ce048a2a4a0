// The tensors of a rigid correction, as the operators of all backends take them.
#pragma once

#include <tuple>
#include <vector>

#include "../subspace/rigid.h"
#include "arguments.h"
#include "fields.h"

namespace diffvbd {

// energy_data and origin may be empty. Of bodies that are not corrected spread is not looked at.
template <class T>
rigid::Inputs<T> rigid_inputs(const RigidFields& t, const std::vector<int64_t>& data_count, double time_step,
                              bool corrected = true) {
  require_positions(t.x);
  const int64_t b = t.x.size(0), v = t.x.size(1), bodies = t.ptr.numel() - 1;
  require(is_index(t.order, t.x) && is_index(t.ptr, t.x) && bodies >= 0 && t.order.numel() <= v,
          "diffvbd::rigid: expected order and ptr int32 of one list of bodies");
  if (corrected) {
    require(is_beside(t.spread, t.x, ScalarType::Double) && t.spread.numel() == bodies,
            "diffvbd::rigid: expected spread float64 [bodies]");
  }
  require(time_step > 0, "diffvbd::rigid: expected time_step > 0");
  rigid::Inputs<T> in{};
  in.x = data<const T>(t.x);
  in.x_prev = batched<T>("x_prev", t.x_prev, t.x, b, 3 * v);
  in.y = batched<T>("y", t.y, t.x, b, 3 * v);
  in.mass = batched<T>("mass", t.mass, t.x, b, v);
  in.origin = batched_or_null<T>("origin", t.origin, t.x, b, 3 * v);
  in.data = batched<T>("energy_data", t.energy_data, t.x, b, energy_data_size(data_count, v));
  in.order = data<const int32_t>(t.order);
  in.ptr = data<const int32_t>(t.ptr);
  in.spread = corrected ? data<const double>(t.spread) : nullptr;
  require(is_index(t.other, t.x) && t.other.numel() == v, "diffvbd::rigid: expected other int32 [V]");
  in.other = data<const int32_t>(t.other);
  in.scenes = b;
  in.vertices = static_cast<int32_t>(v);
  in.bodies = static_cast<int32_t>(bodies);
  in.time_step = time_step;
  int64_t start = 0;
  for (int k = 0; k < kVertexEnergies; ++k) {
    in.data_start[k] = start;
    in.data_count[k] = static_cast<int32_t>(data_count[k]);
    start += data_count[k] * (is_per_vertex(k, VertexEnergies{}) ? v : 1);
  }
  return in;
}

// The adjoints of a correction; make(shape, zeroed) allocates.
struct RigidBars {
  Tensor x, x_prev, y, mass, shared, own;

  template <class T, class Make>
  RigidBars(const rigid::Inputs<T>& in, const std::vector<int64_t>& data_count, bool has_velocity, bool wants_data,
            const Make& make) {
    const int64_t b = in.scenes, v = in.vertices;
    int64_t of_scene = 0, of_vertex = 0;
    for (int k = 0; k < kVertexEnergies; ++k) {
      (is_per_vertex(k, VertexEnergies{}) ? of_vertex : of_scene) += data_count[k];
    }
    x = make({b, v, 3}, false), y = make({b, v, 3}, false), mass = make({b, v}, false);
    x_prev = in.data.data || has_velocity ? make({b, v, 3}, false) : make({0}, false);
    shared = make({b, wants_data ? in.bodies : 0, of_scene}, true);
    own = make({b, wants_data ? v : 0, of_vertex}, true);
  }
  template <class T>
  rigid::Adjoints<T> pointers(const Tensor& end, const Tensor& velocity) const {
    require_like("x_bar", end, x, x.numel());
    if (velocity.numel() > 0) require_like("v_bar", velocity, x, x.numel());
    const auto or_null = [](const Tensor& t) { return t.numel() > 0 ? data<T>(t) : nullptr; };
    return {data<const T>(end),
            velocity.numel() > 0 ? data<const T>(velocity) : nullptr,
            data<T>(x),
            or_null(x_prev),
            data<T>(y),
            data<T>(mass),
            or_null(shared),
            or_null(own),
            static_cast<int32_t>(shared.size(2)),
            static_cast<int32_t>(own.size(2))};
  }
  std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> tensors() const {
    return {x, x_prev, y, mass, shared, own};
  }
};

}  // namespace diffvbd
