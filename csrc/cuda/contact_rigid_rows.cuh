// Rows of pairs of the groups of a rigid correction: sides, forces and the lists of each body.
#pragma once

#include "../subspace/contact_rigid.h"
#include "contact_rigid.cuh"

namespace diffvbd::cuda {
namespace {

template <class T>
__device__ int64_t scene_of_row(const RigidInputs<T>& in, const PairCapacity& capacity, int64_t row) {
  return row < capacity.listed ? in.gate.listed.pairs[kPairRow * row + 5]
                               : in.lagged.pairs[kPairRow * (row - capacity.listed) + 5];
}
// Index of a body of a row's scene among all bodies.
template <class T>
__device__ int64_t unit_of(const RigidInputs<T>& in, const PairCapacity& capacity, int64_t row, int32_t body) {
  return scene_of_row(in, capacity, row) * in.bodies() + body;
}

// Calls f(side, index of the body) for the bodies that a row acts on.
template <class T, class F>
__device__ void each_side(const RigidInputs<T>& in, const PairCapacity& capacity, const GroupMemory& memory,
                          int64_t row, const F& f) {
  for (int side = 0; side < 2; ++side) {
    const int32_t body = memory.sides[2 * row + side];
    if (body >= 0) f(side, unit_of(in, capacity, row, body));
  }
}

// Force of a listed pair, and sides of a row.
template <class T>
__device__ void force_row(const RigidInputs<T>& in, const PairCapacity& capacity, const GroupMemory& memory,
                          int64_t row) {
  const CornerPoints<T> at{in, false};
  PairForce a;
  const int64_t scene = scene_of_row(in, capacity, row);
  bool acts = false;
  if (in.together() && !in.moves(scene, in.groups_of(scene), 0)) {
    // nothing moves: a captured step launches all corrections, and most move nothing
  } else if (row < capacity.listed) {
    acts = barrier_force(in, row, at, a);
    if (acts) store_force(a, memory.forces + kForceDoubles * row);
  } else {
    acts = lagged_force(in, row - capacity.listed, at, BodyMotions{}, a, -1);
  }
  for (int side = 0; side < 2; ++side) memory.sides[2 * row + side] = acts ? a.body[side] : -1;
}

// Counts a row for its bodies.
template <class T>
__device__ void count_row(const RigidInputs<T>& in, const PairCapacity& capacity, const GroupMemory& memory,
                          int64_t row) {
  each_side(in, capacity, memory, row,
            [&](int, int64_t unit) { atomicAdd(memory.counts + 2 * unit + (row < capacity.listed ? 0 : 1), 1); });
}

// Begin of the rows of a body in a scene that is one group; a row has two entries at most.
template <class T>
__device__ int32_t begin_in_scene(const RigidInputs<T>& in, const GroupMemory& memory, int64_t unit) {
  const int64_t scene = unit / in.bodies();
  auto at = static_cast<int32_t>(2 * (in.first_listed(scene) + in.first_lagged(scene)));
  for (int64_t other = scene * in.bodies(); other < unit; ++other) {
    at += memory.counts[2 * other] + memory.counts[2 * other + 1];
  }
  return at;
}

// Stores a row for its bodies. begin_of(index of a body).
template <class T, class F>
__device__ void fill_row(const RigidInputs<T>& in, const PairCapacity& capacity, const GroupMemory& memory, int64_t row,
                         const F& begin_of) {
  each_side(in, capacity, memory, row, [&](int side, int64_t unit) {
    const int which = row < capacity.listed ? 0 : 1;
    const int32_t at = begin_of(unit) + which * memory.counts[2 * unit];
    memory.found[at + atomicAdd(memory.filled + 2 * unit + which, 1)] = static_cast<int32_t>(2 * row) + side;
  });
}

// count_row() and fill_row() for all rows of a scene that is one group, by its block.
template <class T, class Team>
__device__ void list_rows(const RigidInputs<T>& in, const PairCapacity& capacity, const GroupMemory& memory,
                          const Team& team, int64_t scene) {
  const int32_t n = in.bodies();
  const int64_t unit = scene * n, listed = in.first_listed(scene), lagged = in.first_lagged(scene);
  const auto listed_count = static_cast<int32_t>(in.first_listed(scene + 1) - listed);
  const auto lagged_count = static_cast<int32_t>(in.first_lagged(scene + 1) - lagged);
  const auto each = [&](const auto& f) {
    team.each(listed_count + lagged_count,
              [&](int32_t i) { f(i < listed_count ? listed + i : capacity.listed + lagged + i - listed_count); });
    team.meet();
  };
  team.each(2 * n, [&](int32_t i) { memory.counts[2 * unit + i] = memory.filled[2 * unit + i] = 0; });
  team.meet();
  each([&](int64_t row) { count_row(in, capacity, memory, row); });
  team.each(n, [&](int32_t b) { memory.begins[unit + b] = begin_in_scene(in, memory, unit + b); });
  team.meet();
  each([&](int64_t row) { fill_row(in, capacity, memory, row, [&](int64_t of) { return memory.begins[of]; }); });
}

constexpr int32_t kRanked = 512;  // rows of a body up to which a thread counts the rows before its own

// Rows of a group.
template <class T>
struct GroupRows {
  const RigidInputs<T>& in;
  PairCapacity capacity;
  const GroupMemory& memory;
  int64_t scene;
  Groups groups;
  int32_t first, count;

  __device__ int64_t unit(int32_t body) const { return scene * groups.bodies + body; }
  // Begin of the rows of a body, of its lagged rows, and end.
  __device__ int32_t begin(int32_t body) const { return memory.begins[unit(body)]; }
  __device__ int32_t lagged(int32_t body) const { return begin(body) + memory.counts[2 * unit(body)]; }
  __device__ int32_t end(int32_t body) const { return lagged(body) + memory.counts[2 * unit(body) + 1]; }
  __device__ int2 all() const { return {begin(groups.member(first)), end(groups.member(first + count - 1))}; }

  // Sorts the rows, by all threads of a block, and calls f(body, other) for each that joins two bodies.
  template <int threads, class F>
  __device__ void sort(const F& f) const {
    const int2 range = all();
    for (int32_t e = range.x + static_cast<int32_t>(threadIdx.x); e < range.y; e += threads) {
      const int32_t own = memory.found[e], body = memory.sides[own], other = memory.sides[own ^ 1];
      const bool repels = own / 2 < capacity.listed;
      const int32_t from = repels ? begin(body) : lagged(body), to = repels ? lagged(body) : end(body);
      int32_t rank = to - from > kRanked ? e : from;
      for (int32_t i = from; to - from <= kRanked && i < to; ++i) rank += memory.found[i] < own ? 1 : 0;
      memory.rows[rank] = own;
      if (other >= 0) f(body, other);
    }
    __syncthreads();
    for (int32_t i = 0; i < count; ++i) {
      const int32_t body = groups.member(first + i), parts[3] = {begin(body), lagged(body), end(body)};
      for (int k = 0; k < 2; ++k) {
        if (parts[k + 1] - parts[k] > kRanked) sort_many<threads>(memory.rows + parts[k], parts[k + 1] - parts[k]);
      }
    }
  }
  // Bitonic sort in which the larger of two always moves up, so any length works.
  template <int threads>
  static __device__ void sort_many(int32_t* rows, int32_t count) {
    for (int32_t size = 2; size / 2 < count; size *= 2) {
      for (int32_t half = size / 2; half > 0; half /= 2) {
        for (auto i = static_cast<int32_t>(threadIdx.x); i < count; i += threads) {
          const int32_t other = half == size / 2 ? i ^ (size - 1) : i ^ half;
          if (i >= other || other >= count || rows[i] <= rows[other]) continue;
          const int32_t larger = rows[i];
          rows[i] = rows[other], rows[other] = larger;
        }
        __syncthreads();
      }
    }
  }
};

// Barrier forces of listed pairs.
template <class T>
struct BarrierForces {
  const int32_t* sides;
  const double* forces;
  static constexpr bool lagged = false;
  __device__ PairForce operator()(int64_t row, int) const {
    return load_force(forces + kForceDoubles * row, sides + 2 * row);
  }
};
// Friction and damping of lagged pairs, for one side.
template <class T>
struct LaggedForces {
  const RigidInputs<T>& in;
  int64_t listed;
  BodyMotions slid;
  static constexpr bool lagged = true;
  __device__ PairForce operator()(int64_t row, int side) const {
    PairForce a;
    lagged_force(in, row - listed, CornerPoints<T>{in, false}, slid, a, side);
    return a;
  }
};

}  // namespace

}  // namespace diffvbd::cuda
