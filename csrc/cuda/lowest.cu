#include "lowest.h"

namespace diffvbd::cuda {
namespace {

constexpr int kThreads = 128;

// A block for each scene, body and plane.
template <class T>
__global__ void of_bodies(const __grid_constant__ contact::SupportVertexInputs<T> in, int32_t* own) {
  __shared__ contact::SupportVertex<T> part[kThreads];
  const int32_t plane = static_cast<int32_t>(blockIdx.x % in.num_planes);
  const int64_t row = blockIdx.x / in.num_planes;
  part[threadIdx.x] = contact::support_vertex_of_body(in, row / in.bodies, static_cast<int32_t>(row % in.bodies), plane,
                                              static_cast<int32_t>(threadIdx.x), kThreads);
  for (int half = kThreads / 2; half > 0; half /= 2) {
    __syncthreads();
    if (threadIdx.x < half) part[threadIdx.x].keep(part[threadIdx.x + half]);
  }
  if (threadIdx.x == 0) own[blockIdx.x] = part[0].vertex;
}

template <class T>
__global__ void of_islands(const __grid_constant__ contact::SupportVertexInputs<T> in, const int32_t* own, int32_t* out) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x, row = i / in.num_planes;
  if (row >= in.scenes * in.bodies) return;
  out[i] = contact::support_vertex_of_island(in, own, row / in.bodies, static_cast<int32_t>(row % in.bodies),
                                     static_cast<int32_t>(i % in.num_planes));
}

}  // namespace

template <class T>
cudaError_t lowest_vertices(const contact::SupportVertexInputs<T>& in, int32_t* own, int32_t* out, cudaStream_t stream) {
  const int64_t items = in.scenes * in.bodies * in.num_planes;
  if (items == 0) return cudaSuccess;
  of_bodies<<<static_cast<unsigned>(items), kThreads, 0, stream>>>(in, own);
  of_islands<<<static_cast<unsigned>((items + kThreads - 1) / kThreads), kThreads, 0, stream>>>(in, own, out);
  return cudaGetLastError();
}

template cudaError_t lowest_vertices<float>(const contact::SupportVertexInputs<float>&, int32_t*, int32_t*, cudaStream_t);
template cudaError_t lowest_vertices<double>(const contact::SupportVertexInputs<double>&, int32_t*, int32_t*, cudaStream_t);

}  // namespace diffvbd::cuda
