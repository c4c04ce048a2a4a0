// Rigid correction of bodies and the increase of their energy.
#include "bodies.cuh"
#include "bodies.h"
#include "common.cuh"

namespace diffvbd::cuda {
namespace {

// Actions of the kernels on a body: the correction and its transpose.
template <class T, bool energies>
struct Forward {
  static constexpr bool keeps_record = false, computes = energies;
  T *x, *velocity;
  template <class Team>
  __device__ void operator()(const rigid::Body<T>& body, const Team& team, rigid::Iteration*) const {
    rigid::correct<energies>(body, team, nullptr, x, velocity);
  }
};
template <class T, bool energies>
struct Reverse {
  static constexpr bool keeps_record = energies, computes = energies;
  rigid::Adjoints<T> a;
  template <class Team>
  __device__ void operator()(const rigid::Body<T>& body, const Team& team, rigid::Iteration* record) const {
    rigid::reverse<energies>(body, team, record, a);
  }
};

template <class T>
__global__ void __launch_bounds__(kVertexThreads)
    keep_vertices(const __grid_constant__ rigid::Inputs<T> in, T* x, T* velocity) {
  const Row row(in);
  if (row.exists) keep_vertex(in, row.scene, row.vertex, x, velocity);
}
template <class T>
__global__ void __launch_bounds__(kVertexThreads)
    reverse_vertices(const __grid_constant__ rigid::Inputs<T> in, const __grid_constant__ rigid::Adjoints<T> a) {
  const Row row(in);
  if (row.exists) reverse_kept(in, a, row.scene, row.vertex);
}

using coarse::kBlockTets, coarse::kDegree, coarse::IncreaseInputs;
using rigid::Body, rigid::Vector;

// Coefficients of h^2 times the energy of a lane's tet along the displacement.
template <class T>
__device__ void tet_line(const IncreaseInputs<T>& in, int64_t scene, int64_t block, int lane, double (&c)[kDegree]) {
  constexpr int kRest = kRestScalars, kMaterial = kMaterialScalars;
  const T* rest = in.rest.data + scene * in.rest.scene + block * kRest * kBlockTets + lane;
  const T* material = in.material.data + scene * in.material.scene + block * kMaterial * kBlockTets + lane;
  double own_rest[kRest], own_material[kMaterial];
  for (int i = 0; i < kRest; ++i) own_rest[i] = rest[i * kBlockTets];
  for (int i = 0; i < kMaterial; ++i) own_material[i] = material[i * kBlockTets];
  Vector at[4], displacement[4];
  for (int k = 0; k < 4; ++k) {
    const int64_t v = in.corner[(4 * block + k) * kBlockTets + lane] / 4;
    const int64_t row = 3 * (scene * in.bodies.vertices + v);
    at[k] = diffvbd::wide_at(in.bodies.x + row);
    displacement[k] = diffvbd::wide_at(in.to + row) - at[k];
  }
  TetLaw::line(at, displacement, own_rest, own_material, c);
  for (double& power : c) power *= in.bodies.time_step * in.bodies.time_step;
}

// Increase and magnitude of each block of tets and of each listed vertex, a thread for each tet and vertex.
template <class T>
__global__ void __launch_bounds__(kThreads)
    increase_of_parts(const __grid_constant__ IncreaseInputs<T> in, double* parts) {
  const int64_t item = own_item(kThreads);
  const int64_t tets = in.bodies.scenes * in.blocks * kBlockTets, rows = in.blocks + in.listed;
  if (item < tets) {
    const int64_t block = item / kBlockTets % in.blocks, scene = item / kBlockTets / in.blocks;
    const int lane = static_cast<int>(item % kBlockTets);
    double c[kDegree] = {};
    tet_line(in, scene, block, lane, c);
    // blocks begin at multiples of kBlockTets: all their lanes are here
    const unsigned mask = ((1u << kBlockTets) - 1) << (threadIdx.x % 32 / kBlockTets * kBlockTets);
    butterfly<kDegree, kBlockTets>(mask, c);
    if (lane != 0) return;
    double *to = parts + 2 * (scene * rows + block), increase = 0, size = 0;
    for (const double power : c) increase += power, size += absolute(power);
    to[0] = increase, to[1] = size;
    return;
  }
  const int64_t row = item - tets;
  if (row >= in.bodies.scenes * in.listed) return;
  const int64_t scene = row / in.listed, place = row % in.listed;
  const Body<T> all{in.bodies, scene, 0};  // any body will do
  const int32_t v = in.bodies.order[place];
  double sum[3] = {0, 0, 0};
  rigid::add_energy_increase(all, v, diffvbd::wide_at(in.to + 3 * all.row(v)), sum);
  double* to = parts + 2 * (scene * rows + in.blocks + place);
  to[0] = sum[2] > 0 ? CUDART_INF : sum[0], to[1] = sum[1];
}

// A block for each body of each scene.
template <class T>
__global__ void __launch_bounds__(kThreads)
    increase_of_bodies(const __grid_constant__ IncreaseInputs<T> in, const double* parts, double* out) {
  __shared__ double part[kWarps][kMostSums];
  const int32_t n = in.bodies.bodies, k = static_cast<int32_t>(blockIdx.x % n);
  const double* own = parts + 2 * (blockIdx.x / n) * (in.blocks + in.listed);
  const int32_t first = in.block_ptr[k], blocks = in.block_ptr[k + 1] - first;
  const int32_t start = in.bodies.ptr[k], vertices = in.bodies.ptr[k + 1] - start;
  double sum[2];
  BlockTeam{part}.template sum<2>(blocks + vertices, sum, [&](int32_t i, double* to) {
    const double* row = own + 2 * (i < blocks ? first + i : in.blocks + start + i - blocks);
    to[0] += row[0], to[1] += row[1];
  });
  if (threadIdx.x == 0) out[2 * blockIdx.x] = sum[0], out[2 * blockIdx.x + 1] = sum[1];
}

}  // namespace

int64_t bodies_workspace(const BodyGroups& groups, int64_t scenes, int64_t vertices) {
  if (groups.large == 0 || by_block(groups, scenes, vertices)) return 0;
  return int64_t{2} * multiprocessors() * kMostSums;
}

template <class T>
cudaError_t rigid_correct(const rigid::Inputs<T>& in, const BodyGroups& groups, bool others, T* x, T* velocity,
                          double* workspace, cudaStream_t stream) {
  if (in.scenes * in.vertices == 0) return cudaSuccess;
  if (others) keep_vertices<T><<<blocks_of(in), kVertexThreads, 0, stream>>>(in, x, velocity);
  if (in.data.data) return run_bodies(in, groups, Forward<T, true>{x, velocity}, workspace, stream);
  return run_bodies(in, groups, Forward<T, false>{x, velocity}, workspace, stream);
}

template <class T>
cudaError_t rigid_reverse(const rigid::Inputs<T>& in, const BodyGroups& groups, bool others,
                          const rigid::Adjoints<T>& a, double* workspace, cudaStream_t stream) {
  if (in.scenes * in.vertices == 0) return cudaSuccess;
  if (others) reverse_vertices<T><<<blocks_of(in), kVertexThreads, 0, stream>>>(in, a);
  if (in.data.data) return run_bodies(in, groups, Reverse<T, true>{a}, workspace, stream);
  return run_bodies(in, groups, Reverse<T, false>{a}, workspace, stream);
}

template <class T>
cudaError_t energy_increase(const IncreaseInputs<T>& in, double* workspace, double* out, cudaStream_t stream) {
  const int64_t bodies = in.bodies.scenes * in.bodies.bodies;
  if (bodies == 0) return cudaSuccess;
  const int64_t items = in.bodies.scenes * (in.blocks * kBlockTets + in.listed);
  if (items > 0) {
    increase_of_parts<T><<<blocks_for(items, kThreads), kThreads, 0, stream>>>(in, workspace);
  }
  increase_of_bodies<T><<<static_cast<unsigned>(bodies), kThreads, 0, stream>>>(in, workspace, out);
  return cudaGetLastError();
}

DIFFVBD_INSTANTIATE(energy_increase)
#ifndef DIFFVBD_LAW_HEADER  // the rest reads no law
DIFFVBD_INSTANTIATE(rigid_correct)
DIFFVBD_INSTANTIATE(rigid_reverse)
#endif

}  // namespace diffvbd::cuda
