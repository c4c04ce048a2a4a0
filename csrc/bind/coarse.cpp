// Operators of a coarse space: its matrices, and what they are made of. The corrections themselves belong to the
// sweeps.
#include "coarse.h"

namespace diffvbd {
namespace {

template <class T>
coarse::MatrixInputs<T> matrix_inputs(const CoarseFields& f, Ints sizes, double time_step) {
  const Reader<T> read(f.x_prev);
  require(time_step > 0, "diffvbd::coarse_matrix: expected time_step > 0");
  coarse::MatrixInputs<T> in{};
  in.plan = coarse_plan(f.plan, f.x_prev, sizes);
  const coarse::Plan& p = in.plan;
  require(p.vertices == read.v, "diffvbd::coarse_matrix: expected the plan of this mesh");
  in.scenes = read.b, in.vertices = read.v, in.time_step = time_step;
  in.x_prev = read.positions();
  in.moment = read.like("moments", f.moments, 3 * int64_t{p.moments});
  in.volume = read.doubles("volume", f.volume, p.groups);
  in.stiffness = read.batch("stiffness", f.stiffness, int64_t{9} * p.groups * p.width * p.width);
  in.mass = read.batch("mass", f.mass, p.cells);
  return in;
}

// The matrices of all bodies, one after the other, or if factored their Cholesky factors (CUDA: inverses: a product
// with one is many small sums at once, where factors are solved row after row).
DIFFVBD_OPERATOR(Tensor, coarse_matrix, DIFFVBD_PARAMETERS(COARSE) Ints sizes, double time_step, bool factored) {
  const CoarseFields f{DIFFVBD_ITEMS(COARSE)};
  const Device device(x_prev);
  return dispatch_float(x_prev, [&]<class T>(T) {
    const auto in = matrix_inputs<T>(f, sizes, time_step);
    const coarse::Plan& p = in.plan;
    const int64_t size = int64_t{9} * p.cells;
    const Tensor out = device({in.scenes, size}, !kOnCuda);
#ifdef USE_CUDA
    const int64_t b = in.scenes, edge = cuda::kEdge;
    const auto doubles = [&](int64_t count) { return device.empty({count}, ScalarType::Double); };
    const Tensor turn = doubles(b * p.groups * cuda::kGroupScalars), sums = doubles(b * size),
                 panel = doubles(b * 6 * p.functions * edge), block = doubles(b * p.bodies * edge * edge);
    const cuda::MatrixWork work{data<double>(turn), data<double>(sums), data<double>(panel), data<double>(block)};
    DIFFVBD_RUN(device, coarse_inverse<T>, in, work, data<T>(out), factored);
#else
    const auto kernels = coarse_kernels<T>(kExactBlock);
    for_items(in.scenes, p.bodies, 1, [&](int64_t scene, int body) {
      const int64_t at = scene * size + int64_t{9} * p.mass_ptr[body];
      const int64_t n = 3 * int64_t{p.function_ptr[body + 1] - p.function_ptr[body]};
      std::vector<T> work(std::max<int64_t>(9 * p.width, n * kLanes));
      coarse::assemble(in, scene, body, kernels.rotate, work.data(), data<T>(out) + scene * size);
      if (factored) kernels.factor(n, work.data(), data<T>(out) + at);
    });
#endif
    return out;
  });
}

// Adjoints of x_prev, stiffness and mass by that of the matrices.
DIFFVBD_OPERATOR(Out<3>, coarse_matrix_backward, DIFFVBD_PARAMETERS(COARSE) In bar, Ints sizes, double time_step) {
  const CoarseFields f{DIFFVBD_ITEMS(COARSE)};
  const Device device(x_prev);
  return dispatch_float(x_prev, [&]<class T>(T) {
    const auto in = matrix_inputs<T>(f, sizes, time_step);
    const coarse::Plan& p = in.plan;
    const int64_t cells = p.cells;
    const T* given = Reader<T>(x_prev).like("bar", bar, 9 * cells * in.scenes);
#ifdef USE_CUDA
    const int64_t stiffnesses = in.stiffness.scene == 0 ? 1 : in.scenes;
    const Tensor x_bar = device.like_x(), mass_bar = device.empty({in.scenes, cells}),
                 stiffness_bar = device.empty({stiffnesses, p.groups, 3, 3, p.width, p.width}),
                 turn = device.empty({in.scenes * p.groups * cuda::kGroupScalars}, ScalarType::Double);
    DIFFVBD_RUN(device, coarse_inverse_vjp<T>, in, given, data<double>(turn), data<T>(x_bar), data<T>(stiffness_bar),
                data<T>(mass_bar));
#else
    const int64_t size = int64_t{9} * p.groups * p.width * p.width;
    const Tensor x_bar = device.zeros({in.scenes, in.vertices, 3}), mass_bar = device.zeros({in.scenes, cells}),
                 stiffness_bar = device.zeros({in.scenes, p.groups, 3, 3, p.width, p.width});
    for_items(in.scenes, p.bodies, 1, [&](int64_t scene, int body) {
      coarse::assemble_vjp(in, scene, body, given + 9 * cells * scene, data<T>(x_bar) + 3 * in.vertices * scene,
                           data<T>(stiffness_bar) + size * scene, data<T>(mass_bar) + cells * scene);
    });
#endif
    return Out<3>(x_bar, stiffness_bar, mass_bar);
  });
}

#ifndef USE_CUDA  // there products of torch do the rest, see diffvbd/ops/coarse.py

// gradients [1 | B, tets, 4, 3] of the tets' shape functions
template <class T>
coarse::StiffnessInputs<T> stiffness_inputs(const Tensor& mu, const Tensor& lam, const Tensor& gradients,
                                            const Tensor& volume, const Tensor& plan, const Tensor& weights,
                                            Ints sizes) {
  require(gradients.dim() == 4 && gradients.size(2) == 4 && gradients.size(3) == 3,
          "diffvbd::coarse_stiffness: expected gradients [scenes, tets, 4, 3]");
  coarse::StiffnessInputs<T> in{};
  in.plan = coarse_plan(plan, mu, sizes);
  in.weight = array<T>("weights", weights, mu, mu.scalar_type(), 2 * int64_t{in.plan.entries});
  for (const Tensor* t : {&mu, &lam, &gradients, &volume}) {
    in.scenes = std::max(in.scenes, t->dim() > 0 ? t->size(0) : 0);
  }
  in.tets = gradients.size(1);
  in.mu = batched<T>("mu", mu, mu, in.scenes, in.tets, 1);
  in.lam = batched<T>("lam", lam, mu, in.scenes, in.tets, 1);
  in.gradient = batched<T>("gradients", gradients, mu, in.scenes, 12 * in.tets);
  in.volume = batched<T>("volume", volume, mu, in.scenes, in.tets);
  return in;
}

// The stiffness of each group at rest, see coarse/sums.h.
DIFFVBD_OPERATOR(Tensor, coarse_stiffness, In mu, In lam, In gradients, In volume, In plan, In weights, Ints sizes) {
  const Device device(mu);
  return dispatch_float(mu, [&]<class T>(T) {
    const auto in = stiffness_inputs<T>(mu, lam, gradients, volume, plan, weights, sizes);
    const int64_t width = in.plan.width, size = 9 * width * width;
    const Tensor out = device.empty({in.scenes, in.plan.groups, 3, 3, width, width});
    for_items(in.scenes, in.plan.groups, 1, [&](int64_t scene, int group) {
      coarse::stiffness(in, scene, group, data<T>(out) + (scene * in.plan.groups + group) * size);
    });
    return out;
  });
}

// Adjoints of the moduli [scenes, tets], and, where wanted, of the rest shape.
DIFFVBD_OPERATOR(Out<4>, coarse_stiffness_backward, In mu, In lam, In gradients, In volume, In plan, In weights, In bar,
                 Ints sizes, bool wants_rest) {
  const Device device(mu);
  return dispatch_float(mu, [&]<class T>(T) {
    const auto in = stiffness_inputs<T>(mu, lam, gradients, volume, plan, weights, sizes);
    const int64_t size = int64_t{9} * in.plan.width * in.plan.width, rest = wants_rest ? in.tets : 0;
    const T* given = array<T>("bar", bar, mu, mu.scalar_type(), in.scenes * in.plan.groups * size);
    const Tensor mu_bar = device.zeros({in.scenes, in.tets}), lam_bar = device.zeros({in.scenes, in.tets}),
                 gradient_bar = device.zeros({in.scenes, rest, 4, 3}), volume_bar = device.zeros({in.scenes, rest});
    for_items(in.scenes, in.plan.groups, 1, [&](int64_t scene, int group) {
      const auto of = [&](const Tensor& t, int64_t own) { return data<T>(t) + scene * own * in.tets; };
      coarse::stiffness_vjp(in, scene, group, given + (scene * in.plan.groups + group) * size, of(mu_bar, 1),
                            of(lam_bar, 1), wants_rest ? of(gradient_bar, 12) : nullptr,
                            wants_rest ? of(volume_bar, 1) : nullptr);
    });
    return Out<4>(mu_bar, lam_bar, gradient_bar, volume_bar);
  });
}

coarse::Plan mass_plan(const Tensor& mass, const Tensor& plan, const Tensor& weights, Ints sizes) {
  const coarse::Plan p = coarse_plan(plan, mass, sizes);
  require_like("weights", weights, mass, 2 * int64_t{p.entries});
  return p;
}

// W' M W of each body, from the masses of vertices; and the adjoint of these.
DIFFVBD_OPERATOR(Tensor, coarse_mass, In mass, In plan, In weights, Ints sizes) {
  const Device device(mass);
  return dispatch_float(mass, [&]<class T>(T) {
    const coarse::Plan p = mass_plan(mass, plan, weights, sizes);
    const int64_t scenes = mass.size(0);
    require_like("mass", mass, mass, scenes * p.vertices);
    const T* weight = data<const T>(weights);
    const Tensor out = device.empty({scenes, p.cells}), at_position = device.zeros({scenes, p.positions});
    for (int64_t scene = 0; scene < scenes; ++scene) {
      for (int32_t i = 0; i < p.listed; ++i) {
        data<T>(at_position)[scene * p.positions + p.list_position[i]] =
            data<const T>(mass)[scene * p.vertices + p.list[i]];
      }
    }
    for_items(scenes, p.functions, 1, [&](int64_t scene, int function) {
      coarse::mass_row(p, weight, weight + p.entries, data<const T>(at_position) + scene * p.positions, function,
                       data<T>(out) + scene * p.cells);
    });
    return out;
  });
}
DIFFVBD_OPERATOR(Tensor, coarse_mass_backward, In bar, In plan, In weights, Ints sizes) {
  const Device device(bar);
  return dispatch_float(bar, [&]<class T>(T) {
    const coarse::Plan p = mass_plan(bar, plan, weights, sizes);
    const int64_t scenes = bar.size(0);
    require_like("bar", bar, bar, scenes * p.cells);
    const Tensor out = device.zeros({scenes, p.vertices});
    for_items(scenes, p.listed, 1, [&](int64_t scene, int i) {
      data<T>(out)[scene * p.vertices + p.list[i]] =
          coarse::mass_vjp(p, data<const T>(weights), data<const T>(bar) + scene * p.cells, p.list_position[i]);
    });
    return out;
  });
}

#endif

}  // namespace
}  // namespace diffvbd
