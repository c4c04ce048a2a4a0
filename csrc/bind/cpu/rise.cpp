// CPU implementation of potential_rise: how the incremental potential of each body changes from one state to another.
#include <torch/csrc/stable/library.h>

#include <cmath>
#include <limits>
#include <vector>

#include "../../coarse/length.h"
#include "../../cpu/bodies.h"
#include "../../cpu/kernels.h"
#include "../rigid.h"

namespace {

namespace coarse = diffvbd::coarse;
namespace rigid = diffvbd::rigid;
using diffvbd::Batched, diffvbd::batched, diffvbd::Buffer, diffvbd::data, diffvbd::dispatch_float, diffvbd::for_bodies,
    diffvbd::is_index, diffvbd::kLanes, diffvbd::kRestScalars, diffvbd::kTetScalars, diffvbd::require,
    diffvbd::require_like, diffvbd::RigidFields, diffvbd::Threads;
using torch::headeronly::ScalarType;
using torch::stable::Tensor;

template <class T>
struct Tets {
  const int32_t *corner, *ptr;  // [blocks, 4, kLanes]  four times a vertex; [bodies + 1]
  Batched<const T> rest, material;
};

// x[i] and to[i] - x[i] as rows of four
template <class T>
void pack(const T* x, const T* to, int64_t vertices, T* at, T* way) {
  for (int64_t v = 0; v < vertices; ++v) {
    for (int c = 0; c < 3; ++c) {
      at[4 * v + c] = x[3 * v + c];
      way[4 * v + c] = to[3 * v + c] - x[3 * v + c];
    }
  }
}

// The rise, and how much of it is rounding at most; infinite where a vertex would be too near a plane.
template <class T>
void rise(const rigid::Body<T>& b, const Threads& team, const Tets<T>& tets, const T* to, const T* at, const T* way,
          const diffvbd::CoarseKernels<T>& kernels, double* out) {
  double vertices[3];
  team.template sum<3>(b.size(), vertices, [&](int32_t i, double* sum) {
    const int32_t v = b.vertex(i);
    const rigid::Vector one = b.position(v), two = rigid::Body<T>::at(to + 3 * b.row(v)), step = two - one;
    const double inertial = b.mass(v) * dot(step, 0.5 * (one + two) - b.target(v));
    sum[0] += inertial, sum[1] += std::abs(inertial);
    b.energies(v, [&](auto energy, int, const double* values, int count) {
      using E = decltype(energy);
      const auto there = b.state(v, two);
      if constexpr (E::has_filter) {
        if (!E::template admits<T>(there, one, values, count, rigid::kLeastShare)) sum[2] += 1;
      }
      const double before = E::value(b.state(v, one), values, count), after = E::value(there, values, count);
      sum[0] += after - before, sum[1] += std::abs(before) + std::abs(after);
    });
  });
  double change[2 * coarse::kDegree];
  const int32_t first = tets.ptr[b.body];
  const T* rest = tets.rest.data + b.scene * tets.rest.scene;
  const T* material = tets.material.data + b.scene * tets.material.scene;
  team.template sum<2 * coarse::kDegree>(tets.ptr[b.body + 1] - first, change, [&](int32_t i, double* sum) {
    double c[coarse::kDegree] = {};
    kernels.line(tets.corner, rest, material, at, way, first + i, first + i + 1, c);
    for (int k = 0; k < coarse::kDegree; ++k) sum[k] += c[k], sum[coarse::kDegree + k] += std::abs(c[k]);
  });
  const double h2 = b.in.time_step * b.in.time_step;
  out[0] = vertices[0], out[1] = vertices[1];
  for (int k = 0; k < coarse::kDegree; ++k) out[0] += h2 * change[k], out[1] += h2 * change[coarse::kDegree + k];
  if (vertices[2] > 0) out[0] = std::numeric_limits<double>::infinity();
}

Tensor potential_rise(const Tensor& x, const Tensor& to, const Tensor& x_prev, const Tensor& y, const Tensor& mass,
                      const Tensor& energy_data, const Tensor& origin, const Tensor& material, const Tensor& rest,
                      const Tensor& order, const Tensor& ptr, const Tensor& other, const Tensor& corner,
                      const Tensor& block_ptr, std::vector<int64_t> data_count, double time_step) {
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const RigidFields fields{x, x_prev, y, mass, energy_data, origin, order, ptr, order, other};
    const auto in = diffvbd::rigid_inputs<T>(fields, data_count, time_step, false);
    require_like("to", to, x, x.numel());
    require(is_index(corner, x) && corner.dim() == 3 && corner.size(1) == 4 && corner.size(2) == kLanes &&
                is_index(block_ptr, x) && block_ptr.numel() == in.bodies + 1,
            "diffvbd::potential_rise: expected corner [blocks, 4, lanes] and block_ptr [bodies + 1], int32");
    const int64_t scenes = in.scenes, vertices = in.vertices, blocks = corner.size(0);
    Tets<T> tets{data<const int32_t>(corner), data<const int32_t>(block_ptr), {}, {}};
    tets.rest = batched<T>("rest", rest, x, scenes, blocks * kRestScalars * kLanes);
    tets.material = batched<T>("material", material, x, scenes, blocks * kTetScalars * kLanes);
    const Buffer<T> at(size_t(scenes * vertices) * 4, true), way(size_t(scenes * vertices) * 4, true);
    pack(data<const T>(x), data<const T>(to), scenes * vertices, at.get(), way.get());
    const auto kernels = diffvbd::coarse_kernels<T>(diffvbd::kExactBlock);
    Tensor out = torch::stable::empty({scenes, in.bodies, 2}, ScalarType::Double);
    for_bodies(in, [&](const rigid::Body<T>& body, const Threads& team) {
      const int64_t first = 4 * body.scene * vertices;
      rise(body, team, tets, data<const T>(to), at.get() + first, way.get() + first, kernels,
           data<double>(out) + 2 * (body.scene * in.bodies + body.body));
    });
    return out;
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CPU, m) { m.impl("potential_rise", TORCH_BOX(&potential_rise)); }
