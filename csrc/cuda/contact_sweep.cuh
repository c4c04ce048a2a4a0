// What a sweep does with the pairs of a warp's vertices: before an update their part of the blocks, after it what
// planes let pass of it. All of a color read where it was before any of it moved, so no vertex waits for another.
#pragma once

#include "../contact/passes.h"
#include "contact_near.cuh"
#include "contact_rows.cuh"

namespace diffvbd::cuda {
namespace {

using contact::ContactAdjoints;
using contact::ContactInputs;

// The pairs that a warp looks at. Where several warps share a vertex, each takes one kind: threads of a warp that have
// pairs of several kinds wait for each other.
enum PairRole { kAllPairs = -1, kPoints = 0, kEdges = 1, kLagged = 2 };  // and kRoles in all
__device__ __forceinline__ bool takes_lagged(int role) { return role == kAllPairs || role == kLagged; }

// A warp's own memory.
constexpr int kKept = 64;  // near entries that are remembered from before the update
template <class T>
struct PairMemory {
  Found collected[kFound], kept[kKept];
  T slots[kSlice][kContactScalars];
  int exponents[kSlice];  // of the warp's vertices
};
// What the warps of a block that share a vertex tell each other.
template <class T>
struct Among {
  T term[kRoles][kContactScalars], from[3], to[3], bar[3];
  int exponents[kRoles];
};
template <class T>
__device__ __forceinline__ PairMemory<T>& pair_memory() {
  __shared__ PairMemory<T> memory[kWarpsPerBlock];
  static_assert(sizeof(memory) + sizeof(Among<T>) <= kPairBytes && kAmongWarps <= kWarpsPerBlock);
  return memory[threadIdx.x / kSlice];
}

// Where the vertices of a scene are in the turn of the blocks [begin, end) of a sweep.
template <class T>
__device__ __forceinline__ SweepRows<T> sweep_rows(const StepView<T>& s, int64_t scene, int64_t begin, int64_t end,
                                                   const MovingRows<T>& all) {
  const int64_t rows = scene * s.positions * kRow;
  return {all.x + rows, all.moved + rows, s.w.position, begin * kSlice, end * kSlice};
}
// Of a reversed one.
template <class T>
__device__ __forceinline__ SweepRows<T> settled_rows(const StepView<T>& s, int64_t scene, int64_t begin, int64_t end) {
  return sweep_rows(s, scene, begin, end, MovingRows<T>{s.w.x, s.w.x});
}
// The same in the reverse, before the color is back where its updates of that sweep began.
template <class T>
__device__ __forceinline__ TapeRows<T> tape_rows_of(const StepView<T>& s, int64_t scene, int sweep, int64_t begin,
                                                    int64_t end) {
  const int64_t rows = (scene * s.sweeps + sweep) * s.tape_rows;
  return {settled_rows(s, scene, begin, end), s.tape + rows * s.plan.num_active, s.plan.block_rank, s.plan.num_active};
}

// The pairs of a vertex, as the warp that has its turn sees them; `rows` says where vertices are.
template <class T, int lanes, class Rows>
struct PairsOf {
  static constexpr int share = threads_of(lanes);
  // For limit(), which the same warp calls after the update. It also says how near pairs are found, which must be the
  // same in the reverse.
  static constexpr bool remembers = lanes == kManyLanes;
  const ContactInputs<T>& in;
  const Place<lanes>& at;
  const contact::Source<T, Rows> source;
  const int vertex, role;  // vertex -1: a phantom
  const T h;
  PairMemory<T>& memory;
  contact::PairList::Entries listed{nullptr, 0}, lagged{nullptr, 0};
  int kept = kKept + 1;  // near entries; more than kKept: not all are remembered
  T clear = T(0);        // the least gap of the others that this thread has seen

  __device__ __forceinline__ PairsOf(const StepView<T>& s, const ContactInputs<T>& in, const Place<lanes>& at,
                                     const Rows& rows, int role = kAllPairs)
      : in(in),
        at(at),
        source{in, s.base + at.scene, rows},
        vertex(__ldg(s.plan.order + static_cast<int64_t>(at.block) * kSlice + at.v)),
        role(role),
        h(s.parameters.time_step),
        memory(pair_memory<T>()) {
    if (vertex < 0) return;
    listed = in.listed.of(source.scene * in.corners + vertex);
    lagged = in.lags_of(source.scene, vertex);
  }
  // It refers to the rows, which its caller keeps: a copy of its own would have all of it leave the registers.
  PairsOf(const StepView<T>&, const ContactInputs<T>&, const Place<lanes>&, Rows&&, int = kAllPairs) = delete;
  __device__ __forceinline__ bool takes(int entry) const {  // of the listed
    if (role == kAllPairs) return true;
    const int kind = __ldg(in.listed.pairs + contact::kPairRow * int64_t{entry >> 2} + 4);
    return role == (kind == contact::kEdgeEdge ? kEdges : kPoints);
  }
  __device__ __forceinline__ bool touches() const {
    return vertex >= 0 && (listed.count > 0 || lagged.count > 0 || in.planes > 0);
  }

  // Puts what pairs add to the vertex's block [kContactScalars] to where its PairTerm finds it, and remembers which are
  // near.
  __device__ __forceinline__ void gather(T* to) {
    BlockSums<share, T> sums{memory.slots};
    if (remembers) kept = 0, clear = T(std::numeric_limits<float>::infinity());
    if (__any_sync(kWholeWarp, touches())) gather_into(sums);
    sums.store(to);
  }

  __device__ __forceinline__ contact::TrustRegion<T> room() const {
    return vertex < 0 ? contact::TrustRegion<T>{} : contact::TrustRegion<T>(source, vertex);
  }
  // The exponent of the limit of an update that goes from where the vertex was by d.
  __device__ __forceinline__ int limit(const contact::TrustRegion<T>& own, const Vec3<T>& from, const Vec3<T>& d) {
    int exponent = 0;
    T length = T(0), guard = T(0);
    if (vertex >= 0) exponent = own.limit(from, d), length = contact::length_of(d), guard = own.guard(from);
    if (!__any_sync(kWholeWarp, listed.count > 0)) return exponent;
    if (at.lane == 0) memory.exponents[at.group] = exponent;
    __syncwarp();
    const int least = exponent;
    const auto look = [&](const Found& found) {
      const Vec3<T> d_of = found.of(d);
      const T length_of = found.of(length), guard_of = found.of(guard);
      const int before = found.of(exponent), place = found.thread % Place<lanes>::groups;
      if (found.there()) {
        atomicMax(memory.exponents + place,
                  contact::limit_by_pair(source, found.entry, d_of, length_of, guard_of, before));
      }
      __syncwarp();
      exponent = memory.exponents[at.group];
    };
    const T reach = contact::limit_of<T>(least) * length / T(contact::kBothGapFraction) + guard;
    if (remembers && __all_sync(kWholeWarp, kept <= kKept && reach < clear)) {
      const auto thread = static_cast<int>(threadIdx.x % kSlice);
      for (int first = 0; first < kept; first += kSlice) {
        look(first + thread < kept ? memory.kept[first + thread] : Found{-1, thread});
      }
    } else {
      each_near<share>(
          listed, at.lane, memory.collected,
          [&](int entry) { return takes(entry) && contact::may_limit(source, entry, length, guard, least); }, look);
    }
    return exponent;
  }

 private:
  __device__ __forceinline__ void gather_into(BlockSums<share, T>& sums) {
    Vec3<T> g = zero3<T>();
    Sym3<T> H = diagonal(T(0));
    // A warp of one vertex adds up in its threads first.
    const auto add = [&](const Found& found, const auto& f) {
      const int of = found.of(vertex);
      if constexpr (share == kSlice) {
        if (found.there()) f(of, g, H);
      } else {
        Vec3<T> g_of = zero3<T>();
        Sym3<T> H_of = diagonal(T(0));
        if (found.there()) f(of, g_of, H_of);
        sums.add(g_of, H_of, found.thread);
      }
    };
    const auto thread = static_cast<int>(threadIdx.x % kSlice);
    if (role != kLagged) {
      each_near<share>(
          listed, at.lane, memory.collected,
          [&](int entry) {
            if (!takes(entry)) return false;
            if constexpr (!remembers) return contact::is_near(source, entry);
            const T gap = contact::least_gap(source, entry);
            const bool near = !(contact::dhat_of(in, entry) < gap);
            if (!near && gap < clear) clear = gap;
            return near;
          },
          [&](const Found& found) {
            if (remembers) {
              if (found.there() && kept + thread < kKept) memory.kept[kept + thread] = found;
              kept += __popc(__ballot_sync(kWholeWarp, found.there()));
            }
            add(found, [&](int v, Vec3<T>& g_of, Sym3<T>& H_of) {
              contact::add_barrier_of(source, found.entry, v, h, g_of, H_of);
            });
          });
    }
    if (in.lag && takes_lagged(role)) {
      each_near<share>(
          lagged, at.lane, memory.collected, [&](int entry) { return contact::is_lagging(in, entry); },
          [&](const Found& found) {
            add(found, [&](int v, Vec3<T>& g_of, Sym3<T>& H_of) {
              contact::add_lag_of(source, found.entry, v, h, g_of, H_of);
            });
          });
    }
    if (takes_lagged(role) && touches()) contact::add_floor_lags(source, vertex, at.lane, share, h, g, H);
    if (share == kSlice || in.planes > 0) sums.add(g, H, thread);
  }
};

// Takes what pairs have sent to the warp's vertices: what belongs to their state into bar [3] of each.
template <class T, int lanes, class Rows>
__device__ __forceinline__ void take_sent(const ContactView<T>& c, const PairsOf<T, lanes, Rows>& pairs, T* bar) {
  const int64_t scene = pairs.source.scene;
  Vec3<T> now = zero3<T>(), prev = zero3<T>();
  if (pairs.touches()) {
    contact::gather_pairs(c.in, c.slots, scene, pairs.vertex, pairs.at.lane, pairs.share, now, prev);
  }
  __syncwarp();
  pairs.at.template sum<T>(now, prev);
  if (pairs.vertex < 0 || pairs.at.lane != 0) return;
  bar[0] = now.x, bar[1] = now.y, bar[2] = now.z;
  if (pairs.touches()) add_to(c.slots.prev + 3 * (scene * c.in.corners + pairs.vertex), prev);
}

// The adjoint of what the pairs of a warp's vertices have added to their blocks, into the slots of the pairs.
template <class T, int lanes>
__device__ __forceinline__ void send_pairs(const StepView<T>& s, const ContactView<T>& c, const Place<lanes>& at,
                                           int role, int64_t begin, int64_t end) {
  constexpr int share = threads_of(lanes);
  const ContactInputs<T>& in = c.in;
  const SweepRows<T> rows = settled_rows(s, at.scene, begin, end);
  const PairsOf<T, lanes, SweepRows<T>> pairs(s, in, at, rows, role);
  const bool touches = pairs.touches();
  if (!__any_sync(kWholeWarp, touches)) return;
  const int64_t row = at.scene * s.positions + static_cast<int64_t>(at.block) * kSlice + at.v;
  const T h = s.parameters.time_step;
  Vec3<T> p = zero3<T>(), d_raw = zero3<T>();
  if (touches) {
    const T* turn = s.w.turn + 6 * row;
    p = vector_at(turn), d_raw = vector_at(turn + 3);
  }
  // f(vertex, p, d_raw) of whose entry has been found
  const auto reverse = [&](const Found& found, const auto& f) {
    const int vertex = found.of(pairs.vertex);
    const Vec3<T> p_of = found.of(p), d_of = found.of(d_raw);
    if (found.there()) f(vertex, p_of, d_of);
  };
  if (role != kLagged) {
    each_near<share>(
        pairs.listed, at.lane, pairs.memory.collected,
        [&](int entry) { return pairs.takes(entry) && contact::is_near(pairs.source, entry); },
        [&](const Found& found) {
          reverse(found, [&](int v, const Vec3<T>& p_of, const Vec3<T>& d_of) {
            contact::reverse_barrier_of(pairs.source, c.slots, found.entry, v, h, p_of, d_of);
          });
        });
  }
  if (!takes_lagged(role)) return;
  if (in.lag) {
    each_near<share>(
        pairs.lagged, at.lane, pairs.memory.collected, [](int) { return true; },
        [&](const Found& found) {
          reverse(found, [&](int v, const Vec3<T>& p_of, const Vec3<T>& d_of) {
            contact::reverse_lag_of(pairs.source, c.slots, found.entry, v, h, p_of, d_of);
          });
        });
  }
  if (in.planes == 0) return;
  Vec3<T> own = zero3<T>();
  if (touches) contact::reverse_floor_lags(pairs.source, c.slots, pairs.vertex, at.lane, share, h, p, d_raw, own);
  __syncwarp();
  at.template sum<T>(own);
  if (!touches || at.lane != 0) return;
  add_to(s.w.x_bar + kRow * row, own);
  add_to(c.slots.prev + 3 * (pairs.source.scene * in.corners + pairs.vertex), -own);
}

template <class T>
__device__ __forceinline__ Among<T>& among_memory() {
  __shared__ Among<T> memory;
  return memory;
}

}  // namespace
}  // namespace diffvbd::cuda
