// Lists of pairs, bodies and planes, as the operators of contact take them.
#pragma once

#include "../contact/friction.h"
#include "../contact/islands.h"
#include "../contact/passes.h"
#include "../core/parts.h"
#include "backend.h"

namespace diffvbd {

// rows: of corner points of all scenes
inline contact::PairList pair_list(const Tensor& pairs, const Tensor& ptr, const Tensor& entry, const Tensor& x,
                                   int64_t rows) {
  require(is_index(pairs, x) && is_index(ptr, x) && is_index(entry, x) && ptr.numel() == rows + 1 && pairs.dim() == 2 &&
              pairs.size(1) == contact::kPairRow && 4 * pairs.size(0) == entry.numel(),
          "diffvbd: expected pairs made by contact_detect for this batch");
  return {data<const int32_t>(pairs), data<const int32_t>(ptr), data<const int32_t>(entry)};
}
template <class T>
const T* pair_constants(const Tensor& constants, const Tensor& pairs, const Tensor& x) {
  return array<T>("constants", constants, x, x.scalar_type(), pairs.size(0) * contact::kConstants);
}

// Memory for what parts(take) takes; lives as long as the result.
template <class F>
Tensor workspace(const Device& device, const F& parts) {
  Parts<> sizes(nullptr);
  parts(sizes);
  const Tensor out = device.empty({static_cast<int64_t>(sizes.bytes)}, ScalarType::Byte);
  Parts<> places(out.data_ptr());
  parts(places);
  return out;
}

// Planes of a floor [1 | B, 7 planes]; none where it is empty.
inline int32_t planes_of(const Tensor& planes) {
  const int64_t scalars = planes.dim() > 0 && planes.size(0) > 0 ? planes.numel() / planes.size(0) : 0;
  require(scalars % contact::kPlaneScalars == 0 && scalars <= std::numeric_limits<int32_t>::max(),
          "diffvbd: expected planes [1 | scenes, 7 planes]");
  return static_cast<int32_t>(scalars / contact::kPlaneScalars);
}
template <class T>
Batched<const T> floor_of(const Reader<T>& read, const Tensor& planes) {
  return read.batch_or_null("planes", planes, int64_t{planes_of(planes)} * contact::kPlaneScalars);
}

// Of contact_lag: corner points and the pairs that repel.
template <class T>
contact::ContactInputs<T> lag_inputs(const Tensor& x, const Tensor& origin, const Tensor& collider, const Tensor& kappa,
                                     const Tensor& pairs, const Tensor& constants, const Tensor& ptr,
                                     const Tensor& entry) {
  const Reader<T> read(x);
  contact::ContactInputs<T> in{};
  in.num_vertices = static_cast<int32_t>(read.v);
  in.corners = read.v + read.colliders(collider);
  in.collider = read.batch("collider", collider, 3 * read.colliders(collider));
  in.origin = read.batch_or_null("origin", origin, 3 * read.v);
  in.kappa = read.batch("kappa", kappa, 1);
  in.listed = pair_list(pairs, ptr, entry, x, read.b * in.corners);
  in.constants = pair_constants<T>(constants, pairs, x);
  return in;
}

}  // namespace diffvbd
