// The adjoint of a rigid correction on the device: what threads do for pairs, corner points and groups.
#pragma once

#include "../subspace/contact_rigid_reverse.h"
#include "cholesky.cuh"
#include "contact_rigid.cuh"

namespace diffvbd::cuda {
namespace {

constexpr int kPartsApart = 16;  // threads of a pair: one for each part of its work, in a half of a warp
static_assert(kWorkParts <= kPartsApart);

// A listed pair: whether it pushes; those that do, few of them, in any order: how many, and which.
template <class T>
__device__ void find_pushing(const RigidInputs<T>& in, const VirtualMotions<T>& given, const RigidWork<T>& out,
                             int64_t row, int32_t* count, int32_t* pushing) {
  const bool pushes = BarrierWork<T>::pushes(in, given, row);
  out.pushes[row] = pushes;
  if (pushes) pushing[atomicAdd(count, 1)] = static_cast<int32_t>(row);
}
// A part of the work of one that does.
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

// What a team does for a body, of that place: of the end of a correction, of its motion, and of its vertices.
template <class T, class Team>
__device__ void end_of_body(const RigidReverse<T>& r, const Body<T>& body, int64_t unit, const Team& team) {
  const int64_t at = kUnknowns * unit;
  reverse_end(body, team, r.motions + at, r.shares[unit], r.end_bar, r.solutions + at, r.way, r.out.vertices.mass);
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
  reverse_vertices(in, body, team, r.motions + at, r.solutions + at, r.way, r.sums, r.out);
}

// Memory of a block that solves for a group of so many bodies.
template <int most>
struct GroupSolve {
  double own[kUnknowns * most], diagonal[kUnknowns * most], blocks[kUnknowns * kUnknowns * most];
};

// x = factor^-T factor^-1 x of the group that begins at a place of a scene, by a block; zero of one that did not move.
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

}  // namespace
}  // namespace diffvbd::cuda
