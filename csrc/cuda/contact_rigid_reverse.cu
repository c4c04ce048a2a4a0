// The adjoint of a rigid correction of bodies that touch: all of it in one launch for a few small scenes, a cluster
// each, where kernel by kernel takes longer to launch than to run.
#include <algorithm>

#include "cluster.cuh"
#include "contact_rigid_backward.cuh"
#include "small_scenes.h"

namespace diffvbd::cuda {
namespace {

template <class T>
__global__ void __launch_bounds__(kThreads)
    scene_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ RigidReverse<T> r) {
  __shared__ double part[kWarps][kMostSums];
  __shared__ GroupSolve<kFew> memory;
  const Cluster cluster = Cluster::all();
  const int64_t scene = blockIdx.x / cluster.size, scenes = in.scene.scenes, unit = scene * in.bodies();
  const BlockTeam block{part};
  const int64_t own = kThreads * cluster.rank + static_cast<int64_t>(threadIdx.x);
  const int64_t threads = kThreads * cluster.size;
  const auto each = [&](int64_t from, int64_t to, const auto& f) {
    for (int64_t i = from + own; i < to; i += threads) f(i);
  };
  const auto each_body = [&](const auto& f) {
    for (int32_t b = cluster.rank; b < in.bodies(); b += cluster.size) f(Body<T>{in.scene, scene, b}, unit + b);
    cluster.meet();
  };
  bool went = false;
  block.each(in.bodies(), [&](int32_t b) { went = went || r.shares[unit + b] != 0; });
  if (!__syncthreads_or(went)) {  // a captured step makes all of its corrections, most of which move nothing
    const int64_t first = 3 * scene * in.scene.vertices;
    if (r.end_bar == r.out.vertices.x) return;
    return each(first, first + 3 * in.scene.vertices, [&](int64_t i) { r.out.vertices.x[i] = r.end_bar[i]; });
  }
  const int64_t listed = in.first_listed(scene), listed_end = in.first_listed(scene + 1);
  const int64_t lagged = in.first_lagged(scene), lagged_end = in.first_lagged(scene + 1);
  const int64_t corners = scene * in.gate.corners, points = in.gate.corners - in.gate.vertices;
  int32_t *count = r.pushing + scene, *pushing = r.pushing + scenes + listed;
  if (own == 0) *count = 0;
  each_body([&](const Body<T>& body, int64_t of) { end_of_body(r, body, of, block); });
  if (cluster.rank == 0) solve_group(in, scene, 0, r.factor, r.solutions, memory);
  cluster.meet();
  each_body([&](const Body<T>& body, int64_t of) { motion_of_body(in, r, body, of, block); });
  const VirtualMotions<T> given{r.p, r.q};
  each(listed, listed_end, [&](int64_t row) { find_pushing(in, given, r.work, row, count, pushing); });
  if (r.work.lagged > 0) each(lagged, lagged_end, [&](int64_t row) { store_lagged(in, given, r.work, row); });
  cluster.meet();
  each(0, int64_t{*count} * kPartsApart, [&](int64_t i) {
    const int k = static_cast<int>(i % kPartsApart);
    if (k < kWorkParts) store_barrier(in, given, r.work, pushing[i / kPartsApart], k);
  });
  cluster.meet();
  for (int64_t k = own / 32; k < in.gate.corners; k += threads / 32) sum_at_point(in, r.work, r.sums, corners + k);
  cluster.meet();
  each_body([&](const Body<T>& body, int64_t of) { vertices_of_body(in, r, body, of, block); });
  each(0, points, [&](int64_t j) { reverse_collider(in, scene, static_cast<int32_t>(j), r.sums, r.out); });
}

}  // namespace

template <class T>
cudaError_t rigid_reverse(const RigidInputs<T>& in, const RigidReverse<T>& r, cudaStream_t stream) {
  const int64_t scenes = in.scene.scenes, rows = r.work.listed + r.work.lagged;
  if (scenes == 0 || in.bodies() == 0) return cudaSuccess;
  if (in.together() && scenes < kManyScenes && has_block_each(in.gate.corners, scenes, rows)) {
    const int64_t pairs = std::max(rows, kPairsOfBlock * scenes * in.bodies());  // a block for each body at least
    return launch_clusters(scene_kernel<T>, scenes, pairs, kThreads, stream, in, r);
  }
  if (auto error = rigid_end_backward(in, r, stream)) return error;
  if (auto error = rigid_backward(in, {r.p, r.q}, r.work, r.sums, r.pushing, stream)) return error;
  return rigid_vertices_backward(in, r, stream);
}

#define DIFFVBD_INSTANTIATE(T) \
  template cudaError_t rigid_reverse<T>(const RigidInputs<T>&, const RigidReverse<T>&, cudaStream_t);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd::cuda
