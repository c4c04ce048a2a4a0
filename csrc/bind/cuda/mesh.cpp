// CUDA implementations of the operators on a mesh: its rest shape, sums over stars in a fixed order.
#include <torch/csrc/stable/library.h>

#include <vector>

#include "../../cuda/arrays.h"
#include "sweep.h"

namespace {

namespace cuda = diffvbd::cuda;
using cuda::check, cuda::current_stream, cuda::DeviceGuard, cuda::empty, cuda::plan_of;
using diffvbd::data, diffvbd::dispatch_float, diffvbd::is_beside, diffvbd::is_index, diffvbd::require;
using torch::headeronly::ScalarType;
using torch::stable::Tensor;

Tensor pack_rest(const Tensor& rest, const Tensor& plan, std::vector<int64_t> sizes) {
  const DeviceGuard guard(rest.get_device_index());
  const cuda::HostPlan host = plan_of(plan, rest, sizes);
  require(rest.dim() == 3 && rest.size(1) == host.plan.num_tets && rest.size(2) == diffvbd::kRestScalars &&
              rest.is_contiguous(),
          "diffvbd::pack_rest: expected contiguous rest of shape [scenes, tets, 7]");
  return dispatch_float(rest, [&](auto scalar) {
    using T = decltype(scalar);
    Tensor out = empty(rest, {rest.size(0), host.plan.slots, cuda::kRestRow, diffvbd::kSlice});
    check(cuda::pack_rest<T>(host.plan, rest.size(0), data<const T>(rest), data<T>(out), current_stream(rest)),
          "pack_rest");
    return out;
  });
}

Tensor tet_gather(const Tensor& values, const Tensor& tets) {
  const DeviceGuard guard(values.get_device_index());
  require(values.dim() == 3 && values.is_contiguous() && is_beside(tets, values, ScalarType::Long) && tets.dim() == 2 &&
              tets.size(1) == 4,
          "diffvbd::tet_gather: expected values [scenes, vertices, C] and tets [T, 4] int64");
  return dispatch_float(values, [&](auto scalar) {
    using T = decltype(scalar);
    Tensor out = empty(values, {values.size(0), tets.size(0), 4, values.size(2)});
    check(cuda::gather_rows<T>(data<const T>(values), data<const int64_t>(tets), values.size(0), values.size(1),
                               tets.numel(), values.size(2), data<T>(out), current_stream(values)),
          "tet_gather");
    return out;
  });
}

// Masses are not looked at here: that would wait for the device.
Tensor star_sum(const Tensor& values, const Tensor& star_ptr, const Tensor& star, bool /*positive*/) {
  const DeviceGuard guard(values.get_device_index());
  require(values.dim() == 4 && values.size(2) == 4 && values.is_contiguous() &&
              is_beside(star_ptr, values, ScalarType::Long) && star_ptr.dim() == 1 && star_ptr.numel() > 0 &&
              is_index(star, values),
          "diffvbd::star_sum: expected values [scenes, tets, 4, C], star_ptr [V + 1] int64, star int32");
  return dispatch_float(values, [&](auto scalar) {
    using T = decltype(scalar);
    const int64_t b = values.size(0), n = values.size(1) * 4, c = values.size(3), v = star_ptr.size(0) - 1;
    Tensor out = empty(values, {b, v, c});
    check(cuda::sum_segments<T>(data<const T>(values), data<const int64_t>(star_ptr), data<const int32_t>(star), b, n,
                                v, c, data<T>(out), current_stream(values)),
          "star_sum");
    return out;
  });
}

Tensor row_sum(const Tensor& values) {
  const DeviceGuard guard(values.get_device_index());
  require(values.dim() == 2 && values.is_contiguous(), "diffvbd::row_sum: expected a contiguous matrix");
  return dispatch_float(values, [&](auto scalar) {
    using T = decltype(scalar);
    const int64_t rows = values.size(0), columns = values.size(1);
    Tensor out = empty(values, {rows}), partial = empty(values, {cuda::partial_sums(rows, columns)});
    check(
        cuda::sum_rows<T>(data<const T>(values), rows, columns, data<T>(partial), data<T>(out), current_stream(values)),
        "row_sum");
    return out;
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CUDA, m) {
  m.impl("pack_rest", TORCH_BOX(&pack_rest));
  m.impl("tet_gather", TORCH_BOX(&tet_gather));
  m.impl("star_sum", TORCH_BOX(&star_sum));
  m.impl("row_sum", TORCH_BOX(&row_sum));
}
