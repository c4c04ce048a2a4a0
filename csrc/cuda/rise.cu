#include "bodies.cuh"
#include "rise.h"

namespace diffvbd::cuda {
namespace {

using coarse::kBlockTets, coarse::kDegree, coarse::IncreaseInputs;
using rigid::Body, rigid::Vector;

// The tet of a lane of a block: h^2 times the coefficients of its energy along the way.
template <class T>
__device__ void tet_line(const IncreaseInputs<T>& in, int64_t scene, int64_t block, int lane, double (&c)[kDegree]) {
  constexpr int kRest = kRestScalars, kMaterial = kTetScalars;
  const T* rest = in.rest.data + scene * in.rest.scene + block * kRest * kBlockTets + lane;
  const T* material = in.material.data + scene * in.material.scene + block * kMaterial * kBlockTets + lane;
  double own_rest[kRest], own_material[kMaterial];
  for (int i = 0; i < kRest; ++i) own_rest[i] = rest[i * kBlockTets];
  for (int i = 0; i < kMaterial; ++i) own_material[i] = material[i * kBlockTets];
  Vector at[4], way[4];
  for (int k = 0; k < 4; ++k) {
    const int64_t v = in.corner[(4 * block + k) * kBlockTets + lane] / 4;
    const int64_t row = 3 * (scene * in.bodies.vertices + v);
    at[k] = wide_at(in.bodies.x + row);
    way[k] = wide_at(in.to + row) - at[k];
  }
  TetLaw::line(at, way, own_rest, own_material, c);
  for (double& power : c) power *= in.bodies.time_step * in.bodies.time_step;
}

// A thread for each tet, then for each listed vertex: rise and size of each block of tets, and of each vertex.
template <class T>
__global__ void __launch_bounds__(kThreads) rise_of_parts(const __grid_constant__ IncreaseInputs<T> in, double* parts) {
  const int64_t item = int64_t{blockIdx.x} * kThreads + threadIdx.x;
  const int64_t tets = in.bodies.scenes * in.blocks * kBlockTets, rows = in.blocks + in.listed;
  if (item < tets) {
    const int64_t block = item / kBlockTets % in.blocks, scene = item / kBlockTets / in.blocks;
    const int lane = static_cast<int>(item % kBlockTets);
    double c[kDegree] = {};
    tet_line(in, scene, block, lane, c);
    // blocks begin at multiples of kBlockTets: all lanes of one are here
    const unsigned mask = ((1u << kBlockTets) - 1) << (threadIdx.x % 32 / kBlockTets * kBlockTets);
    butterfly<kDegree, kBlockTets>(mask, c);
    if (lane != 0) return;
    double *to = parts + 2 * (scene * rows + block), rise = 0, size = 0;
    for (const double power : c) rise += power, size += absolute(power);
    to[0] = rise, to[1] = size;
    return;
  }
  const int64_t row = item - tets;
  if (row >= in.bodies.scenes * in.listed) return;
  const int64_t scene = row / in.listed, place = row % in.listed;
  const Body<T> all{in.bodies, scene, 0};  // which body it is of does not matter here
  const int32_t v = in.bodies.order[place];
  double sum[3] = {0, 0, 0};
  rigid::add_energy_increase(all, v, wide_at(in.to + 3 * all.row(v)), sum);
  double* to = parts + 2 * (scene * rows + in.blocks + place);
  to[0] = sum[2] > 0 ? CUDART_INF : sum[0], to[1] = sum[1];
}

// A block for each body of each scene.
template <class T>
__global__ void __launch_bounds__(kThreads)
    rise_of_bodies(const __grid_constant__ IncreaseInputs<T> in, const double* parts, double* out) {
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

template <class T>
cudaError_t potential_rise(const IncreaseInputs<T>& in, double* workspace, double* out, cudaStream_t stream) {
  const int64_t bodies = in.bodies.scenes * in.bodies.bodies;
  if (bodies == 0) return cudaSuccess;
  const int64_t items = in.bodies.scenes * (in.blocks * kBlockTets + in.listed);
  if (items > 0) {
    rise_of_parts<T><<<static_cast<unsigned>((items + kThreads - 1) / kThreads), kThreads, 0, stream>>>(in, workspace);
  }
  rise_of_bodies<T><<<static_cast<unsigned>(bodies), kThreads, 0, stream>>>(in, workspace, out);
  return cudaGetLastError();
}

template cudaError_t potential_rise<float>(const IncreaseInputs<float>&, double*, double*, cudaStream_t);
template cudaError_t potential_rise<double>(const IncreaseInputs<double>&, double*, double*, cudaStream_t);

}  // namespace diffvbd::cuda
