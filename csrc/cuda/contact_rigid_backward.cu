// The adjoint of a rigid correction, kernel by kernel: of scenes of any size.
#include <algorithm>

#include "clear.h"
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
  // nobody reads the rows of what is not there: most of what a list has room for
  if (row < in.first_lagged(in.scene.scenes)) store_lagged(in, given, out, row);
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

// The body of a block, and its place.
template <class T>
struct Own {
  int64_t unit;
  Body<T> body;
  __device__ explicit Own(const RigidInputs<T>& in)
      : unit(blockIdx.x), body{in.scene, unit / in.bodies(), static_cast<int32_t>(unit % in.bodies())} {}
};
template <class T>
__global__ void __launch_bounds__(kThreads)
    end_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ RigidReverse<T> r) {
  __shared__ double part[kWarps][kMostSums];
  const Own<T> own(in);
  end_of_body(r, own.body, own.unit, BlockTeam{part});
}
template <class T>
__global__ void __launch_bounds__(kThreads)
    motion_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ RigidReverse<T> r) {
  __shared__ double part[kWarps][kMostSums];
  const Own<T> own(in);
  motion_of_body(in, r, own.body, own.unit, BlockTeam{part});
}
template <class T>
__global__ void __launch_bounds__(kThreads)
    vertices_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ RigidReverse<T> r) {
  __shared__ double part[kWarps][kMostSums];
  const Own<T> own(in);
  vertices_of_body(in, r, own.body, own.unit, BlockTeam{part});
}
template <class T>
__global__ void __launch_bounds__(kOne)
    colliders_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ RigidReverse<T> r) {
  const int64_t i = own_item(), points = in.gate.corners - in.gate.vertices;
  if (i < in.scene.scenes * points) reverse_collider(in, i / points, static_cast<int32_t>(i % points), r.sums, r.out);
}

template <class T>
unsigned blocks_of_bodies(const RigidInputs<T>& in) {
  return static_cast<unsigned>(in.scene.scenes * in.bodies());
}

}  // namespace

template <class T>
cudaError_t rigid_end_backward(const RigidInputs<T>& in, const RigidReverse<T>& r, cudaStream_t stream) {
  end_kernel<T><<<blocks_of_bodies(in), kThreads, 0, stream>>>(in, r);
  if (auto error = solve_groups(in, r.factor, r.solutions, stream)) return error;
  motion_kernel<T><<<blocks_of_bodies(in), kThreads, 0, stream>>>(in, r);
  return cudaGetLastError();
}

template <class T>
cudaError_t rigid_vertices_backward(const RigidInputs<T>& in, const RigidReverse<T>& r, cudaStream_t stream) {
  vertices_kernel<T><<<blocks_of_bodies(in), kThreads, 0, stream>>>(in, r);
  const int64_t points = in.scene.scenes * (in.gate.corners - in.gate.vertices);
  if (points > 0) colliders_kernel<T><<<blocks_for(points), kOne, 0, stream>>>(in, r);
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
