// CUDA implementations of the operators of the start of a part.
#include "../contact_start.h"

#include <torch/csrc/stable/accelerator.h>
#include <torch/csrc/stable/library.h>

#include <tuple>
#include <vector>

#include "../../cuda/advance.h"
#include "../../cuda/keep.h"
#include "../../cuda/start.h"
#include "binding.h"

namespace {

namespace contact = diffvbd::contact;
namespace cuda = diffvbd::cuda;
using cuda::check, cuda::current_stream, cuda::empty, cuda::Zeroed;
using diffvbd::data, diffvbd::dispatch_float, diffvbd::TranslationTensors;
using torch::headeronly::ScalarType;
using torch::stable::Tensor;
using torch::stable::accelerator::DeviceGuard;

Tensor contact_translation(const Tensor& move, const Tensor& mass, const Tensor& x, const Tensor& origin,
                           const Tensor& planes, const Tensor& held, const Tensor& body, const Tensor& body_order,
                           const Tensor& body_ptr, const Tensor& island, const Tensor& lowest) {
  const DeviceGuard guard(x.get_device_index());
  const TranslationTensors given{move, mass, x, origin, planes, held, body, body_order, body_ptr, island, lowest};
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::translation_inputs<T>(given);
    Tensor out = empty(x, {in.scenes, in.bodies, 3});
    const Tensor sums = empty(x, {in.scenes, in.bodies, 4});
    check(cuda::translation<T>(in, data<T>(sums), data<T>(out), current_stream(x)), "the translation of islands");
    return out;
  });
}

std::tuple<Tensor, Tensor, Tensor, Tensor> contact_translation_backward(
    const Tensor& u_bar, const Tensor& move, const Tensor& mass, const Tensor& x, const Tensor& origin,
    const Tensor& planes, const Tensor& held, const Tensor& body, const Tensor& body_order, const Tensor& body_ptr,
    const Tensor& island, const Tensor& lowest) {
  const DeviceGuard guard(x.get_device_index());
  const TranslationTensors given{move, mass, x, origin, planes, held, body, body_order, body_ptr, island, lowest};
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::translation_inputs<T>(given);
    diffvbd::require_like("u_bar", u_bar, x, 3 * in.scenes * in.bodies);
    const int64_t b = in.scenes, v = in.vertices, scalars = int64_t{in.floor.num_planes} * contact::kPlaneScalars;
    Zeroed zeros(x);
    Tensor move_bar = empty(x, {b, v, 3}), mass_bar = empty(x, {b, v}), x_bar = zeros({b, v, 3});
    Tensor planes_bar = zeros({b, scalars});
    const Tensor sums = empty(x, {b, in.bodies, 4}), zeroed = zeros({b, in.bodies, 6 + scalars});
    zeros.clear();
    check(cuda::translation_backward<T>(in, data<const T>(u_bar), data<T>(sums), data<T>(zeroed), data<T>(move_bar),
                                        data<T>(mass_bar), data<T>(x_bar), data<T>(planes_bar), current_stream(x)),
          "the translation of islands");
    return std::make_tuple(move_bar, mass_bar, x_bar, planes_bar);
  });
}

std::tuple<Tensor, Tensor> contact_advance(const Tensor& x, const Tensor& move, const Tensor& u, const Tensor& center,
                                           const Tensor& origin, const Tensor& collider, const Tensor& collider_next,
                                           const Tensor& held, const Tensor& body, const Tensor& room,
                                           const Tensor& own_center, const Tensor& own_room, const Tensor& pairs,
                                           const Tensor& constants, const Tensor& ptr, const Tensor& entry,
                                           bool careful, bool whole) {
  const DeviceGuard guard(x.get_device_index());
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    auto in = diffvbd::advance_inputs<T>({x, move, u, center, origin, collider, collider_next, held, body, room,
                                          own_center, own_room, pairs, constants, ptr, entry});
    in.careful = careful, in.whole = whole;
    Tensor share = empty(x, {in.scenes, whole ? in.bodies : in.vertices});
    Tensor stuck = empty(x, {1}, ScalarType::Long);
    const Tensor work = empty(x, {cuda::advance_workspace_bytes<T>(in, pairs.size(0))}, ScalarType::Byte);
    int multiprocessors = 0;
    check(cudaDeviceGetAttribute(&multiprocessors, cudaDevAttrMultiProcessorCount, x.get_device_index()),
          "a device query");
    check(cuda::advance<T>(in, pairs.size(0), data<T>(share), data<int64_t>(stuck), work.data_ptr(), multiprocessors,
                           current_stream(x)),
          "the start of a part");
    return std::make_tuple(share, stuck);
  });
}

Tensor contact_narrow(const Tensor& x, const Tensor& origin, const Tensor& collider, const Tensor& room,
                      const Tensor& pairs, const Tensor& constants, const Tensor& ptr) {
  const DeviceGuard guard(x.get_device_index());
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::narrow_inputs<T>(x, origin, collider, room, pairs, constants, ptr);
    Tensor out = empty(x, {pairs.size(0), contact::kConstants});
    check(cuda::refresh_gaps<T>(in, pairs.size(0), data<T>(out), current_stream(x)), "what a list can still reach");
    return out;
  });
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> contact_keep(const Tensor& keep, const Tensor& pairs,
                                                                const Tensor& constants, const Tensor& ptr,
                                                                const Tensor& entry, bool /*exact*/) {
  const DeviceGuard guard(constants.get_device_index());
  return dispatch_float(constants, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::keep_inputs<T>(keep, pairs, constants, ptr, entry);
    const diffvbd::KeptLists lists(
        ptr, constants.scalar_type(), in.count,
        [&](const std::vector<int64_t>& shape, ScalarType dtype) { return empty(constants, shape, dtype); });
    const Tensor work = empty(constants, {cuda::keep_bytes(in)}, ScalarType::Byte);
    check(cuda::keep<T>(in, lists.pointers<T>(), work.data_ptr(), current_stream(constants)), "a part of a list");
    return lists.tensors();
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CUDA, m) {
  m.impl("contact_advance", TORCH_BOX(&contact_advance));
  m.impl("contact_keep", TORCH_BOX(&contact_keep));
  m.impl("contact_narrow", TORCH_BOX(&contact_narrow));
  m.impl("contact_translation", TORCH_BOX(&contact_translation));
  m.impl("contact_translation_backward", TORCH_BOX(&contact_translation_backward));
}
