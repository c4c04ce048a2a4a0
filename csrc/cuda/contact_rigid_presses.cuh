// What pairs press in a rigid correction, for whoever adds it up: barriers as they were stored, friction as bodies go.
#pragma once

#include "../subspace/contact_rigid.h"
#include "contact_rigid.cuh"

namespace diffvbd::cuda {
namespace {

constexpr int32_t kRanked = 512;  // rows of a body up to which each counts those before it

// The rows of a group, in memory that they share.
template <class T>
struct GroupRows {
  const RigidInputs<T>& in;
  PairRoom room;
  const GroupMemory& memory;
  int64_t scene;
  Groups groups;
  int32_t first, count;

  __device__ int64_t unit(int32_t body) const { return scene * groups.bodies + body; }
  // Where those of a body begin, those of lagged pairs among them, and where they end.
  __device__ int32_t begin(int32_t body) const { return memory.begins[unit(body)]; }
  __device__ int32_t lagged(int32_t body) const { return begin(body) + memory.counts[2 * unit(body)]; }
  __device__ int32_t end(int32_t body) const { return lagged(body) + memory.counts[2 * unit(body) + 1]; }
  __device__ int2 all() const { return {begin(groups.member(first)), end(groups.member(first + count - 1))}; }

  // Brings them into their order, by all threads of a block, and calls f(body, other) for each that joins two.
  template <int threads, class F>
  __device__ void sort(const F& f) const {
    const int2 range = all();
    for (int32_t e = range.x + static_cast<int32_t>(threadIdx.x); e < range.y; e += threads) {
      const int32_t own = memory.found[e], body = memory.sides[own], other = memory.sides[own ^ 1];
      const bool repels = own / 2 < room.listed;
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
  // A bitonic sort, in which the larger of two always goes up: so the end may be anywhere.
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

// The barriers of listed pairs.
template <class T>
struct Barriers {
  const int32_t* sides;
  const double* presses;
  static constexpr bool rubs = false;
  __device__ PairForce operator()(int64_t row, int) const {
    return load_force(presses + kForceDoubles * row, sides + 2 * row);
  }
};
// Friction and damping of lagged ones, for a side that may be solved for alone.
template <class T>
struct Rubs {
  const RigidInputs<T>& in;
  int64_t listed;
  BodyMotions slid;
  static constexpr bool rubs = true;
  __device__ PairForce operator()(int64_t row, int side) const {
    PairForce a;
    lagged_force(in, row - listed, CornerPoints<T>{in, false}, slid, a, side);
    return a;
  }
};

}  // namespace
}  // namespace diffvbd::cuda
