// The adjoint of a rigid correction, kernel by kernel: of scenes of any size.
#include <algorithm>

#include "clear.h"
#include "clear_rows.cuh"
#include "contact_rigid_backward.cuh"

namespace diffvbd::cuda {
namespace {

constexpr int64_t kBlocksOfPushing = 2048;  // which share the pairs that push, whose number only the device knows

// The first row of blocks: the listed pairs; pushing: how many push, and which. The second: the lagged pairs.
template <class T>
__global__ void __launch_bounds__(kOne) rows_kernel(const __grid_constant__ RigidInputs<T> in, VirtualMotions<T> given,
                                                    RigidWork<T> out, int32_t* pushing) {
  const int64_t row = own_item();
  if (blockIdx.y == 0) {
    if (row < out.listed) find_pushing(in, given, out, row, pushing, pushing + 1);
    return;
  }
  const int64_t count = in.first_lagged(in.scene.scenes);
  // nobody reads the rows of what is not there: most of what a list has room for
  clear_rows(out.lag_bar, kLagScalars, count, out.lagged);
  if (row < count) store_lagged(in, given, out, row);
}

template <class T>
__global__ void __launch_bounds__(kOne)
    barrier_kernel(const __grid_constant__ RigidInputs<T> in, VirtualMotions<T> given, RigidWork<T> out,
                   const int32_t* pushing) {
  const int part = static_cast<int>(threadIdx.x % kPartsApart);
  const int64_t count = *pushing, stride = static_cast<int64_t>(gridDim.x) * (kOne / kPartsApart);
  for (int64_t i = own_item() / kPartsApart; part < kWorkParts && i < count; i += stride) {
    store_barrier(in, given, out, pushing[1 + i], part);
  }
}

// A warp for each corner point.
template <class T>
__global__ void __launch_bounds__(kOne)
    point_kernel(const __grid_constant__ RigidInputs<T> in, RigidWork<T> work, PointWork<T> out) {
  const int64_t point = own_item() / 32;
  if (point < in.scene.scenes * in.gate.corners) sum_at_point(in, work, out, point);
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
cudaError_t rigid_end_backward(const RigidInputs<T>& in, const RigidReverse<T>& r, cudaStream_t stream) {
  end_kernel<T>
      <<<blocks_of_bodies(in), kThreads, 0, stream>>>(in, r.motions, r.shares, r.end_bar, r.solutions, r.x, r.mass);
  if (auto error = solve_groups(in, r.factor, r.solutions, stream)) return error;
  motion_kernel<T><<<blocks_of_bodies(in), kThreads, 0, stream>>>(in, r.motions, r.solutions, r.p, r.q);
  return cudaGetLastError();
}

template <class T>
cudaError_t rigid_vertices_backward(const RigidInputs<T>& in, const RigidReverse<T>& r, cudaStream_t stream) {
  const SentBack<T> sent{r.x, r.mass, r.sums.x, r.sums.p, r.sums.q, r.sums.since};
  vertices_kernel<T>
      <<<blocks_of_bodies(in), kThreads, 0, stream>>>(in, r.motions, r.solutions, sent, r.out, r.floor_lag);
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

#define DIFFVBD_INSTANTIATE(T)                                                                                  \
  template cudaError_t rigid_end_backward<T>(const RigidInputs<T>&, const RigidReverse<T>&, cudaStream_t);      \
  template cudaError_t rigid_vertices_backward<T>(const RigidInputs<T>&, const RigidReverse<T>&, cudaStream_t); \
  template cudaError_t rigid_backward<T>(const RigidInputs<T>&, const VirtualMotions<T>&, const RigidWork<T>&,  \
                                         const PointWork<T>&, int32_t*, cudaStream_t);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd::cuda
