// The tensors of coarse corrections, as the operators take them.
#pragma once

#include <algorithm>
#include <limits>
#include <vector>

#include "../subspace/coarse_matrix.h"
#include "arguments.h"
#include "fields.h"

namespace diffvbd {

// sizes: those of the plan, and how many sweeps come before
inline coarse::Plan coarse_plan(const Tensor& plan, const Tensor& x, const std::vector<int64_t>& sizes) {
  bool known = is_index(plan, x) && sizes.size() == coarse::kSizes;
  for (const int64_t size : sizes) known = known && size >= 0 && size <= std::numeric_limits<int32_t>::max();
  int64_t used = 0;
  coarse::Plan out{};
  if (known) out = coarse::view_plan(sizes.data(), data<const int32_t>(plan), used);
  require(known && used == plan.numel() && out.every > 0 && out.begun <= 1,
          "diffvbd: expected a plan of a coarse space, int32, and its sizes");
  return out;
}

// given: StepInputs of a backend
template <class T, class In, class Settings>
coarse::Inputs<T> coarse_inputs(const SweepFields& f, const Tensor& x, const Settings& q, const In& given,
                                int64_t positions) {
  require((given.energies & (kContact | kPaperBlock)) == 0 && !given.parameters.saturates,
          "diffvbd::sweep: coarse corrections take no contact, no paper block and no saturation");
  require(kPrevScalars == 0, "diffvbd::sweep: coarse corrections take no law that reads where a step began");
  coarse::Inputs<T> in{};
  in.plan = coarse_plan(f.coarse_plan, x, q.coarse);
  const coarse::Plan& p = in.plan;
  const int64_t b = x.size(0), cells = p.cells;
  require(p.positions == positions && p.vertices == x.size(1), "coarse_plan: expected one of this Model's sweeps");
  const Tensor& w = f.coarse_weights;
  require_like("coarse_weights", w, x, 2 * int64_t{p.entries});
  in.weight = data<const T>(w);
  in.row_weight = in.weight + p.entries;
  in.rest = batched<T>("coarse_rest", f.coarse_rest, x, b, int64_t{p.tet_blocks} * kRestScalars * kLanes);
  require_like("coarse_factor", f.coarse_factor, x, 9 * cells * b);
  in.factor = {data<const T>(f.coarse_factor), 9 * cells, 1};
  in.mass = batched<T>("coarse_mass", f.coarse_mass, x, b, cells);
  in.keeps_positions = keeps_positions(given.energies);
  in.has_vertex_blocks = has_vertex_energy(given.energies);
  in.corrections = coarse::corrections_of(given.sweeps, p.every, p.begun);
  return in;
}

template <class T>
coarse::MatrixInputs<T> matrix_inputs(const CoarseFields& f, const std::vector<int64_t>& sizes, double time_step) {
  const Tensor& x = f.x_prev;
  require_positions(x);
  require(time_step > 0, "diffvbd::coarse_matrix: expected time_step > 0");
  coarse::MatrixInputs<T> in{};
  in.plan = coarse_plan(f.plan, x, sizes);
  const coarse::Plan& p = in.plan;
  require(p.vertices == x.size(1), "diffvbd::coarse_matrix: expected the plan of this mesh");
  in.scenes = x.size(0), in.vertices = x.size(1), in.time_step = time_step;
  in.x_prev = data<const T>(x);
  require_like("moments", f.moments, x, 3 * int64_t{p.moments});
  in.moment = data<const T>(f.moments);
  require(f.volume.scalar_type() == ScalarType::Double && f.volume.is_contiguous() && f.volume.numel() == p.groups,
          "diffvbd::coarse_matrix: expected volume float64 [groups]");
  in.volume = data<const double>(f.volume);
  in.stiffness = batched<T>("stiffness", f.stiffness, x, in.scenes, int64_t{9} * p.groups * p.width * p.width);
  in.mass = batched<T>("mass", f.mass, x, in.scenes, p.cells);
  return in;
}

// gradients [1 | B, tets, 4, 3] of the tets' shape functions
template <class T>
coarse::StiffnessInputs<T> stiffness_inputs(const Tensor& mu, const Tensor& lam, const Tensor& gradients,
                                            const Tensor& volume, const Tensor& plan, const Tensor& weights,
                                            const std::vector<int64_t>& sizes) {
  require(gradients.dim() == 4 && gradients.size(2) == 4 && gradients.size(3) == 3,
          "diffvbd::coarse_stiffness: expected gradients [scenes, tets, 4, 3]");
  coarse::StiffnessInputs<T> in{};
  in.plan = coarse_plan(plan, mu, sizes);
  require_like("weights", weights, mu, 2 * int64_t{in.plan.entries});
  in.weight = data<const T>(weights);
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

inline coarse::Plan mass_plan(const Tensor& mass, const Tensor& plan, const Tensor& weights,
                              const std::vector<int64_t>& sizes) {
  const coarse::Plan p = coarse_plan(plan, mass, sizes);
  require_like("weights", weights, mass, 2 * int64_t{p.entries});
  return p;
}

}  // namespace diffvbd
