// CPU implementations of the operators of the start of a part.
#include "../contact_start.h"

#include <torch/csrc/stable/library.h>

#include <algorithm>
#include <tuple>
#include <vector>

#include "../../cpu/advance.h"
#include "../../cpu/threads.h"
#include "sweep.h"

namespace {

namespace contact = diffvbd::contact;
using diffvbd::data, diffvbd::dispatch_float, diffvbd::empty, diffvbd::kGrain;
using diffvbd::require, diffvbd::TranslationTensors, diffvbd::zeros;
using torch::headeronly::ScalarType;
using torch::stable::Tensor;

// Calls f(scene, item) for all items of all scenes.
template <class F>
void each(int64_t scenes, int64_t items, const F& f) {
  torch::stable::parallel_for(0, scenes * items, kGrain, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) f(i / items, static_cast<int32_t>(i % items));
  });
}

template <class T>
diffvbd::Buffer<T> body_sums(const contact::TranslationInputs<T>& in) {
  diffvbd::Buffer<T> sums(4 * in.scenes * in.bodies);
  for (int64_t row = 0; row < in.scenes * in.bodies; ++row) {
    const auto body = static_cast<int32_t>(row % in.bodies);
    const contact::Mean<T> mean = contact::mean_of_body(in, row / in.bodies, body, 0, 1);
    const T values[] = {mean.sum.x, mean.sum.y, mean.sum.z, mean.mass};
    for (int k = 0; k < 4; ++k) sums.get()[4 * row + k] = values[k];
  }
  return sums;
}

Tensor contact_translation(const Tensor& move, const Tensor& mass, const Tensor& x, const Tensor& origin,
                           const Tensor& planes, const Tensor& held, const Tensor& body, const Tensor& body_order,
                           const Tensor& body_ptr, const Tensor& island, const Tensor& lowest) {
  const TranslationTensors given{move, mass, x, origin, planes, held, body, body_order, body_ptr, island, lowest};
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::translation_inputs<T>(given);
    Tensor out = empty(x, {in.scenes, in.bodies, 3});
    const diffvbd::Buffer<T> sums = body_sums(in);
    for (int64_t row = 0; row < in.scenes * in.bodies; ++row) {
      const int64_t scene = row / in.bodies, body = row % in.bodies, first = in.island[row];
      T* to = data<T>(out) + 3 * row;
      if (first >= 0 && first < body) {  // that of its island's first body
        std::copy_n(data<T>(out) + 3 * (scene * in.bodies + first), 3, to);
        continue;
      }
      const auto u = contact::translation_of(in, sums.get(), scene, static_cast<int32_t>(body));
      to[0] = u.x, to[1] = u.y, to[2] = u.z;
    }
    return out;
  });
}

std::tuple<Tensor, Tensor, Tensor, Tensor> contact_translation_backward(
    const Tensor& u_bar, const Tensor& move, const Tensor& mass, const Tensor& x, const Tensor& origin,
    const Tensor& planes, const Tensor& held, const Tensor& body, const Tensor& body_order, const Tensor& body_ptr,
    const Tensor& island, const Tensor& lowest) {
  const TranslationTensors given{move, mass, x, origin, planes, held, body, body_order, body_ptr, island, lowest};
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::translation_inputs<T>(given);
    diffvbd::require_like("u_bar", u_bar, x, 3 * in.scenes * in.bodies);
    const int64_t b = in.scenes, scalars = int64_t{in.floor.num_planes} * contact::kPlaneScalars;
    Tensor move_bar = empty(x, {b, in.vertices, 3}), mass_bar = empty(x, {b, in.vertices});
    Tensor x_bar = zeros(x, {b, in.vertices, 3}), planes_bar = zeros(x, {b, scalars});
    const diffvbd::Buffer<T> sums = body_sums(in), rate(3 * b * in.bodies, true), mean(3 * b * in.bodies, true);
    for (int64_t row = 0; row < b * in.bodies; ++row) {
      contact::reverse_island(in, sums.get(), data<const T>(u_bar), row / in.bodies,
                              static_cast<int32_t>(row % in.bodies), rate.get(), mean.get(), data<T>(x_bar),
                              data<T>(planes_bar) + row / in.bodies * scalars);
    }
    each(b, in.vertices, [&](int64_t scene, int32_t v) {
      contact::reverse_vertex_mean(in, rate.get(), mean.get(), scene, v, data<T>(move_bar), data<T>(mass_bar));
    });
    return std::make_tuple(move_bar, mass_bar, x_bar, planes_bar);
  });
}

std::tuple<Tensor, Tensor> contact_advance(const Tensor& x, const Tensor& move, const Tensor& u, const Tensor& center,
                                           const Tensor& origin, const Tensor& collider, const Tensor& collider_next,
                                           const Tensor& held, const Tensor& body, const Tensor& room,
                                           const Tensor& own_center, const Tensor& own_room, const Tensor& pairs,
                                           const Tensor& constants, const Tensor& ptr, const Tensor& entry,
                                           bool careful, bool whole) {
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    auto in = diffvbd::advance_inputs<T>({x, move, u, center, origin, collider, collider_next, held, body, room,
                                          own_center, own_room, pairs, constants, ptr, entry});
    in.careful = careful, in.whole = whole;
    Tensor share = empty(x, {in.scenes, whole ? in.bodies : in.vertices});
    Tensor stuck = torch::stable::empty({1}, ScalarType::Long);
    *data<int64_t>(stuck) = diffvbd::advance<T>(in, data<T>(share));
    return std::make_tuple(share, stuck);
  });
}

Tensor contact_narrow(const Tensor& x, const Tensor& origin, const Tensor& collider, const Tensor& room,
                      const Tensor& pairs, const Tensor& constants, const Tensor& ptr) {
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::narrow_inputs<T>(x, origin, collider, room, pairs, constants, ptr);
    Tensor out = empty(x, {pairs.size(0), contact::kConstants});
    diffvbd::refresh_gaps<T>(in, pairs.size(0), data<T>(out));
    return out;
  });
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> contact_keep(const Tensor& keep, const Tensor& pairs,
                                                                const Tensor& constants, const Tensor& ptr,
                                                                const Tensor& entry, bool exact) {
  return dispatch_float(constants, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::keep_inputs<T>(keep, pairs, constants, ptr, entry);
    const int32_t* first = data<const int32_t>(ptr);
    require(std::is_sorted(first, first + ptr.numel()) && *first >= 0 && first[ptr.numel() - 1] <= entry.numel(),
            "diffvbd::contact_keep: expected ptr that ascends up to the number of entries");
    std::vector<int32_t> kept(in.count + 1);
    for (int64_t i = 0; i < in.count; ++i) kept[i + 1] = kept[i] + contact::stays(in, i);
    const diffvbd::KeptLists lists(
        ptr, constants.scalar_type(), exact ? kept.back() : in.count,
        [](const std::vector<int64_t>& shape, ScalarType dtype) { return torch::stable::empty(shape, dtype); });
    const auto out = lists.pointers<T>();
    for (int64_t i = 0; i < in.count; ++i) {
      if (contact::stays(in, i)) contact::copy_pair(in, i, kept[i], out);
    }
    for (int64_t i = kept.back(); i < out.capacity; ++i) contact::leave_empty(i, out);
    int32_t at = 0;
    for (int64_t i = 0; i < in.corners; ++i) {
      out.ptr[i] = at;
      contact::each_entry(in, kept.data(), i, [&](int32_t own) { out.entry[at++] = own; });
    }
    out.ptr[in.corners] = at;
    return lists.tensors();
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CPU, m) {
  m.impl("contact_advance", TORCH_BOX(&contact_advance));
  m.impl("contact_keep", TORCH_BOX(&contact_keep));
  m.impl("contact_narrow", TORCH_BOX(&contact_narrow));
  m.impl("contact_translation", TORCH_BOX(&contact_translation));
  m.impl("contact_translation_backward", TORCH_BOX(&contact_translation_backward));
}
