#include "bodies.cuh"
#include "unsupported.h"

namespace diffvbd::cuda {
namespace {

using contact::UnsupportedAdjoints;
using contact::UnsupportedInputs;

template <class T>
unsigned blocks_of_bodies(const UnsupportedInputs<T>& in) {
  return static_cast<unsigned>(in.scene.scenes * in.scene.bodies);
}
// That of a block.
template <class T>
__device__ rigid::Body<T> own_body(const UnsupportedInputs<T>& in) {
  const int64_t item = blockIdx.x;
  return {in.scene, item / in.scene.bodies, static_cast<int32_t>(item % in.scene.bodies)};
}

template <class T>
__global__ void __launch_bounds__(kThreads) lift_kernel(const __grid_constant__ UnsupportedInputs<T> in, T* out) {
  __shared__ double part[kWarps][kMostSums];
  contact::leave_unsupported(in, own_body(in), BlockTeam{part}, out);
}

template <class T>
__global__ void __launch_bounds__(kThreads)
    reverse_kernel(const __grid_constant__ UnsupportedInputs<T> in, const T* bar,
                   const __grid_constant__ UnsupportedAdjoints<T> out) {
  __shared__ double part[kWarps][kMostSums];
  contact::reverse_unsupported(in, own_body(in), BlockTeam{part}, bar, out);
}

}  // namespace

template <class T>
cudaError_t unsupported(const UnsupportedInputs<T>& in, T* out, cudaStream_t stream) {
  if (blocks_of_bodies(in) == 0) return cudaSuccess;
  lift_kernel<T><<<blocks_of_bodies(in), kThreads, 0, stream>>>(in, out);
  return cudaGetLastError();
}

template <class T>
cudaError_t unsupported_backward(const UnsupportedInputs<T>& in, const T* bar, const UnsupportedAdjoints<T>& out,
                                 cudaStream_t stream) {
  if (blocks_of_bodies(in) == 0) return cudaSuccess;
  reverse_kernel<T><<<blocks_of_bodies(in), kThreads, 0, stream>>>(in, bar, out);
  return cudaGetLastError();
}

#define DIFFVBD_INSTANTIATE(T)                                                                                       \
  template cudaError_t unsupported<T>(const UnsupportedInputs<T>&, T*, cudaStream_t);                                \
  template cudaError_t unsupported_backward<T>(const UnsupportedInputs<T>&, const T*, const UnsupportedAdjoints<T>&, \
                                               cudaStream_t);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd::cuda
