// CPU implementation of the search for neighbors: tensors in, raw pointers on.
#include "../neighbors.h"

#include <torch/csrc/stable/library.h>

#include <tuple>

#include "../../cpu/neighbors.h"

namespace {

using diffvbd::data;
using torch::headeronly::ScalarType;
using torch::stable::Tensor;

std::tuple<Tensor, Tensor> neighbor_pairs(const Tensor& points, double radius, int64_t max_pairs) {
  diffvbd::check_neighbor_arguments(points, radius, max_pairs);
  return diffvbd::dispatch_float(points, [&](auto scalar) {
    using T = decltype(scalar);
    Tensor pairs = torch::stable::empty({max_pairs, 3}, ScalarType::Int);
    Tensor count = torch::stable::empty({1}, ScalarType::Long);
    *data<int64_t>(count) = diffvbd::neighbor_pairs<T>(data<const T>(points), points.size(0), points.size(1), radius,
                                                       data<int32_t>(pairs), max_pairs);
    return std::make_tuple(pairs, count);
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CPU, m) { m.impl("neighbor_pairs", TORCH_BOX(&neighbor_pairs)); }
