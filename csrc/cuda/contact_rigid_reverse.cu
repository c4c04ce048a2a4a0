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
  const auto own = static_cast<int64_t>(kThreads * cluster.rank + threadIdx.x);
  const int64_t threads = kThreads * cluster.size;
  const auto each = [&](int64_t from, int64_t to, const auto& f) {
    for (int64_t i = from + own; i < to; i += threads) f(i);
  };
  const auto each_body = [&](const auto& f) {
    for (int32_t b = cluster.rank; b < in.bodies(); b += cluster.size) f(Body<T>{in.scene, scene, b}, unit + b);
    cluster.meet();
  };
  const int64_t listed = in.first_listed(scene), listed_end = in.first_listed(scene + 1);
  const int64_t lagged = in.first_lagged(scene), lagged_end = in.first_lagged(scene + 1);
  const bool last = scene + 1 == scenes;  // which has the rows that are not there, too
  if (last) {
    each(listed_end, r.work.listed, [&](int64_t row) { r.work.by_kappa[row] = T(0); });
    each(lagged_end * kLagScalars, r.work.lagged * kLagScalars, [&](int64_t i) { r.work.lag_bar[i] = T(0); });
  }
  bool went = false;
  block.each(in.bodies(), [&](int32_t b) {
    went = went || r.shares[unit + b] != 0;
    for (int i = 0; i < kUnknowns; ++i) went = went || r.motions[kUnknowns * (unit + b) + i] != 0;
  });
  const int64_t rows = scene * in.scene.vertices, corners = scene * in.gate.corners;
  if (!__syncthreads_or(went)) {  // a captured step makes all of its corrections, most of which move nothing
    each(3 * rows, 3 * (rows + in.scene.vertices), [&](int64_t i) {
      r.out.x[i] = r.end_bar[i];
      if (r.out.x_prev) r.out.x_prev[i] = T(0);
      r.out.y[i] = T(0);
    });
    each(rows, rows + in.scene.vertices, [&](int64_t row) { r.out.mass[row] = T(0); });
    each(3 * corners, 3 * (corners + in.gate.corners), [&](int64_t i) {
      r.sums.x[i] = T(0);
      if (r.sums.since) r.sums.since[i] = T(0);
    });
    each(listed, listed_end, [&](int64_t row) { r.work.by_kappa[row] = T(0); });
    if (r.work.lagged > 0) {
      each(lagged * kLagScalars, lagged_end * kLagScalars, [&](int64_t i) { r.work.lag_bar[i] = T(0); });
    }
    return;
  }
  int32_t *count = r.pushing + scene, *pushing = r.pushing + scenes + listed;
  if (own == 0) *count = 0;
  each_body([&](const Body<T>& body, int64_t at) {
    reverse_end(body, block, r.motions + kUnknowns * at, r.shares[at], r.end_bar, r.solutions + kUnknowns * at, r.x,
                r.mass);
  });
  if (cluster.rank == 0) solve_group(in, scene, 0, r.factor, r.solutions, memory);
  cluster.meet();
  each_body([&](const Body<T>& body, int64_t at) {
    virtual_motion(in, body, block, r.motions + kUnknowns * at, r.solutions + kUnknowns * at, r.p, r.q);
  });
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
  const SentBack<T> sent{r.x, r.mass, r.sums.x, r.sums.p, r.sums.q, r.sums.since};
  each_body([&](const Body<T>& body, int64_t at) {
    reverse_vertices(in, body, block, r.motions + kUnknowns * at, r.solutions + kUnknowns * at, sent, r.out,
                     r.floor_lag);
  });
}

}  // namespace

template <class T>
cudaError_t rigid_reverse(const RigidInputs<T>& in, const RigidReverse<T>& r, cudaStream_t stream) {
  const int64_t scenes = in.scene.scenes, rows = r.work.listed + r.work.lagged;
  if (scenes == 0 || in.bodies() == 0) return cudaSuccess;
  if (in.together() && scenes < kManyScenes && has_block_each(in.scene.vertices, scenes, rows)) {
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
