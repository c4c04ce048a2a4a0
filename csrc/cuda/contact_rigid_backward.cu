#include "../contact/rigid_reverse.h"
#include "contact_rigid.cuh"

namespace diffvbd::cuda {
namespace {

constexpr int kPartsApart = 16;  // threads of a pair: one for each part of its work, in a half of a warp
static_assert(kWorkParts <= kPartsApart);

template <class T>
__global__ void __launch_bounds__(kOne)
    work_kernel(const __grid_constant__ RigidInputs<T> in, VirtualMotions<T> given, RigidWork<T> out) {
  const int64_t row = own_item() / kPartsApart;
  const int part = static_cast<int>(threadIdx.x % kPartsApart);
  if (part >= kWorkParts) return;
  if (row < out.listed) {
    const BarrierWork<T> work(in, given, row);
    work.store(part, out.barrier + 4 * kWorkScalars * row, out.by_kappa + row);
  } else if (row < out.listed + out.lagged) {
    const int64_t i = row - out.listed;
    const LaggedWork<T> work(in, given, i);
    work.store(part, out.friction + 4 * kWorkScalars * i, out.by_lag + kLagScalars * i);
  }
}

// A block for each body of each scene.
template <class T>
__global__ void __launch_bounds__(kThreads)
    end_kernel(const __grid_constant__ RigidInputs<T> in, const double* motions, const double* shares, const T* end_bar,
               double* motion_bar, T* x, T* mass) {
  __shared__ double part[kWarps][kMostSums];
  const int64_t item = blockIdx.x, at = kUnknowns * item;
  const Body<T> body{in.scene, item / in.bodies(), static_cast<int32_t>(item % in.bodies())};
  reverse_end(body, BlockTeam{part}, motions + at, shares[item], end_bar, motion_bar + at, x, mass);
}

template <class T>
__global__ void __launch_bounds__(kThreads)
    motion_kernel(const __grid_constant__ RigidInputs<T> in, const double* motions, double* solutions, T* p, T* q) {
  __shared__ double part[kWarps][kMostSums];
  const int64_t item = blockIdx.x, at = kUnknowns * item;
  const Body<T> body{in.scene, item / in.bodies(), static_cast<int32_t>(item % in.bodies())};
  virtual_motion(in, body, BlockTeam{part}, motions + at, solutions + at, p, q);
}

template <class T>
__global__ void __launch_bounds__(kThreads)
    vertices_kernel(const __grid_constant__ RigidInputs<T> in, const double* motions, const double* solutions,
                    VirtualMotions<T> sent, const __grid_constant__ rigid::Adjoints<T> out, T* floor_lag) {
  __shared__ double part[kWarps][kMostSums];
  const int64_t item = blockIdx.x, at = kUnknowns * item;
  const Body<T> body{in.scene, item / in.bodies(), static_cast<int32_t>(item % in.bodies())};
  reverse_vertices(in, body, BlockTeam{part}, motions + at, solutions + at, sent, out, floor_lag);
}

template <class T>
unsigned blocks_of_bodies(const RigidInputs<T>& in) {
  return static_cast<unsigned>(in.scene.scenes * in.bodies());
}

}  // namespace

template <class T>
cudaError_t rigid_end_backward(const RigidInputs<T>& in, const double* motions, const double* shares, const T* end_bar,
                               const double* factor, double* solutions, T* x, T* mass, T* p, T* q,
                               cudaStream_t stream) {
  if (blocks_of_bodies(in) == 0) return cudaSuccess;
  end_kernel<T><<<blocks_of_bodies(in), kThreads, 0, stream>>>(in, motions, shares, end_bar, solutions, x, mass);
  if (auto error = cholesky_solve(in.systems(), in.system_size(), factor, solutions, stream)) return error;
  motion_kernel<T><<<blocks_of_bodies(in), kThreads, 0, stream>>>(in, motions, solutions, p, q);
  return cudaGetLastError();
}

template <class T>
cudaError_t rigid_vertices_backward(const RigidInputs<T>& in, const double* motions, const double* solutions,
                                    const VirtualMotions<T>& sent, const rigid::Adjoints<T>& out, T* floor_lag,
                                    cudaStream_t stream) {
  if (blocks_of_bodies(in) == 0) return cudaSuccess;
  vertices_kernel<T><<<blocks_of_bodies(in), kThreads, 0, stream>>>(in, motions, solutions, sent, out, floor_lag);
  return cudaGetLastError();
}

template <class T>
cudaError_t rigid_backward(const RigidInputs<T>& in, const VirtualMotions<T>& given, const RigidWork<T>& out,
                           cudaStream_t stream) {
  const int64_t rows = out.listed + out.lagged;
  if (rows > 0) work_kernel<T><<<blocks_for(kPartsApart * rows), kOne, 0, stream>>>(in, given, out);
  return cudaGetLastError();
}

#define DIFFVBD_INSTANTIATE(T)                                                                                 \
  template cudaError_t rigid_end_backward<T>(const RigidInputs<T>&, const double*, const double*, const T*,    \
                                             const double*, double*, T*, T*, T*, T*, cudaStream_t);            \
  template cudaError_t rigid_vertices_backward<T>(const RigidInputs<T>&, const double*, const double*,         \
                                                  const VirtualMotions<T>&, const rigid::Adjoints<T>&, T*,     \
                                                  cudaStream_t);                                               \
  template cudaError_t rigid_backward<T>(const RigidInputs<T>&, const VirtualMotions<T>&, const RigidWork<T>&, \
                                         cudaStream_t);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd::cuda
