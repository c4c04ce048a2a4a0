#include "body_block.cuh"
#include "part.h"

namespace diffvbd::cuda {
namespace {

template <class T, template <class> class Act>
__global__ void __launch_bounds__(kMostThreads) body_kernel(const __grid_constant__ Act<T> act) {
  __shared__ double part[kMostThreads / kWarp][BodyBlock::kSums];
  const int64_t item = blockIdx.x, bodies = act.in.scene.bodies;
  act(rigid::Body<T>{act.in.scene, item / bodies, static_cast<int32_t>(item % bodies)}, BodyBlock{part});
}

template <class Act>
__global__ void __launch_bounds__(kVertexThreads) vertex_kernel(const __grid_constant__ Act act) {
  const Row row(act.in.scene);
  if (row.exists) act(row.scene, row.vertex);
}

}  // namespace

template <class Act>
cudaError_t act_on_bodies(const Act& act, cudaStream_t stream) {
  const int64_t items = act.in.scene.scenes * act.in.scene.bodies;
  if (items == 0) return cudaSuccess;
  const int threads = threads_for(act.in.scene.vertices, act.in.scene.bodies);
  body_kernel<<<static_cast<unsigned>(items), threads, 0, stream>>>(act);
  return cudaGetLastError();
}

template <class Act>
cudaError_t act_on_vertices(const Act& act, cudaStream_t stream) {
  if (act.in.scene.scenes * act.in.scene.vertices == 0) return cudaSuccess;
  vertex_kernel<<<blocks_of(act.in.scene), kVertexThreads, 0, stream>>>(act);
  return cudaGetLastError();
}

#define DIFFVBD_INSTANTIATE(on, Act)                                          \
  template cudaError_t act_on_##on(const contact::Act<float>&, cudaStream_t); \
  template cudaError_t act_on_##on(const contact::Act<double>&, cudaStream_t);
DIFFVBD_INSTANTIATE(bodies, AboveFloorDisplacements)
DIFFVBD_INSTANTIATE(bodies, ReverseAboveFloor)
DIFFVBD_INSTANTIATE(bodies, Frames)
DIFFVBD_INSTANTIATE(bodies, Bends)
DIFFVBD_INSTANTIATE(bodies, BlockedBodies)
DIFFVBD_INSTANTIATE(vertices, Wishes)
DIFFVBD_INSTANTIATE(vertices, Freeze)
DIFFVBD_INSTANTIATE(vertices, GravityMoves)
DIFFVBD_INSTANTIATE(vertices, Starts)
DIFFVBD_INSTANTIATE(vertices, ReverseStarts)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd::cuda
