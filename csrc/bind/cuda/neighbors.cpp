// CUDA implementation of the search for neighbors: tensors in, raw pointers on.
#include "../neighbors.h"

#include <torch/csrc/stable/accelerator.h>
#include <torch/csrc/stable/library.h>

#include <tuple>

#include "../../cuda/neighbors.h"
#include "binding.h"

namespace {

namespace cuda = diffvbd::cuda;
using cuda::empty, diffvbd::data;
using torch::headeronly::ScalarType;
using torch::stable::Tensor;
using torch::stable::accelerator::DeviceGuard;

std::tuple<Tensor, Tensor> neighbor_pairs(const Tensor& points, double radius, int64_t max_pairs) {
  const DeviceGuard guard(points.get_device_index());
  diffvbd::check_neighbor_arguments(points, radius, max_pairs);
  return diffvbd::dispatch_float(points, [&](auto scalar) {
    using T = decltype(scalar);
    const int64_t scenes = points.size(0), n = points.size(1);
    Tensor pairs = empty(points, {max_pairs, 3}, ScalarType::Int), count = empty(points, {1}, ScalarType::Long);
    const auto bytes = static_cast<int64_t>(cuda::neighbor_workspace_bytes<T>(scenes * n));
    const Tensor work = empty(points, {bytes}, ScalarType::Byte);
    cuda::check(cuda::neighbor_pairs<T>(data<const T>(points), scenes, n, radius, data<int32_t>(pairs), max_pairs,
                                        data<int64_t>(count), work.data_ptr(), cuda::current_stream(points)),
                "the search for neighbors");
    return std::make_tuple(pairs, count);
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CUDA, m) { m.impl("neighbor_pairs", TORCH_BOX(&neighbor_pairs)); }
