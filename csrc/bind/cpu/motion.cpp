// CPU implementations of motions and rooms of bodies: tensors in, raw pointers on.
#include "../../cpu/motion.h"

#include <torch/csrc/stable/library.h>

#include <tuple>
#include <vector>

#include "../motion.h"
#include "sweep.h"

namespace {

namespace contact = diffvbd::contact;
using diffvbd::data, diffvbd::dispatch_float, diffvbd::empty;
using torch::headeronly::ScalarType;
using torch::stable::Tensor;

std::tuple<Tensor, Tensor, Tensor> contact_motion(const Tensor& x, const Tensor& origin, const Tensor& mass,
                                                  const Tensor& move, const Tensor& fall, const Tensor& held,
                                                  const Tensor& held_bodies, const Tensor& order, const Tensor& ptr) {
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::motion_inputs<T>({x, origin, mass, move, held, order, ptr}, fall, held_bodies);
    Tensor rigid = empty(x, {in.scenes, in.vertices, 3}), ways = empty(x, {contact::kDisplacements, in.scenes, in.bodies});
    Tensor sums = empty(x, {in.scenes, in.bodies, 4});
    diffvbd::find_motion<T>(in, data<T>(rigid), data<T>(ways), data<T>(sums));
    return std::make_tuple(rigid, ways, sums);
  });
}

std::tuple<Tensor, Tensor, Tensor> contact_motion_backward(const Tensor& bar, const Tensor& x, const Tensor& origin,
                                                           const Tensor& mass, const Tensor& move, const Tensor& held,
                                                           const Tensor& held_bodies, const Tensor& order,
                                                           const Tensor& ptr) {
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::motion_inputs<T>({x, origin, mass, move, held, order, ptr}, {}, held_bodies);
    diffvbd::require_like("bar", bar, x, x.numel());
    Tensor x_bar = empty(x, {in.scenes, in.vertices, 3}), move_bar = empty(x, {in.scenes, in.vertices, 3});
    Tensor mass_bar = empty(x, {in.scenes, in.vertices});
    diffvbd::reverse_motion<T>(in, {data<const T>(bar), data<T>(x_bar), data<T>(move_bar), data<T>(mass_bar)});
    return std::make_tuple(x_bar, move_bar, mass_bar);
  });
}

Tensor contact_coast(const Tensor& x, const Tensor& mass, const Tensor& move, const Tensor& held,
                     const Tensor& held_bodies, const Tensor& order, const Tensor& ptr, double chord) {
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::coast_inputs<T>(x, mass, move, held, held_bodies, order, ptr, chord);
    Tensor coasted = empty(x, {in.scenes, in.vertices, 3});
    diffvbd::extrapolate<T>(in, chord, data<T>(coasted));
    return coasted;
  });
}

std::tuple<Tensor, Tensor, Tensor> contact_coast_backward(const Tensor& bar, const Tensor& x, const Tensor& mass,
                                                          const Tensor& move, const Tensor& held,
                                                          const Tensor& held_bodies, const Tensor& order,
                                                          const Tensor& ptr, double chord) {
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::coast_inputs<T>(x, mass, move, held, held_bodies, order, ptr, chord);
    diffvbd::require_like("bar", bar, x, x.numel());
    Tensor x_bar = empty(x, {in.scenes, in.vertices, 3}), move_bar = empty(x, {in.scenes, in.vertices, 3});
    Tensor mass_bar = empty(x, {in.scenes, in.vertices});
    diffvbd::reverse_extrapolate<T>(in, chord, {data<const T>(bar), data<T>(x_bar), data<T>(move_bar), data<T>(mass_bar)});
    return std::make_tuple(x_bar, mass_bar, move_bar);
  });
}

std::tuple<Tensor, Tensor, Tensor, Tensor> contact_rooms(
    const Tensor& x, const Tensor& origin, const Tensor& mass, const Tensor& move, const Tensor& held,
    const Tensor& order, const Tensor& ptr, const Tensor& rigid, const Tensor& ways, const Tensor& sums,
    const Tensor& floor, const Tensor& collider, const Tensor& collider_next, const Tensor& planes, const Tensor& body,
    const Tensor& radius, const Tensor& most, const Tensor& most_alone, const Tensor& most_own, const Tensor& least_own,
    double dhat, double share, double least, bool any_direction, bool self_contact) {
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto motion = diffvbd::motion_inputs<T>({x, origin, mass, move, held, order, ptr});
    const diffvbd::RoomResults out(
        motion.scenes, motion.bodies, planes.size(0) + diffvbd::planes_of(floor),
        [&](const std::vector<int64_t>& shape) { return empty(x, shape); },
        [&](const std::vector<int64_t>& shape) { return torch::stable::empty(shape, ScalarType::Int); });
    const auto islands = diffvbd::island_inputs<T>(x, origin, move, mass, collider, collider_next, planes, body, order,
                                                   ptr, held, radius, out.room, motion.bodies, dhat, any_direction);
    const auto in =
        diffvbd::room_inputs<T>(motion, islands, x, {rigid, ways, sums, floor, most, most_alone, most_own, least_own},
                                {dhat, share, least, self_contact});
    diffvbd::find_trust_radii<T>(in, out.pointers<T>(in));
    return out.tensors();
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CPU, m) {
  m.impl("contact_motion", TORCH_BOX(&contact_motion));
  m.impl("contact_motion_backward", TORCH_BOX(&contact_motion_backward));
  m.impl("contact_coast", TORCH_BOX(&contact_coast));
  m.impl("contact_coast_backward", TORCH_BOX(&contact_coast_backward));
  m.impl("contact_rooms", TORCH_BOX(&contact_rooms));
}
