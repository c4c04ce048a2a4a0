// CPU implementation of the matrices of a coarse space and of what they are made of; the corrections themselves belong
// to the sweeps.
#include "../coarse.h"

#include <torch/csrc/stable/library.h>

#include <algorithm>
#include <tuple>
#include <vector>

#include "../../cpu/kernels.h"
#include "sweep.h"

namespace {

namespace coarse = diffvbd::coarse;
using diffvbd::CoarseFields, diffvbd::data, diffvbd::dispatch_float, diffvbd::empty, diffvbd::zeros;
using torch::stable::Tensor;

// f(scene, which) for all bodies, or groups, functions, vertices, of all scenes
template <class F>
void for_bodies(int64_t scenes, int64_t bodies, const F& f) {
  torch::stable::parallel_for(0, scenes * bodies, 1, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) f(i / bodies, static_cast<int>(i % bodies));
  });
}

Tensor matrix(DIFFVBD_PARAMETERS(COARSE) std::vector<int64_t> sizes, double time_step, bool factored) {
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
      if (factored) kernels.factor(n, work.data(), data<T>(out) + at);
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

Tensor stiffness(const Tensor& mu, const Tensor& lam, const Tensor& gradients, const Tensor& volume, const Tensor& plan,
                 const Tensor& weights, std::vector<int64_t> sizes) {
  return dispatch_float(mu, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::stiffness_inputs<T>(mu, lam, gradients, volume, plan, weights, sizes);
    const int64_t width = in.plan.width, size = 9 * width * width;
    const Tensor out = empty(mu, {in.scenes, in.plan.groups, 3, 3, width, width});
    for_bodies(in.scenes, in.plan.groups, [&](int64_t scene, int group) {
      coarse::stiffness(in, scene, group, data<T>(out) + (scene * in.plan.groups + group) * size);
    });
    return out;
  });
}

std::tuple<Tensor, Tensor, Tensor, Tensor> stiffness_backward(const Tensor& mu, const Tensor& lam,
                                                              const Tensor& gradients, const Tensor& volume,
                                                              const Tensor& plan, const Tensor& weights,
                                                              const Tensor& bar, std::vector<int64_t> sizes,
                                                              bool wants_rest) {
  return dispatch_float(mu, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::stiffness_inputs<T>(mu, lam, gradients, volume, plan, weights, sizes);
    const int64_t size = int64_t{9} * in.plan.width * in.plan.width, rest = wants_rest ? in.tets : 0;
    diffvbd::require_like("bar", bar, mu, in.scenes * in.plan.groups * size);
    const Tensor mu_bar = zeros(mu, {in.scenes, in.tets}), lam_bar = zeros(mu, {in.scenes, in.tets}),
                 gradient_bar = zeros(mu, {in.scenes, rest, 4, 3}), volume_bar = zeros(mu, {in.scenes, rest});
    for_bodies(in.scenes, in.plan.groups, [&](int64_t scene, int group) {
      const auto of = [&](const Tensor& t, int64_t own) { return data<T>(t) + scene * own * in.tets; };
      coarse::stiffness_vjp(in, scene, group, data<const T>(bar) + (scene * in.plan.groups + group) * size,
                            of(mu_bar, 1), of(lam_bar, 1), wants_rest ? of(gradient_bar, 12) : nullptr,
                            wants_rest ? of(volume_bar, 1) : nullptr);
    });
    return std::make_tuple(mu_bar, lam_bar, gradient_bar, volume_bar);
  });
}

Tensor mass(const Tensor& mass, const Tensor& plan, const Tensor& weights, std::vector<int64_t> sizes) {
  return dispatch_float(mass, [&](auto scalar) {
    using T = decltype(scalar);
    const coarse::Plan p = diffvbd::mass_plan(mass, plan, weights, sizes);
    const int64_t scenes = mass.size(0);
    diffvbd::require_like("mass", mass, mass, scenes * p.vertices);
    const T* weight = data<const T>(weights);
    const Tensor out = empty(mass, {scenes, p.cells}), at_position = zeros(mass, {scenes, p.positions});
    for (int64_t scene = 0; scene < scenes; ++scene) {
      for (int32_t i = 0; i < p.listed; ++i) {
        data<T>(at_position)[scene * p.positions + p.list_position[i]] =
            data<const T>(mass)[scene * p.vertices + p.list[i]];
      }
    }
    for_bodies(scenes, p.functions, [&](int64_t scene, int function) {
      coarse::mass_row(p, weight, weight + p.entries, data<const T>(at_position) + scene * p.positions, function,
                       data<T>(out) + scene * p.cells);
    });
    return out;
  });
}

Tensor mass_backward(const Tensor& bar, const Tensor& plan, const Tensor& weights, std::vector<int64_t> sizes) {
  return dispatch_float(bar, [&](auto scalar) {
    using T = decltype(scalar);
    const coarse::Plan p = diffvbd::mass_plan(bar, plan, weights, sizes);
    const int64_t scenes = bar.size(0);
    diffvbd::require_like("bar", bar, bar, scenes * p.cells);
    const Tensor out = zeros(bar, {scenes, p.vertices});
    for_bodies(scenes, p.listed, [&](int64_t scene, int i) {
      data<T>(out)[scene * p.vertices + p.list[i]] =
          coarse::mass_vjp(p, data<const T>(weights), data<const T>(bar) + scene * p.cells, p.list_position[i]);
    });
    return out;
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CPU, m) {
  m.impl("coarse_matrix", TORCH_BOX(&matrix));
  m.impl("coarse_matrix_backward", TORCH_BOX(&matrix_backward));
  m.impl("coarse_stiffness", TORCH_BOX(&stiffness));
  m.impl("coarse_stiffness_backward", TORCH_BOX(&stiffness_backward));
  m.impl("coarse_mass", TORCH_BOX(&mass));
  m.impl("coarse_mass_backward", TORCH_BOX(&mass_backward));
}
