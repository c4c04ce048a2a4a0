// CPU implementation of the matrices of a coarse space; the corrections themselves belong to the sweeps.
#include "../coarse.h"

#include <torch/csrc/stable/library.h>

#include <algorithm>
#include <tuple>
#include <vector>

#include "../../cpu/kernels.h"
#include "sweep.h"

namespace {

namespace coarse = diffvbd::coarse;
using diffvbd::CoarseFields, diffvbd::data, diffvbd::dispatch_float, diffvbd::zeros;
using torch::stable::Tensor;

template <class F>
void for_bodies(int64_t scenes, int64_t bodies, const F& f) {
  torch::stable::parallel_for(0, scenes * bodies, 1, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) f(i / bodies, static_cast<int>(i % bodies));
  });
}

Tensor matrix(DIFFVBD_PARAMETERS(COARSE) std::vector<int64_t> sizes, double time_step) {
  const CoarseFields f{DIFFVBD_ITEMS(COARSE)};
  return dispatch_float(x_prev, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::matrix_inputs<T>(f, sizes, time_step);
    const int64_t size = int64_t{9} * in.plan.cells;
    const Tensor out = zeros(x_prev, {in.scenes, size});
    const auto kernels = diffvbd::coarse_kernels<T>(diffvbd::kExactBlock);
    for_bodies(in.scenes, in.plan.bodies, [&](int64_t scene, int body) {
      const int64_t at = scene * size + int64_t{9} * in.plan.mass_ptr[body];
      const int64_t n = 3 * int64_t{in.plan.function_ptr[body + 1] - in.plan.function_ptr[body]};
      std::vector<T> work(std::max<int64_t>(9 * in.plan.width, n * diffvbd::kLanes));
      coarse::assemble(in, scene, body, kernels.rotate, work.data(), data<T>(out) + scene * size);
      kernels.factor(n, work.data(), data<T>(out) + at);
    });
    return out;
  });
}

std::tuple<Tensor, Tensor, Tensor> matrix_backward(DIFFVBD_PARAMETERS(COARSE) const Tensor& bar,
                                                   std::vector<int64_t> sizes, double time_step) {
  const CoarseFields f{DIFFVBD_ITEMS(COARSE)};
  return dispatch_float(x_prev, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::matrix_inputs<T>(f, sizes, time_step);
    const coarse::Plan& p = in.plan;
    const int64_t cells = p.cells, size = int64_t{9} * p.groups * p.width * p.width;
    diffvbd::require_like("bar", bar, x_prev, 9 * cells * in.scenes);
    const Tensor x_bar = zeros(x_prev, {in.scenes, in.vertices, 3}),
                 stiffness_bar = zeros(x_prev, {in.scenes, p.groups, 3, 3, p.width, p.width}),
                 mass_bar = zeros(x_prev, {in.scenes, cells});
    for_bodies(in.scenes, p.bodies, [&](int64_t scene, int body) {
      coarse::assemble_vjp(in, scene, body, data<const T>(bar) + 9 * cells * scene,
                           data<T>(x_bar) + 3 * in.vertices * scene, data<T>(stiffness_bar) + size * scene,
                           data<T>(mass_bar) + cells * scene);
    });
    return std::make_tuple(x_bar, stiffness_bar, mass_bar);
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CPU, m) {
  m.impl("coarse_matrix", TORCH_BOX(&matrix));
  m.impl("coarse_matrix_backward", TORCH_BOX(&matrix_backward));
}
