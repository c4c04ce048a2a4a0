#include "sweep_rooms.h"

namespace diffvbd::cuda {
namespace {

using contact::SweepRadiusInputs;
using contact::SweepDisplacements;

constexpr int kThreads = 128;

// The first element becomes what keep(element, other) makes of all.
template <class E, class F>
__device__ void reduce_block(E* part, const F& keep) {
  for (int half = kThreads / 2; half > 0; half /= 2) {
    __syncthreads();
    if (threadIdx.x < half) keep(part[threadIdx.x], part[threadIdx.x + half]);
  }
}

// A block for each body of each scene.
template <class T>
__global__ void __launch_bounds__(kThreads) wish_kernel(const __grid_constant__ SweepRadiusInputs<T> in, T* wishes) {
  __shared__ SweepDisplacements<T> part[kThreads];
  const int64_t row = blockIdx.x;
  part[threadIdx.x] =
      contact::displacements_of_body(in, row / in.bodies, row % in.bodies, static_cast<int32_t>(threadIdx.x), kThreads);
  reduce_block(part, [](SweepDisplacements<T>& own, const SweepDisplacements<T>& other) { own.keep(other); });
  if (threadIdx.x == 0) wishes[row] = contact::wish_of_body(in, part[0], row);
}

// A block for each scene.
template <class T>
__global__ void __launch_bounds__(kThreads)
    most_kernel(const __grid_constant__ SweepRadiusInputs<T> in, const T* wishes, T* most) {
  __shared__ T part[kThreads];
  part[threadIdx.x] =
      contact::most_of_scene(in, wishes, int64_t{blockIdx.x}, static_cast<int32_t>(threadIdx.x), kThreads);
  reduce_block(part, [](T& own, const T& other) { own = larger(own, other); });
  if (threadIdx.x == 0) most[blockIdx.x] = part[0];
}

template <class T>
__global__ void __launch_bounds__(kThreads)
    room_kernel(const __grid_constant__ SweepRadiusInputs<T> in, const T* most, T* rooms) {
  const int64_t row = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (row >= in.scenes * in.vertices) return;
  const int64_t scene = row / in.vertices;
  rooms[row] = contact::sweep_radius(in, most[scene], scene, row % in.vertices);
}

}  // namespace

template <class T>
cudaError_t sweep_rooms(const SweepRadiusInputs<T>& in, T* wishes, T* most, T* rooms, cudaStream_t stream) {
  const int64_t vertices = in.scenes * in.vertices;
  if (vertices == 0) return cudaSuccess;
  wish_kernel<T><<<static_cast<unsigned>(in.scenes * in.bodies), kThreads, 0, stream>>>(in, wishes);
  most_kernel<T><<<static_cast<unsigned>(in.scenes), kThreads, 0, stream>>>(in, wishes, most);
  room_kernel<T><<<static_cast<unsigned>((vertices + kThreads - 1) / kThreads), kThreads, 0, stream>>>(in, most, rooms);
  return cudaGetLastError();
}

template cudaError_t sweep_rooms<float>(const SweepRadiusInputs<float>&, float*, float*, float*, cudaStream_t);
template cudaError_t sweep_rooms<double>(const SweepRadiusInputs<double>&, double*, double*, double*, cudaStream_t);

}  // namespace diffvbd::cuda
