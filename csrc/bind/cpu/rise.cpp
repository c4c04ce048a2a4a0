// CPU implementation of the rise of the potentials of bodies.
#include "../rise.h"

#include <torch/csrc/stable/library.h>

#include <cmath>
#include <limits>
#include <vector>

#include "../../cpu/threads.h"
#include "../../cpu/kernels.h"
#include "sweep.h"

namespace {

namespace coarse = diffvbd::coarse;
namespace rigid = diffvbd::rigid;
using diffvbd::Buffer, diffvbd::data, diffvbd::dispatch_float, diffvbd::for_bodies, diffvbd::require, diffvbd::Threads;
using torch::headeronly::ScalarType;
using torch::stable::Tensor;

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
void rise(const coarse::IncreaseInputs<T>& in, const rigid::Body<T>& b, const Threads& team, const T* at, const T* way,
          const diffvbd::CoarseKernels<T>& kernels, double* out) {
  double vertices[3];
  team.template sum<3>(b.size(), vertices, [&](int32_t i, double* sum) {
    const int32_t v = b.vertex(i);
    rigid::add_energy_increase(b, v, diffvbd::wide_at(in.to + 3 * b.row(v)), sum);
  });
  double change[2 * coarse::kDegree];
  const int32_t first = in.block_ptr[b.body];
  const T* rest = in.rest.data + b.scene * in.rest.scene;
  const T* material = in.material.data + b.scene * in.material.scene;
  team.template sum<2 * coarse::kDegree>(in.block_ptr[b.body + 1] - first, change, [&](int32_t i, double* sum) {
    double c[coarse::kDegree] = {};
    kernels.line(in.corner, rest, material, at, way, first + i, first + i + 1, c);
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
  static_assert(coarse::kBlockTets == diffvbd::kLanes);
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::rise_inputs<T>({x, x_prev, y, mass, energy_data, origin, order, ptr, order, other}, to,
                                            material, rest, corner, block_ptr, data_count, time_step);
    const int64_t scenes = in.bodies.scenes, vertices = in.bodies.vertices, bodies = in.bodies.bodies;
    require(in.bodies.ptr[bodies] <= in.listed, "diffvbd::potential_rise: expected order with all vertices of ptr");
    const Buffer<T> at(size_t(scenes * vertices) * 4, true), way(size_t(scenes * vertices) * 4, true);
    pack(in.bodies.x, in.to, scenes * vertices, at.get(), way.get());
    const auto kernels = diffvbd::coarse_kernels<T>(diffvbd::kExactBlock);
    Tensor out = torch::stable::empty({scenes, bodies, 2}, ScalarType::Double);
    for_bodies(in.bodies, [&](const rigid::Body<T>& body, const Threads& team) {
      const int64_t first = 4 * body.scene * vertices;
      rise(in, body, team, at.get() + first, way.get() + first, kernels,
           data<double>(out) + 2 * (body.scene * bodies + body.body));
    });
    return out;
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CPU, m) { m.impl("potential_rise", TORCH_BOX(&potential_rise)); }
