#include "bodies.cuh"
#include "unsupported.h"

namespace diffvbd::cuda {
namespace {

using contact::ResidualAdjoints;
using contact::ResidualInputs;

template <class T>
unsigned blocks_of_bodies(const ResidualInputs<T>& in) {
  return static_cast<unsigned>(in.scene.scenes * in.scene.bodies);
}
// That of a block.
template <class T>
__device__ rigid::Body<T> own_body(const ResidualInputs<T>& in) {
  const int64_t item = blockIdx.x;
  return {in.scene, item / in.scene.bodies, static_cast<int32_t>(item % in.scene.bodies)};
}

template <class T>
__global__ void __launch_bounds__(kThreads) lift_kernel(const __grid_constant__ ResidualInputs<T> in, T* out) {
  __shared__ double part[kWarps][kMostSums];
  contact::residual_acceleration(in, own_body(in), BlockTeam{part}, out);
}

template <class T>
__global__ void __launch_bounds__(kThreads)
    reverse_kernel(const __grid_constant__ ResidualInputs<T> in, const T* bar,
                   const __grid_constant__ ResidualAdjoints<T> out) {
  __shared__ double part[kWarps][kMostSums];
  contact::reverse_residual_acceleration(in, own_body(in), BlockTeam{part}, bar, out);
}

}  // namespace

template <class T>
cudaError_t unsupported(const ResidualInputs<T>& in, T* out, cudaStream_t stream) {
  if (blocks_of_bodies(in) == 0) return cudaSuccess;
  lift_kernel<T><<<blocks_of_bodies(in), kThreads, 0, stream>>>(in, out);
  return cudaGetLastError();
}

template <class T>
cudaError_t unsupported_backward(const ResidualInputs<T>& in, const T* bar, const ResidualAdjoints<T>& out,
                                 cudaStream_t stream) {
  if (blocks_of_bodies(in) == 0) return cudaSuccess;
  reverse_kernel<T><<<blocks_of_bodies(in), kThreads, 0, stream>>>(in, bar, out);
  return cudaGetLastError();
}

#define DIFFVBD_INSTANTIATE(T)                                                                                       \
  template cudaError_t unsupported<T>(const ResidualInputs<T>&, T*, cudaStream_t);                                \
  template cudaError_t unsupported_backward<T>(const ResidualInputs<T>&, const T*, const ResidualAdjoints<T>&, \
                                               cudaStream_t);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd::cuda
