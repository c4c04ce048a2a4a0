// CUDA implementation of the matrices of a coarse space; the corrections themselves belong to the sweeps.
#include "../coarse.h"

#include <torch/csrc/stable/accelerator.h>
#include <torch/csrc/stable/library.h>

#include <tuple>
#include <vector>

#include "../../cuda/coarse.h"
#include "binding.h"

namespace {

namespace coarse = diffvbd::coarse;
namespace cuda = diffvbd::cuda;
using cuda::check, cuda::current_stream, cuda::empty;
using diffvbd::CoarseFields, diffvbd::data, diffvbd::dispatch_float;
using torch::headeronly::ScalarType;
using torch::stable::Tensor;
using torch::stable::accelerator::DeviceGuard;

// The inverses: a product with one is many small sums at once, where factors are solved row after row.
Tensor matrix(DIFFVBD_PARAMETERS(COARSE) std::vector<int64_t> sizes, double time_step, bool factored) {
  const CoarseFields f{DIFFVBD_ITEMS(COARSE)};
  const DeviceGuard guard(x_prev.get_device_index());
  return dispatch_float(x_prev, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::matrix_inputs<T>(f, sizes, time_step);
    const coarse::Plan& p = in.plan;
    const int64_t b = in.scenes, edge = cuda::kEdge;
    const Tensor inverse = empty(x_prev, {b, int64_t{9} * p.cells});
    const auto doubles = [&](int64_t count) { return empty(x_prev, {count}, ScalarType::Double); };
    const Tensor turn = doubles(b * p.groups * cuda::kGroupScalars), sums = doubles(b * 9 * p.cells),
                 panel = doubles(b * 6 * p.functions * edge), block = doubles(b * p.bodies * edge * edge);
    check(
        cuda::coarse_inverse<T>(in, {data<double>(turn), data<double>(sums), data<double>(panel), data<double>(block)},
                                data<T>(inverse), factored, current_stream(x_prev)),
        "the matrices of a coarse space");
    return inverse;
  });
}

std::tuple<Tensor, Tensor, Tensor> matrix_backward(DIFFVBD_PARAMETERS(COARSE) const Tensor& bar,
                                                   std::vector<int64_t> sizes, double time_step) {
  const CoarseFields f{DIFFVBD_ITEMS(COARSE)};
  const DeviceGuard guard(x_prev.get_device_index());
  return dispatch_float(x_prev, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::matrix_inputs<T>(f, sizes, time_step);
    const coarse::Plan& p = in.plan;
    diffvbd::require_like("bar", bar, x_prev, int64_t{9} * p.cells * in.scenes);
    const int64_t stiffnesses = in.stiffness.scene == 0 ? 1 : in.scenes;
    const Tensor x_bar = empty(x_prev, {in.scenes, in.vertices, 3}),
                 stiffness_bar = empty(x_prev, {stiffnesses, p.groups, 3, 3, p.width, p.width}),
                 mass_bar = empty(x_prev, {in.scenes, p.cells}),
                 turn = empty(x_prev, {in.scenes * p.groups * cuda::kGroupScalars}, ScalarType::Double);
    check(cuda::coarse_inverse_vjp<T>(in, data<const T>(bar), data<double>(turn), data<T>(x_bar),
                                      data<T>(stiffness_bar), data<T>(mass_bar), current_stream(x_prev)),
          "the adjoint of the matrices of a coarse space");
    return std::make_tuple(x_bar, stiffness_bar, mass_bar);
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CUDA, m) {
  m.impl("coarse_matrix", TORCH_BOX(&matrix));
  m.impl("coarse_matrix_backward", TORCH_BOX(&matrix_backward));
}
