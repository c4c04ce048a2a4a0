#include "../contact/rigid_reverse.h"
#include "clear.h"
#include "contact_rigid.cuh"

namespace diffvbd::cuda {
namespace {

constexpr int kPartsApart = 16;  // threads of a pair: one for each part of its work, in a half of a warp
static_assert(kWorkParts <= kPartsApart);

// The listed pairs that push, few of them: how many, and which, in any order.
template <class T>
__global__ void __launch_bounds__(kOne)
    pushing_kernel(const __grid_constant__ RigidInputs<T> in, int64_t listed, int32_t* pushing) {
  const int64_t row = own_item();
  if (row < listed && BarrierWork<T>::pushes(in, row)) pushing[1 + atomicAdd(pushing, 1)] = static_cast<int32_t>(row);
}

template <class T>
__global__ void __launch_bounds__(kOne)
    barrier_kernel(const __grid_constant__ RigidInputs<T> in, VirtualMotions<T> given, RigidWork<T> out,
                   const int32_t* pushing) {
  const int64_t i = own_item() / kPartsApart;
  const int part = static_cast<int>(threadIdx.x % kPartsApart);
  if (part >= kWorkParts || i >= *pushing) return;
  const int64_t row = pushing[1 + i];
  const BarrierWork<T> work(in, given, row, true);
  work.store(part, out.barrier + 4 * kWorkScalars * row, out.by_kappa + row);
}

template <class T>
__global__ void __launch_bounds__(kOne)
    friction_kernel(const __grid_constant__ RigidInputs<T> in, VirtualMotions<T> given, RigidWork<T> out) {
  const int64_t row = own_item();
  if (row >= out.lagged) return;
  const LaggedWork<T> work(in, given, row);
  T *rows = out.friction + 4 * kWorkScalars * row, *by_lag = out.by_lag + kLagScalars * row;
  work.acts ? work.store(rows, by_lag) : work.store_none(rows, by_lag);
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
  if (auto error = solve_groups(in, factor, solutions, stream)) return error;
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
                           int32_t* pushing, cudaStream_t stream) {
  if (out.listed > 0) {
    constexpr auto kBytes = static_cast<int64_t>(sizeof(T));
    const Span barrier = {out.barrier, 4 * kWorkScalars * out.listed * kBytes};
    if (auto error = clear({{pushing, sizeof(*pushing)}, barrier, {out.by_kappa, out.listed * kBytes}}, stream)) {
      return error;
    }
    pushing_kernel<T><<<blocks_for(out.listed), kOne, 0, stream>>>(in, out.listed, pushing);
    barrier_kernel<T><<<blocks_for(kPartsApart * out.listed), kOne, 0, stream>>>(in, given, out, pushing);
  }
  if (out.lagged > 0) friction_kernel<T><<<blocks_for(out.lagged), kOne, 0, stream>>>(in, given, out);
  return cudaGetLastError();
}

#define DIFFVBD_INSTANTIATE(T)                                                                                 \
  template cudaError_t rigid_end_backward<T>(const RigidInputs<T>&, const double*, const double*, const T*,    \
                                             const double*, double*, T*, T*, T*, T*, cudaStream_t);            \
  template cudaError_t rigid_vertices_backward<T>(const RigidInputs<T>&, const double*, const double*,         \
                                                  const VirtualMotions<T>&, const rigid::Adjoints<T>&, T*,     \
                                                  cudaStream_t);                                               \
  template cudaError_t rigid_backward<T>(const RigidInputs<T>&, const VirtualMotions<T>&, const RigidWork<T>&, \
                                         int32_t*, cudaStream_t);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd::cuda
