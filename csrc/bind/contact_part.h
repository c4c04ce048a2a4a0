// The operators of the start of a part that go over bodies or vertices once, for all backends. A Place allocates and
// calls `act` for all bodies (with a team for each) or vertices of all scenes.
#pragma once

#include <tuple>
#include <vector>

#include "../contact/above_floor.h"
#include "../contact/start.h"
#include "contact.h"

namespace diffvbd {

// Of vertices, and then perhaps of colliders: bool, int32.
inline void require_of_vertices(const Tensor& held, const Tensor& body, const Tensor& x) {
  require(is_beside(held, x, ScalarType::Bool) && is_index(body, x) && held.numel() >= x.size(1) &&
              body.numel() >= x.size(1),
          "diffvbd: expected held bool and body int32 of at least the vertices");
}

template <class T>
const T* like_x(const char* name, const Tensor& t, const Tensor& x, int64_t numel) {
  require_like(name, t, x, numel);
  return data<const T>(t);
}
template <class T>
const T* vectors(const char* name, const Tensor& t, const Tensor& x) {
  return like_x<T>(name, t, x, x.numel());
}
template <class D>
const D* of_dtype(const char* name, const Tensor& t, ScalarType dtype, const Tensor& x, int64_t numel) {
  if (!is_beside(t, x, dtype) || t.numel() != numel) {
    refuse(name, std::to_string(numel) + " contiguous " + torch::headeronly::toString(dtype) + " beside x", t);
  }
  return data<const D>(t);
}

// All vertices by body.
template <class T>
rigid::Inputs<T> body_inputs(const Tensor& x, const Tensor& order, const Tensor& ptr) {
  require_positions(x);
  require(x.is_contiguous() && is_index(order, x) && is_index(ptr, x) && order.numel() == x.size(1) && ptr.numel() > 0,
          "diffvbd: expected body_order and body_ptr int32 of the bodies of x");
  rigid::Inputs<T> in{};
  in.x = data<const T>(x);
  in.order = data<const int32_t>(order), in.ptr = data<const int32_t>(ptr);
  in.scenes = x.size(0);
  in.vertices = static_cast<int32_t>(x.size(1)), in.bodies = static_cast<int32_t>(ptr.numel() - 1);
  return in;
}

template <class T>
Batched<const T> floor_of(const Tensor& planes, const Tensor& x, int32_t& scalars) {
  scalars = 0;
  if (planes.numel() == 0) return {};
  const int64_t given = planes.dim() > 0 ? planes.numel() / planes.size(0) : 0;
  require(given > 0 && given % contact::kPlaneScalars == 0 && given <= std::numeric_limits<int32_t>::max(),
          "diffvbd: expected planes [scenes, 7 planes]");
  scalars = static_cast<int32_t>(given);
  return batched<T>("planes", planes, x, x.size(0), given);
}

template <class T>
contact::AboveFloorInputs<T> above_floor_inputs(const Tensor& x, const Tensor& u, const Tensor& way,
                                                const Tensor& planes, const Tensor& origin, const Tensor& held,
                                                const Tensor& order, const Tensor& ptr) {
  contact::AboveFloorInputs<T> in{};
  in.scene = body_inputs<T>(x, order, ptr);
  in.scene.origin = batched_or_null<T>("origin", origin, x, x.size(0), 3 * x.size(1));
  in.displacement = vectors<T>("way", way, x);
  if (u.numel() > 0) in.u = like_x<T>("u", u, x, 3 * in.scene.scenes * in.scene.bodies);
  in.floor = floor_of<T>(planes, x, in.planes);
  in.planes /= contact::kPlaneScalars;
  require(is_beside(held, x, ScalarType::Bool) && held.numel() >= x.size(1),
          "diffvbd::contact_above_floor: expected held bool of at least the vertices");
  in.pinned = data<const bool>(held);
  return in;
}

// Which vertices are held, bodies of which one is, the body of each vertex, and vertices by body.
struct IndexTensors {
  const Tensor &held, &held_bodies, &body, &order, &ptr;
};
template <class T>
contact::StartInputs<T> start_inputs(const Tensor& x, const IndexTensors& index) {
  contact::StartInputs<T> in{};
  in.scene = body_inputs<T>(x, index.order, index.ptr);
  require_of_vertices(index.held, index.body, x);
  in.pinned = data<const bool>(index.held), in.body = data<const int32_t>(index.body);
  in.pinned_bodies = of_dtype<bool>("held_bodies", index.held_bodies, ScalarType::Bool, x, in.scene.bodies);
  return in;
}

// What a path is made of until bodies have gone.
struct FrameTensors {
  const Tensor &x, &move, &u, &left, &frames, &planes, &origin;
};
template <class T>
contact::StartInputs<T> start_inputs(const FrameTensors& t, const IndexTensors& index, double filter_eta) {
  auto in = start_inputs<T>(t.x, index);
  const int64_t bodies = in.scene.scenes * in.scene.bodies;
  in.move = vectors<T>("move", t.move, t.x), in.left = vectors<T>("left", t.left, t.x);
  in.u = like_x<T>("u", t.u, t.x, 3 * bodies), in.frames = like_x<T>("frames", t.frames, t.x, bodies);
  in.scene.origin = batched_or_null<T>("origin", t.origin, t.x, in.scene.scenes, 3 * int64_t{in.scene.vertices});
  in.floor = floor_of<T>(t.planes, t.x, in.floor_scalars);
  require(in.floor_scalars <= FloorStart::kMostPlanes * contact::kPlaneScalars,
          "diffvbd::contact_start: expected at most 8 planes");
  in.parameters.filter_eta = static_cast<T>(filter_eta);
  in.parameters.time_step = T(1);  // a filter does not read it
  return in;
}

template <class Place>
struct PartOperators {
  using T2 = std::tuple<Tensor, Tensor>;
  using T3 = std::tuple<Tensor, Tensor, Tensor>;
  using T4 = std::tuple<Tensor, Tensor, Tensor, Tensor>;
  using T5 = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor>;
  using T6 = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>;

  static T2 above_floor(const Tensor& x, const Tensor& u, const Tensor& way, const Tensor& planes, const Tensor& origin,
                        const Tensor& held, const Tensor& order, const Tensor& ptr) {
    const Place place(x);
    return dispatch_float(x, [&](auto scalar) {
      using T = decltype(scalar);
      const auto in = above_floor_inputs<T>(x, u, way, planes, origin, held, order, ptr);
      Tensor left = place.like_x(), stopped = place.make({in.scene.scenes, in.scene.bodies}, ScalarType::Bool);
      place.bodies(contact::AboveFloorDisplacements<T>{in, data<T>(left), data<bool>(stopped)});
      return T2(left, stopped);
    });
  }

  static T4 above_floor_backward(const Tensor& bar, const Tensor& x, const Tensor& u, const Tensor& way,
                                 const Tensor& planes, const Tensor& origin, const Tensor& held, const Tensor& order,
                                 const Tensor& ptr, bool wants_planes) {
    const Place place(x);
    return dispatch_float(x, [&](auto scalar) {
      using T = decltype(scalar);
      const auto in = above_floor_inputs<T>(x, u, way, planes, origin, held, order, ptr);
      const int64_t b = in.scene.scenes, bodies = in.scene.bodies;
      Tensor x_bar = place.like_x(), way_bar = place.like_x(), u_bar = place.make({in.u ? b : 0, bodies, 3});
      Tensor planes_bar = place.zeros({b, bodies, wants_planes ? in.planes * contact::kPlaneScalars : 0});
      place.bodies(contact::ReverseAboveFloor<T>{in, vectors<T>("bar", bar, x), data<T>(x_bar), data<T>(u_bar),
                                                 data<T>(way_bar), planes_bar.numel() ? data<T>(planes_bar) : nullptr});
      return T4(x_bar, u_bar, way_bar, planes_bar);
    });
  }

  static T5 frames(const Tensor& x, const Tensor& move, const Tensor& u, const Tensor& way, const Tensor& left,
                   const Tensor& stretch, const Tensor& room, const Tensor& own_room, const Tensor& held,
                   const Tensor& held_bodies, const Tensor& body, const Tensor& order, const Tensor& ptr) {
    const Place place(x);
    return dispatch_float(x, [&](auto scalar) {
      using T = decltype(scalar);
      auto in = start_inputs<T>(x, {held, held_bodies, body, order, ptr});
      const int64_t b = in.scene.scenes, v = in.scene.vertices, bodies = in.scene.bodies;
      in.move = vectors<T>("move", move, x), in.left = vectors<T>("left", left, x);
      in.u = like_x<T>("u", u, x, 3 * b * bodies);
      const bool own = own_room.numel() > 0;
      Tensor limit = place.make({b, bodies}), ways = place.like_x(), center = place.like_x();
      Tensor rooms = place.make({b, v}), own_rooms = place.make({own ? b : 0, v});
      place.bodies(contact::Frames<T>{in, vectors<T>("way", way, x), like_x<T>("stretch", stretch, x, b * bodies),
                                      like_x<T>("room", room, x, b * (bodies + 1)),
                                      own ? like_x<T>("own_room", own_room, x, b * (bodies + 1)) : nullptr,
                                      data<T>(limit), data<T>(ways), data<T>(center), data<T>(rooms),
                                      data<T>(own_rooms)});
      return T5(limit, ways, center, rooms, own_rooms);
    });
  }

  static T4 bends(const Tensor& x, const Tensor& move, const Tensor& u, const Tensor& left, const Tensor& frames,
                  const Tensor& limit, const Tensor& stopped, const Tensor& own_room, const Tensor& planes,
                  const Tensor& origin, const Tensor& held, const Tensor& held_bodies, const Tensor& body,
                  const Tensor& order, const Tensor& ptr, double filter_eta) {
    const Place place(x);
    return dispatch_float(x, [&](auto scalar) {
      using T = decltype(scalar);
      const auto in = start_inputs<T>({x, move, u, left, frames, planes, origin}, {held, held_bodies, body, order, ptr},
                                      filter_eta);
      const int64_t b = in.scene.scenes, bodies = in.scene.bodies;
      Tensor base = place.like_x(), target = place.like_x(), way = place.like_x();
      Tensor state = place.make({b, in.scene.vertices}, ScalarType::Byte);
      const contact::Bends<T> act{in,
                                  like_x<T>("limit", limit, x, b * bodies),
                                  own_room.numel() > 0 ? like_x<T>("own_room", own_room, x, b * (bodies + 1)) : nullptr,
                                  of_dtype<bool>("stopped", stopped, ScalarType::Bool, x, b * bodies),
                                  data<T>(way),
                                  data<uint8_t>(state)};
      place.vertices(contact::Wishes<T>{in, data<T>(base), data<T>(target), data<T>(way)});
      place.bodies(act);
      return T4(base, target, way, state);
    });
  }

  static T2 hold(const Tensor& way, const Tensor& state, const Tensor& rises) {
    require_positions(way);
    const Place place(way);
    return dispatch_float(way, [&](auto scalar) {
      using T = decltype(scalar);
      contact::StartInputs<T> in{};
      in.scene.scenes = way.size(0), in.scene.vertices = static_cast<int32_t>(way.size(1));
      const int64_t rows = in.scene.scenes * in.scene.vertices;
      Tensor way_out = place.like_x(), state_out = place.make({way.size(0), way.size(1)}, ScalarType::Byte);
      place.vertices(contact::Freeze<T>{
          in, data<const T>(way), of_dtype<uint8_t>("state", state, ScalarType::Byte, way, rows),
          of_dtype<bool>("rises", rises, ScalarType::Bool, way, rows), data<T>(way_out), data<uint8_t>(state_out)});
      return T2(way_out, state_out);
    });
  }

  static T2 held_up(const Tensor& base, const Tensor& way, const Tensor& share, const Tensor& state, const Tensor& held,
                    const Tensor& held_bodies, const Tensor& body, const Tensor& order, const Tensor& ptr) {
    const Place place(base);
    return dispatch_float(base, [&](auto scalar) {
      using T = decltype(scalar);
      auto in = start_inputs<T>(base, {held, held_bodies, body, order, ptr});
      const int64_t rows = in.scene.scenes * in.scene.vertices;
      in.fraction = like_x<T>("share", share, base, rows);
      Tensor to = place.like_x(), state_out = place.make({base.size(0), base.size(1)}, ScalarType::Byte);
      place.bodies(contact::BlockedBodies<T>{in, data<const T>(base), vectors<T>("way", way, base),
                                      of_dtype<uint8_t>("state", state, ScalarType::Byte, base, rows), data<T>(to),
                                      data<uint8_t>(state_out)});
      return T2(to, state_out);
    });
  }

  static T3 falls(const Tensor& x, const Tensor& move, const Tensor& fall, const Tensor& u, const Tensor& left,
                  const Tensor& frames, const Tensor& share, const Tensor& state, const Tensor& planes,
                  const Tensor& origin, const Tensor& held, const Tensor& held_bodies, const Tensor& body,
                  const Tensor& order, const Tensor& ptr, double filter_eta) {
    const Place place(x);
    return dispatch_float(x, [&](auto scalar) {
      using T = decltype(scalar);
      auto in = start_inputs<T>({x, move, u, left, frames, planes, origin}, {held, held_bodies, body, order, ptr},
                                filter_eta);
      const int64_t rows = in.scene.scenes * in.scene.vertices;
      in.gravity_move = vectors<T>("fall", fall, x), in.fraction = like_x<T>("share", share, x, rows);
      Tensor went = place.make({x.size(0), x.size(1)}), at = place.like_x(), way = place.like_x();
      place.vertices(contact::GravityMoves<T>{in, of_dtype<uint8_t>("state", state, ScalarType::Byte, x, rows), data<T>(went),
                                       data<T>(at), data<T>(way)});
      return T3(went, at, way);
    });
  }

  static T2 start(const Tensor& x, const Tensor& move, const Tensor& fall, const Tensor& u, const Tensor& left,
                  const Tensor& frames, const Tensor& share, const Tensor& last_share, const Tensor& stopped,
                  const Tensor& planes, const Tensor& origin, const Tensor& held, const Tensor& held_bodies,
                  const Tensor& body, const Tensor& order, const Tensor& ptr, double filter_eta) {
    const Place place(x);
    return dispatch_float(x, [&](auto scalar) {
      using T = decltype(scalar);
      auto in = start_inputs<T>({x, move, u, left, frames, planes, origin}, {held, held_bodies, body, order, ptr},
                                filter_eta);
      const int64_t b = in.scene.scenes, v = in.scene.vertices;
      in.gravity_move = vectors<T>("fall", fall, x);
      in.fraction = like_x<T>("share", share, x, b * v), in.last_fraction = like_x<T>("last_share", last_share, x, b * v);
      Tensor end = place.like_x(), is_short = place.make({b, v}, ScalarType::Bool);
      place.vertices(contact::Starts<T>{in,
                                        of_dtype<bool>("stopped", stopped, ScalarType::Bool, x, b * in.scene.bodies),
                                        data<T>(end), data<bool>(is_short)});
      return T2(end, is_short);
    });
  }

  static T6 start_backward(const Tensor& bar, const Tensor& x, const Tensor& move, const Tensor& fall, const Tensor& u,
                           const Tensor& left, const Tensor& frames, const Tensor& share, const Tensor& last_share,
                           const Tensor& planes, const Tensor& origin, const Tensor& held, const Tensor& held_bodies,
                           const Tensor& body, const Tensor& order, const Tensor& ptr, double filter_eta,
                           bool wants_planes) {
    const Place place(x);
    return dispatch_float(x, [&](auto scalar) {
      using T = decltype(scalar);
      auto in = start_inputs<T>({x, move, u, left, frames, planes, origin}, {held, held_bodies, body, order, ptr},
                                filter_eta);
      const int64_t b = in.scene.scenes, v = in.scene.vertices;
      in.gravity_move = vectors<T>("fall", fall, x);
      in.fraction = like_x<T>("share", share, x, b * v), in.last_fraction = like_x<T>("last_share", last_share, x, b * v);
      Tensor out[5] = {place.like_x(), place.like_x(), place.like_x(), place.like_x(), place.like_x()};
      Tensor planes_bar = place.make({b, v, wants_planes ? in.floor_scalars : 0});
      place.vertices(contact::ReverseStarts<T>{
          in,
          {vectors<T>("bar", bar, x), data<T>(out[0]), data<T>(out[1]), data<T>(out[2]), data<T>(out[3]),
           data<T>(out[4]), planes_bar.numel() ? data<T>(planes_bar) : nullptr}});
      return T6(out[0], out[1], out[2], out[3], out[4], planes_bar);
    });
  }
};

}  // namespace diffvbd
