// The tensors of the beginning of a step, as the operators of all backends take them.
#pragma once

#include <tuple>
#include <vector>

#include "../subspace/begin.h"
#include "material.h"
#include "rigid.h"

namespace diffvbd {

// Before anything is read of them: the shape of x, and the lists of the other bodies.
inline void require_states(const BeginFields& f) {
  require_positions(f.x);
  const auto agree = [&](const Tensor& ptr, const Tensor& tet_ptr) {
    return is_index(ptr, f.x) && is_index(tet_ptr, f.x) && ptr.numel() > 0 && tet_ptr.numel() == ptr.numel();
  };
  require(agree(f.ptr, f.tet_ptr) && agree(f.other_ptr, f.other_tet_ptr),
          "diffvbd::begin: expected ptr, tet_ptr, other_ptr and other_tet_ptr int32 [bodies + 1]");
}
inline int64_t corrected_bodies(const BeginFields& f) { return f.ptr.numel() - 1; }
inline int32_t other_bodies(const BeginFields& f) { return static_cast<int32_t>(f.other_ptr.numel() - 1); }
struct BeginSettings {
  const std::vector<int64_t>& data_count;
  double time_step, filter_eta, chord;
  int64_t from;
  bool filters;
};

// x_start and y: [B, V, 3] that the bodies read and the kernels write.
template <class T>
start::Inputs<T> begin_inputs(const BeginFields& t, const BeginSettings& q, const Tensor& x_start, const Tensor& y,
                              const Tensor& falls, const Tensor& alone) {
  const int32_t others = other_bodies(t);
  start::Inputs<T> in{};
  in.bodies = rigid_inputs<T>({x_start, t.x, y, t.mass, t.energy_data, t.origin, t.order, t.ptr, t.spread, t.other},
                              q.data_count, q.time_step);
  const int64_t b = in.bodies.scenes, v = in.bodies.vertices;
  in.x = in.bodies.x_prev;
  in.v = batched<T>("v", t.v, t.x, b, 3 * v);
  in.acceleration = batched<T>("acceleration", t.acceleration, t.x, b, 3 * v, 3);
  in.prescribed = batched_or_null<T>("prescribed", t.prescribed, t.x, b, 3 * v);
  require(is_beside(t.pinned, t.x, ScalarType::Bool) && t.pinned.numel() == v,
          "diffvbd::begin: expected pinned bool [V]");
  require(q.from >= start::kInertia && q.from <= start::kLower, "diffvbd::begin: expected start 0, 1 or 2");
  require(q.from != start::kLower || (is_beside(falls, t.x, ScalarType::Byte) && falls.numel() == b * others),
          "diffvbd::begin: expected falls [scenes, bodies]");
  require(alone.numel() == 0 ||
              (q.filters && is_beside(alone, t.x, ScalarType::Byte) && alone.numel() == b * corrected_bodies(t)),
          "diffvbd::begin: expected alone [scenes, bodies] with filters, or empty");
  require(!q.filters || (in.bodies.data_count[0] > 0 &&
                         in.bodies.data_count[0] <= FloorStart::kMostPlanes * FloorBarrier::stride),
          "diffvbd::begin: expected 1 to 8 planes");
  in.pinned = data<const bool>(t.pinned);
  in.from_predictor = data<const uint8_t>(falls);
  in.alone = alone.numel() > 0 ? data<const uint8_t>(alone) : nullptr;
  in.others = others;
  in.from = static_cast<int>(q.from);
  in.some_alone = t.order.numel() < v;
  in.filters = q.filters;
  require(q.chord != 0, "diffvbd::begin: expected chord other than 0");
  in.lookback = q.chord;
  in.parameters.time_step = T(q.time_step);
  in.parameters.filter_eta = T(q.filter_eta);
  return in;
}

// Two states of the bodies that are corrected, or of the others.
template <class T>
start::Candidates<T> candidates(const BeginFields& t, const BeginSettings& q, bool corrected, const Tensor& x_start,
                                const Tensor& other, const Tensor& y) {
  start::Candidates<T> in{};
  const Tensor &order = corrected ? t.order : t.other_order, &ptr = corrected ? t.ptr : t.other_ptr;
  const Tensor &listed = corrected ? t.tets : t.other_tets, &tet_ptr = corrected ? t.tet_ptr : t.other_tet_ptr;
  const RigidFields bodies{x_start, t.x, y, t.mass, t.energy_data, t.origin, order, ptr, t.spread, t.other};
  in.bodies = rigid_inputs<T>(bodies, q.data_count, q.time_step, false);
  const int64_t b = in.bodies.scenes, tets = t.rest.dim() == 3 ? t.rest.size(1) : 0;
  require(is_index(listed, t.x) && listed.dim() == 2 && listed.size(1) == 5,
          "diffvbd::begin: expected tets and other_tets int32 [listed, 5]");
  require(t.rest.numel() == 0 || (t.rest.dim() == 3 && t.rest.size(2) == kRestScalars),
          "diffvbd::begin: expected rest [scenes, tets, 7], or empty");
  in.other = data<const T>(other);
  in.tets = data<const int32_t>(listed);
  in.tet_ptr = data<const int32_t>(tet_ptr);
  if (tets > 0) {
    const auto material = material_of(t);
    for (int m = 0; m < kMaterialScalars; ++m) {
      in.material[m] = batched<T>(kMaterialNames[m], *material[m], t.x, b, tets, 1);
    }
    in.rest = batched<T>("rest", t.rest, t.x, b, kRestScalars * tets);
  }
  return in;
}

// The adjoints of begin; make(shape, zeroed) allocates. wants: acceleration, prescribed, data.
struct BeginBars {
  Tensor x, v, acceleration, prescribed, mass, shared, own, planes, x_prev;

  template <class T, class Make>
  BeginBars(const BeginFields& t, const start::Inputs<T>& in, const std::vector<bool>& wants, const Make& make) {
    require(wants.size() == 3, "diffvbd::begin_backward: expected 3 wishes");
    const int64_t b = in.bodies.scenes, v_ = in.bodies.vertices;
    int64_t of_scene = 0, of_vertex = 0;
    for (int k = 0; k < kVertexEnergies; ++k) {
      (is_per_vertex(k, VertexEnergies{}) ? of_vertex : of_scene) += in.bodies.data_count[k];
    }
    const auto wanted = [&](bool wish, const std::vector<int64_t>& shape) {
      return make(wish ? shape : std::vector<int64_t>{0}, false);
    };
    x = make({b, v_, 3}, false), v = make({b, v_, 3}, false);
    acceleration = wanted(wants[0], {b, v_, 3}), prescribed = wanted(wants[1], {b, v_, 3});
    mass = make({b, v_}, t.order.numel() < v_);
    shared = make({b, wants[2] ? in.bodies.bodies : 0, of_scene}, true);
    own = make({b, wants[2] ? v_ : 0, of_vertex}, true);
    planes = make({b, wants[2] && in.filters ? v_ : 0, in.bodies.data_count[0]}, true);
    x_prev = wanted(in.bodies.data.data != nullptr && t.order.numel() > 0, {b, v_, 3});
  }
  template <class T>
  start::Adjoints<T> pointers(const Tensor& x_start_bar, const Tensor& y_bar) const {
    require_like("x_start_bar", x_start_bar, x, x.numel());
    require_like("y_bar", y_bar, x, x.numel());
    const auto or_null = [](const Tensor& t) { return t.numel() > 0 ? data<T>(t) : nullptr; };
    start::Adjoints<T> a{};
    a.x_start = data<const T>(x_start_bar), a.y = data<const T>(y_bar);
    a.x = data<T>(x), a.v = data<T>(v), a.mass = data<T>(mass);
    a.acceleration = or_null(acceleration), a.prescribed = or_null(prescribed), a.planes = or_null(planes);
    a.shared = or_null(shared), a.own = or_null(own), a.x_prev = or_null(x_prev);
    a.shared_count = static_cast<int32_t>(shared.size(2)), a.own_count = static_cast<int32_t>(own.size(2));
    return a;
  }
  std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> tensors() const {
    return {x, v, acceleration, prescribed, mass, shared, own, planes};
  }
};

}  // namespace diffvbd
