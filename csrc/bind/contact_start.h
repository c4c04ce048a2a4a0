// The tensors of the start of a part, as the operators of all backends take them.
#pragma once

#include <tuple>

#include "../contact/advance.h"
#include "../contact/pair_list.h"
#include "../contact/islands.h"
#include "contact_part.h"

namespace diffvbd {

// In the order of csrc/bind/schema.cpp; planes, lowest and origin may be empty.
struct TranslationTensors {
  const Tensor &move, &mass, &x, &origin, &planes, &held, &body, &body_order, &body_ptr, &island, &lowest;
};

inline void require_vectors(const Tensor& t, const Tensor& x) {
  require(t.dim() == 3 && x.dim() == 3 && t.size(0) == x.size(0) && t.size(1) == x.size(1) && t.size(2) == 3 &&
              is_like(t, x),
          "diffvbd: expected contiguous vectors like x [scenes, vertices, 3]");
}

template <class T>
contact::TranslationInputs<T> translation_inputs(const TranslationTensors& t) {
  require_vectors(t.move, t.x);
  require_vectors(t.x, t.move);
  const int64_t b = t.x.size(0), v = t.x.size(1), bodies = t.body_ptr.numel() - 1;
  require_of_vertices(t.held, t.body, t.x);
  require(is_index(t.island, t.x) && is_index(t.body_order, t.x) && is_index(t.body_ptr, t.x) && bodies >= 0 &&
              t.island.numel() == b * bodies && t.body_order.numel() == v,
          "diffvbd::contact_translation: expected bodies of x and their islands");
  contact::TranslationInputs<T> in{};
  if (t.planes.numel() > 0) {
    in.floor = lowest_inputs<T>(t.x, t.origin, t.planes, t.body_order, t.body_ptr, t.island);
    require(in.floor.num_planes <= contact::kMostPlanes && is_index(t.lowest, t.x) &&
                t.lowest.numel() == b * bodies * in.floor.num_planes,
            "diffvbd::contact_translation: expected the lowest vertices of at most 8 planes");
    in.support_vertex = data<const int32_t>(t.lowest);
  }
  in.move = data<const T>(t.move);
  const auto mass = batched<T>("mass", t.mass, t.x, b, v);
  in.mass = mass.data;
  in.mass_scene = mass.scene;
  in.pinned = data<const bool>(t.held);
  in.body_order = data<const int32_t>(t.body_order);
  in.body_ptr = data<const int32_t>(t.body_ptr);
  in.island = data<const int32_t>(t.island);
  in.body = data<const int32_t>(t.body);
  in.scenes = b;
  in.vertices = static_cast<int32_t>(v);
  in.bodies = static_cast<int32_t>(bodies);
  return in;
}

struct AdvanceTensors {
  const Tensor &x, &move, &u, &center, &origin, &collider, &collider_next, &held, &body, &room, &own_center, &own_room,
      &pairs, &constants, &ptr, &entry;
};

template <class T>
contact::AdvanceInputs<T> advance_inputs(const AdvanceTensors& t) {
  require_vectors(t.x, t.move);
  require_vectors(t.move, t.x);
  require_vectors(t.center, t.x);
  require_of_vertices(t.held, t.body, t.x);
  const int64_t b = t.x.size(0), v = t.x.size(1), colliders = t.collider.dim() == 3 ? t.collider.size(1) : 0;
  require(t.u.dim() == 3 && is_like(t.u, t.x) && t.u.size(0) == b && t.u.size(2) == 3,
          "diffvbd::contact_advance: expected u like x, [scenes, bodies, 3]");
  require(t.held.numel() == v + colliders && t.body.numel() == v + colliders,
          "diffvbd::contact_advance: expected held and body of all corner points");
  contact::AdvanceInputs<T> in{};
  in.x = data<const T>(t.x), in.move = data<const T>(t.move), in.u = data<const T>(t.u);
  in.center = data<const T>(t.center);
  in.origin = batched_or_null<T>("origin", t.origin, t.x, b, 3 * v).data;
  require_like("collider", t.collider, t.x, b * colliders * 3);
  require_like("collider_next", t.collider_next, t.x, b * colliders * 3);
  require_like("room", t.room, t.x, b * v);
  in.collider = data<const T>(t.collider), in.collider_next = data<const T>(t.collider_next);
  in.pinned = data<const bool>(t.held), in.body = data<const int32_t>(t.body), in.trust_radius = data<const T>(t.room);
  if (t.own_room.numel() > 0) {
    require_vectors(t.own_center, t.x);
    require_like("own_room", t.own_room, t.x, b * v);
    in.deformation_center = data<const T>(t.own_center), in.deformation_radius = data<const T>(t.own_room);
  }
  in.listed = pair_list(t.pairs, t.ptr, t.entry, t.x, v + colliders);
  require_like("constants", t.constants, t.x, t.pairs.size(0) * contact::kConstants);
  in.constants = data<const T>(t.constants);
  in.scenes = b;
  in.vertices = static_cast<int32_t>(v), in.corners = static_cast<int32_t>(v + colliders);
  in.bodies = static_cast<int32_t>(t.u.size(1));
  return in;
}

template <class T>
contact::GapInputs<T> narrow_inputs(const Tensor& x, const Tensor& origin, const Tensor& collider,
                                       const Tensor& room, const Tensor& pairs, const Tensor& constants,
                                       const Tensor& ptr) {
  require_vectors(x, x);
  const int64_t b = x.size(0), v = x.size(1), colliders = collider.dim() == 3 ? collider.size(1) : 0;
  require_like("collider", collider, x, b * colliders * 3);
  require_like("room", room, x, b * v);
  require(pairs.dim() == 2 && pairs.size(1) == contact::kPairRow && is_index(pairs, x) && is_index(ptr, x) &&
              ptr.numel() == b * (v + colliders) + 1,
          "diffvbd::contact_narrow: expected pairs and ptr made by contact_detect for this batch");
  require_like("constants", constants, x, pairs.size(0) * contact::kConstants);
  contact::GapInputs<T> in{};
  in.x = data<const T>(x), in.collider = data<const T>(collider), in.trust_radius = data<const T>(room);
  in.origin = batched_or_null<T>("origin", origin, x, b, 3 * v).data;
  in.pairs = data<const int32_t>(pairs), in.constants = data<const T>(constants);
  in.vertices = static_cast<int32_t>(v), in.colliders = static_cast<int32_t>(colliders);
  return in;
}

// The lists of a call of contact_keep, in room for `capacity` pairs, where make(shape, dtype) allocates.
struct KeptLists {
  Tensor rows, pairs, constants, ptr, entry;

  template <class Make>
  KeptLists(const Tensor& ptr_of_all, ScalarType scalar, int64_t capacity, const Make& make)
      : rows(make({capacity}, ScalarType::Long)),
        pairs(make({capacity, contact::kPairRow}, ScalarType::Int)),
        constants(make({capacity, contact::kConstants}, scalar)),
        ptr(make({ptr_of_all.numel()}, ScalarType::Int)),
        entry(make({4 * capacity}, ScalarType::Int)) {}
  template <class T>
  contact::CompactList<T> pointers() const {
    return {data<int64_t>(rows),  data<int32_t>(pairs), data<int32_t>(ptr),
            data<int32_t>(entry), data<T>(constants),   pairs.size(0)};
  }
  std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> tensors() const { return {rows, pairs, constants, ptr, entry}; }
};

template <class T>
contact::CompactInputs<T> keep_inputs(const Tensor& keep, const Tensor& pairs, const Tensor& constants, const Tensor& ptr,
                                   const Tensor& entry) {
  require(pairs.dim() == 2 && pairs.size(1) == contact::kPairRow && is_index(pairs, constants) &&
              is_index(ptr, constants) && is_index(entry, constants) && ptr.numel() > 0 &&
              entry.numel() == 4 * pairs.size(0),
          "diffvbd::contact_keep: expected pairs made by contact_detect");
  require(is_beside(keep, constants, ScalarType::Bool) && keep.numel() == pairs.size(0),
          "diffvbd::contact_keep: expected keep bool [pairs]");
  require_like("constants", constants, constants, pairs.size(0) * contact::kConstants);
  return {data<const bool>(keep),   data<const int32_t>(pairs),
          data<const int32_t>(ptr), data<const int32_t>(entry),
          data<const T>(constants), pairs.size(0),
          ptr.numel() - 1};
}

}  // namespace diffvbd
