// Trust-region radii of the sweeps (contact/trust_region.h).
#include "bodies.cuh"
#include "common.cuh"
#include "contact.h"

namespace diffvbd::cuda {
namespace {

using contact::SweepRadiusInputs;

constexpr int kHalfBlock = 128;  // threads of the kernels with a short reduction

// A block for each body of each scene.
template <class T>
__global__ void __launch_bounds__(kHalfBlock) wish_kernel(const __grid_constant__ SweepRadiusInputs<T> in, T* wishes) {
  __shared__ contact::SweepDisplacements<T> part[kHalfBlock];
  const int64_t row = blockIdx.x;
  part[threadIdx.x] = contact::displacements_of_body(in, row / in.bodies, row % in.bodies,
                                                     static_cast<int32_t>(threadIdx.x), kHalfBlock);
  reduce_block<kHalfBlock>(part, [](auto& own, const auto& other) { own.keep(other); });
  if (threadIdx.x == 0) wishes[row] = contact::wish_of_body(in, part[0], row);
}

// A block for each scene.
template <class T>
__global__ void __launch_bounds__(kHalfBlock)
    most_kernel(const __grid_constant__ SweepRadiusInputs<T> in, const T* wishes, T* most) {
  __shared__ T part[kHalfBlock];
  part[threadIdx.x] =
      contact::most_of_scene(in, wishes, int64_t{blockIdx.x}, static_cast<int32_t>(threadIdx.x), kHalfBlock);
  reduce_block<kHalfBlock>(part, [](T& own, const T& other) { own = larger(own, other); });
  if (threadIdx.x == 0) most[blockIdx.x] = part[0];
}

template <class T>
__global__ void __launch_bounds__(kHalfBlock)
    radius_kernel(const __grid_constant__ SweepRadiusInputs<T> in, const T* most, T* radii) {
  const int64_t row = own_item(kHalfBlock);
  if (row >= in.scenes * in.vertices) return;
  const int64_t scene = row / in.vertices;
  radii[row] = contact::sweep_radius(in, most[scene], scene, row % in.vertices);
}

}  // namespace

template <class T>
cudaError_t sweep_radii(const SweepRadiusInputs<T>& in, T* wishes, T* most, T* radii, cudaStream_t stream) {
  const int64_t vertices = in.scenes * in.vertices;
  if (vertices == 0) return cudaSuccess;
  wish_kernel<T><<<static_cast<unsigned>(in.scenes * in.bodies), kHalfBlock, 0, stream>>>(in, wishes);
  most_kernel<T><<<static_cast<unsigned>(in.scenes), kHalfBlock, 0, stream>>>(in, wishes, most);
  radius_kernel<T><<<blocks_for(vertices, kHalfBlock), kHalfBlock, 0, stream>>>(in, most, radii);
  return cudaGetLastError();
}

DIFFVBD_INSTANTIATE(sweep_radii)

}  // namespace diffvbd::cuda
