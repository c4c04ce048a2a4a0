// Adjoint of a rigid correction of bodies that touch: kernel by kernel for scenes of any size; in one launch for a few
// small scenes, a cluster each.
#include <algorithm>

#include "../subspace/contact_rigid_reverse.h"
#include "arrays.h"
#include "cholesky.cuh"
#include "cluster.cuh"
#include "common.cuh"
#include "contact_rigid.cuh"

namespace diffvbd::cuda {
namespace {

constexpr int kPartsApart = 16;  // threads of a pair, one for each part of its work, in half a warp
static_assert(kWorkParts <= kPartsApart);

// Marks whether a listed pair pushes, and lists those that do, in any order.
template <class T>
__device__ void find_pushing(const RigidInputs<T>& in, const VirtualMotions<T>& given, const RigidWork<T>& out,
                             int64_t row, int32_t* count, int32_t* pushing) {
  const bool pushes = BarrierWork<T>::pushes(in, given, row);
  out.pushes[row] = pushes;
  if (pushes) pushing[atomicAdd(count, 1)] = static_cast<int32_t>(row);
}
// Work of one part of a pair that pushes.
template <class T>
__device__ void store_barrier(const RigidInputs<T>& in, const VirtualMotions<T>& given, const RigidWork<T>& out,
                              int64_t row, int part) {
  const BarrierWork<T> work(in, given, row, true);
  work.store(part, out.barrier + 4 * kWorkScalars * row, out.by_kappa + row);
}
template <class T>
__device__ void store_lagged(const RigidInputs<T>& in, const VirtualMotions<T>& given, const RigidWork<T>& out,
                             int64_t row) {
  T *rows = out.friction + 4 * kWorkScalars * row, *lag_bar = out.lag_bar + kLagScalars * row;
  const LaggedWork<T> work(in, given, row);
  work.acts ? work.store(rows, lag_bar) : work.store_none(rows);
}

// A corner point, by a warp.
template <class T>
__device__ void sum_at_point(const RigidInputs<T>& in, const RigidWork<T>& work, const PointWork<T>& out,
                             int64_t point) {
  const int lane = static_cast<int>(threadIdx.x % 32);
  double sum[kPointScalars] = {};
  add_at_point(in, work, point, lane, 32, sum);
  butterfly<kPointScalars, 32>(kWholeWarp, sum);
  if (lane == 0) store_at_point(sum, point, out);
}

// Work of a team for a body: end of a correction, its motion, and its vertices.
template <class T, class Team>
__device__ void end_of_body(const RigidReverse<T>& r, const Body<T>& body, int64_t unit, const Team& team) {
  const int64_t at = kUnknowns * unit;
  reverse_end(body, team, r.motions + at, r.fractions[unit], r.end_bar, r.solutions + at, r.displacement,
              r.out.vertices.mass);
}
template <class T, class Team>
__device__ void motion_of_body(const RigidInputs<T>& in, const RigidReverse<T>& r, const Body<T>& body, int64_t unit,
                               const Team& team) {
  const int64_t at = kUnknowns * unit;
  virtual_motion(in, body, team, r.motions + at, r.solutions + at, r.p, r.q);
}
template <class T, class Team>
__device__ void vertices_of_body(const RigidInputs<T>& in, const RigidReverse<T>& r, const Body<T>& body, int64_t unit,
                                 const Team& team) {
  const int64_t at = kUnknowns * unit;
  reverse_vertices(in, body, team, r.motions + at, r.solutions + at, r.displacement, r.sums, r.out);
}

// Shared memory of a block that solves for a group.
template <int most>
struct GroupSolve {
  double own[kUnknowns * most], diagonal[kUnknowns * most], blocks[kUnknowns * kUnknowns * most];
};

// x = factor^-T factor^-1 x of the group that begins at a place of a scene, by a block; zero for a group that did not
// move.
template <class T, int most>
__device__ void solve_group(const RigidInputs<T>& in, int64_t scene, int32_t first, const double* factor, double* x,
                            GroupSolve<most>& memory) {
  const Groups groups = in.groups_of(scene);
  const int32_t count = groups.count(first), size = kUnknowns * count;
  if (count == 0) return;
  const auto at = [&](int32_t i) -> double& {
    return x[kUnknowns * (in.bodies() * scene + groups.member(first + i / kUnknowns)) + i % kUnknowns];
  };
  const auto each = [&](const auto& f) {
    for (auto i = static_cast<int32_t>(threadIdx.x); i < size; i += kThreads) f(i);
  };
  if (count > in.capacity) return each([&](int32_t i) { at(i) = 0; });
  bool any = false;
  each([&](int32_t i) { memory.own[i] = at(i), any = any || memory.own[i] != 0; });
  if (!__syncthreads_or(any)) return;
  const double* own_factor = factor + in.matrix_size() * scene + groups.matrix(first);
  each([&](int32_t i) { memory.diagonal[i] = 1 / own_factor[(size + 1) * i]; });
  __syncthreads();
  const Inverses inverses{memory.blocks, kUnknowns * kUnknowns, kUnknowns, memory.diagonal};
  invert_pivots<kThreads>(count, own_factor, inverses);
  solve_forward<kThreads>(count, own_factor, inverses, memory.own);
  solve_backward<kThreads>(count, own_factor, inverses, memory.own);
  each([&](int32_t i) { at(i) = memory.own[i]; });
}

constexpr int64_t kBlocksOfPushing = 2048;  // blocks that loop over the pairs that push; only the device knows how many

// First row of blocks: listed pairs; pushing: how many push, and which. Second row: lagged pairs.
template <class T>
__global__ void __launch_bounds__(kOne) rows_kernel(const __grid_constant__ RigidInputs<T> in, VirtualMotions<T> given,
                                                    RigidWork<T> out, int32_t* pushing) {
  const int64_t row = own_item();
  if (blockIdx.y == 0) {
    if (row < out.listed) find_pushing(in, given, out, row, pushing, pushing + 1);
    return;
  }
  // rows beyond the list are not read
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

enum BodyStage { kEnd, kMotion, kVertices };
// A block for each body of each scene.
template <class T, BodyStage stage>
__global__ void __launch_bounds__(kThreads)
    body_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ RigidReverse<T> r) {
  __shared__ double part[kWarps][kMostSums];
  const int64_t unit = blockIdx.x;
  const Body<T> body{in.scene, unit / in.bodies(), static_cast<int32_t>(unit % in.bodies())};
  const BlockTeam team{part};
  if constexpr (stage == kEnd) end_of_body(r, body, unit, team);
  if constexpr (stage == kMotion) motion_of_body(in, r, body, unit, team);
  if constexpr (stage == kVertices) vertices_of_body(in, r, body, unit, team);
}
template <class T>
__global__ void __launch_bounds__(kOne)
    colliders_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ RigidReverse<T> r) {
  const int64_t i = own_item(), points = in.gate.corners - in.gate.vertices;
  if (i < in.scene.scenes * points) reverse_collider(in, i / points, static_cast<int32_t>(i % points), r.sums, r.out);
}

// A block for each place where a group may begin.
template <class T>
__global__ void __launch_bounds__(kThreads)
    solve_groups_kernel(const __grid_constant__ RigidInputs<T> in, const double* factor, double* x) {
  __shared__ GroupSolve<kMostCoupled> memory;
  const int32_t places = in.together() ? 1 : in.bodies();
  solve_group(in, blockIdx.x / places, static_cast<int32_t>(blockIdx.x % places), factor, x, memory);
}

template <class T>
unsigned blocks_of_bodies(const RigidInputs<T>& in) {
  return static_cast<unsigned>(in.scene.scenes * in.bodies());
}

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
  block.each(in.bodies(), [&](int32_t b) { went = went || r.fractions[unit + b] != 0; });
  if (!__syncthreads_or(went)) {  // a captured step launches all corrections, and most move nothing
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
cudaError_t solve_groups(const RigidInputs<T>& in, const double* factor, double* x, cudaStream_t stream) {
  const auto blocks = static_cast<unsigned>(in.scene.scenes * (in.together() ? 1 : in.bodies()));
  solve_groups_kernel<T><<<blocks, kThreads, 0, stream>>>(in, factor, x);
  return cudaGetLastError();
}

template <class T>
cudaError_t rigid_end_backward(const RigidInputs<T>& in, const RigidReverse<T>& r, cudaStream_t stream) {
  body_kernel<T, kEnd><<<blocks_of_bodies(in), kThreads, 0, stream>>>(in, r);
  if (auto error = solve_groups(in, r.factor, r.solutions, stream)) return error;
  body_kernel<T, kMotion><<<blocks_of_bodies(in), kThreads, 0, stream>>>(in, r);
  return cudaGetLastError();
}

template <class T>
cudaError_t rigid_vertices_backward(const RigidInputs<T>& in, const RigidReverse<T>& r, cudaStream_t stream) {
  body_kernel<T, kVertices><<<blocks_of_bodies(in), kThreads, 0, stream>>>(in, r);
  const int64_t points = in.scene.scenes * (in.gate.corners - in.gate.vertices);
  if (points > 0) colliders_kernel<T><<<blocks_for(points, kOne), kOne, 0, stream>>>(in, r);
  return cudaGetLastError();
}

template <class T>
cudaError_t rigid_backward(const RigidInputs<T>& in, const VirtualMotions<T>& given, const RigidWork<T>& out,
                           const PointWork<T>& sums, int32_t* pushing, cudaStream_t stream) {
  if (auto error = clear({{pushing, sizeof(*pushing)}}, stream)) return error;
  const dim3 rows(blocks_for(std::max(out.listed, out.lagged), kOne), out.lagged > 0 ? 2 : 1);
  if (rows.x > 0) rows_kernel<T><<<rows, kOne, 0, stream>>>(in, given, out, pushing);
  if (out.listed > 0) {
    const auto blocks =
        static_cast<unsigned>(std::min<int64_t>(blocks_for(kPartsApart * out.listed, kOne), kBlocksOfPushing));
    barrier_kernel<T><<<blocks, kOne, 0, stream>>>(in, given, out, pushing);
  }
  const int64_t points = in.scene.scenes * in.gate.corners;
  if (points > 0) point_kernel<T><<<blocks_for(32 * points, kOne), kOne, 0, stream>>>(in, out, sums);
  return cudaGetLastError();
}

template <class T>
cudaError_t rigid_contact_backward(const RigidInputs<T>& in, const RigidReverse<T>& r, cudaStream_t stream) {
  const int64_t scenes = in.scene.scenes, rows = r.work.listed + r.work.lagged;
  if (scenes == 0 || in.bodies() == 0) return cudaSuccess;
  if (in.together() && scenes < kManyScenes && has_block_each(in.gate.corners, scenes, rows)) {
    const int64_t pairs = std::max(rows, kPairsOfBlock * scenes * in.bodies());  // at least one block for each body
    return launch_clusters(scene_kernel<T>, scenes, pairs, kThreads, stream, in, r);
  }
  if (auto error = rigid_end_backward(in, r, stream)) return error;
  if (auto error = rigid_backward(in, {r.p, r.q}, r.work, r.sums, r.pushing, stream)) return error;
  return rigid_vertices_backward(in, r, stream);
}

DIFFVBD_INSTANTIATE(solve_groups)
DIFFVBD_INSTANTIATE(rigid_end_backward)
DIFFVBD_INSTANTIATE(rigid_vertices_backward)
DIFFVBD_INSTANTIATE(rigid_backward)
DIFFVBD_INSTANTIATE(rigid_contact_backward)

}  // namespace diffvbd::cuda
