// Bodies as the entries of rigid motions take them, and the adjoints of these.
#pragma once

#include <vector>

#include "../subspace/rigid.h"
#include "backend.h"

namespace diffvbd {

// energy_data and origin may be empty. Of bodies that are not corrected spread is not looked at.
template <class T>
rigid::Inputs<T> rigid_inputs(const RigidFields& t, Ints data_count, double time_step, bool corrected = true) {
  const Reader<T> read(t.x);
  require(time_step > 0, "diffvbd::rigid: expected time_step > 0");
  require(t.order.numel() <= read.v, "diffvbd::rigid: expected order of no more than all vertices");
  rigid::Inputs<T> in{};
  in.x = read.positions();
  in.x_prev = read.batch("x_prev", t.x_prev, 3 * read.v);
  in.y = read.batch("y", t.y, 3 * read.v);
  in.mass = read.batch("mass", t.mass, read.v);
  in.origin = read.batch_or_null("origin", t.origin, 3 * read.v);
  in.data = read.batch("energy_data", t.energy_data, energy_data_size(data_count, read.v));
  in.order = read.index("order", t.order, t.order.numel()), in.ptr = read.index("ptr", t.ptr, 1, true);
  in.scenes = read.b;
  in.vertices = static_cast<int32_t>(read.v), in.bodies = static_cast<int32_t>(t.ptr.numel() - 1);
  in.spread = corrected ? read.doubles("spread", t.spread, in.bodies) : nullptr;
  in.other = read.index("other", t.other, read.v);
  in.time_step = time_step;
  int64_t start = 0;
  for (int k = 0; k < kVertexEnergies; ++k) {
    in.data_start[k] = start;
    in.data_count[k] = static_cast<int32_t>(data_count[k]);
    start += data_count[k] * (is_per_vertex(k, VertexEnergies{}) ? read.v : 1);
  }
  return in;
}

// The adjoints of a correction.
struct RigidBars {
  Tensor x, x_prev, y, mass, shared, own;

  template <class T, class Make>
  RigidBars(const rigid::Inputs<T>& in, bool has_velocity, bool wants_data, const Make& make) {
    const int64_t b = in.scenes, v = in.vertices;
    const auto [of_scene, of_vertex] = scalars_of_data(in.data_count);
    x = make({b, v, 3}, false), y = make({b, v, 3}, false), mass = make({b, v}, false);
    x_prev = in.data.data || has_velocity ? make({b, v, 3}, false) : make({0}, false);
    shared = make({b, wants_data ? in.bodies : 0, of_scene}, true);
    own = make({b, wants_data ? v : 0, of_vertex}, true);
  }
  // end and velocity may be null
  template <class T>
  rigid::Adjoints<T> pointers(const T* end, const T* velocity) const {
    return {end,
            velocity,
            data<T>(x),
            data_or_null<T>(x_prev),
            data<T>(y),
            data<T>(mass),
            data_or_null<T>(shared),
            data_or_null<T>(own),
            static_cast<int32_t>(shared.size(2)),
            static_cast<int32_t>(own.size(2))};
  }
};

}  // namespace diffvbd
