#include <algorithm>

#include "../contact/rigid_reverse.h"
#include "clear.h"
#include "clear_rows.cuh"
#include "contact_rigid.cuh"

namespace diffvbd::cuda {
namespace {

constexpr int kPartsApart = 16;  // threads of a pair: one for each part of its work, in a half of a warp
static_assert(kWorkParts <= kPartsApart);

constexpr int64_t kBlocksOfPushing = 2048;  // which share the pairs that push, whose number only the device knows

// The first row of blocks: the listed pairs that push, few of them: how many, and which, in any order. The second: the
// lagged pairs.
template <class T>
__global__ void __launch_bounds__(kOne) rows_kernel(const __grid_constant__ RigidInputs<T> in, VirtualMotions<T> given,
                                                    RigidWork<T> out, int32_t* pushing) {
  const int64_t row = own_item();
  if (blockIdx.y == 0) {
    if (row >= out.listed) return;
    const bool pushes = BarrierWork<T>::pushes(in, given, row);
    out.pushes[row] = pushes, out.by_kappa[row] = T(0);
    if (pushes) pushing[1 + atomicAdd(pushing, 1)] = static_cast<int32_t>(row);
    return;
  }
  const int64_t count = in.first_lagged(in.scene.scenes);
  // nobody reads the rows of what is not there: most of what a list has room for
  clear_rows(out.lag_bar, kLagScalars, count, out.lagged);
  if (row >= count) return;
  T *rows = out.friction + 4 * kWorkScalars * row, *lag_bar = out.lag_bar + kLagScalars * row;
  const LaggedWork<T> work(in, given, row);
  work.acts ? work.store(rows, lag_bar) : work.store_none(rows, lag_bar);
}

template <class T>
__global__ void __launch_bounds__(kOne)
    barrier_kernel(const __grid_constant__ RigidInputs<T> in, VirtualMotions<T> given, RigidWork<T> out,
                   const int32_t* pushing) {
  const int part = static_cast<int>(threadIdx.x % kPartsApart);
  const int64_t count = *pushing, stride = static_cast<int64_t>(gridDim.x) * (kOne / kPartsApart);
  for (int64_t i = own_item() / kPartsApart; part < kWorkParts && i < count; i += stride) {
    const int64_t row = pushing[1 + i];
    const BarrierWork<T> work(in, given, row, true);
    work.store(part, out.barrier + 4 * kWorkScalars * row, out.by_kappa + row);
  }
}

// A warp for each corner point.
template <class T>
__global__ void __launch_bounds__(kOne)
    point_kernel(const __grid_constant__ RigidInputs<T> in, RigidWork<T> work, PointWork<T> out) {
  const int64_t point = own_item() / 32;
  const int lane = static_cast<int>(threadIdx.x % 32);
  if (point >= in.scene.scenes * in.gate.corners) return;
  double sum[kPointScalars] = {};
  add_at_point(in, work, point, lane, 32, sum);
  butterfly<kPointScalars, 32>(0xffffffffu, sum);
  if (lane == 0) store_at_point(sum, point, out);
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
                    SentBack<T> sent, const __grid_constant__ rigid::Adjoints<T> out, T* floor_lag) {
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
                                    const SentBack<T>& sent, const rigid::Adjoints<T>& out, T* floor_lag,
                                    cudaStream_t stream) {
  if (blocks_of_bodies(in) == 0) return cudaSuccess;
  vertices_kernel<T><<<blocks_of_bodies(in), kThreads, 0, stream>>>(in, motions, solutions, sent, out, floor_lag);
  return cudaGetLastError();
}

template <class T>
cudaError_t rigid_backward(const RigidInputs<T>& in, const VirtualMotions<T>& given, const RigidWork<T>& out,
                           const PointWork<T>& sums, int32_t* pushing, cudaStream_t stream) {
  if (auto error = clear({{pushing, sizeof(*pushing)}}, stream)) return error;
  const dim3 rows(blocks_for(std::max(out.listed, out.lagged)), out.lagged > 0 ? 2 : 1);
  if (rows.x > 0) rows_kernel<T><<<rows, kOne, 0, stream>>>(in, given, out, pushing);
  if (out.listed > 0) {
    const auto blocks =
        static_cast<unsigned>(std::min<int64_t>(blocks_for(kPartsApart * out.listed), kBlocksOfPushing));
    barrier_kernel<T><<<blocks, kOne, 0, stream>>>(in, given, out, pushing);
  }
  const int64_t points = in.scene.scenes * in.gate.corners;
  if (points > 0) point_kernel<T><<<blocks_for(32 * points), kOne, 0, stream>>>(in, out, sums);
  return cudaGetLastError();
}

#define DIFFVBD_INSTANTIATE(T)                                                                                      \
  template cudaError_t rigid_end_backward<T>(const RigidInputs<T>&, const double*, const double*, const T*,         \
                                             const double*, double*, T*, T*, T*, T*, cudaStream_t);                 \
  template cudaError_t rigid_vertices_backward<T>(const RigidInputs<T>&, const double*, const double*,              \
                                                  const SentBack<T>&, const rigid::Adjoints<T>&, T*, cudaStream_t); \
  template cudaError_t rigid_backward<T>(const RigidInputs<T>&, const VirtualMotions<T>&, const RigidWork<T>&,      \
                                         const PointWork<T>&, int32_t*, cudaStream_t);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd::cuda
