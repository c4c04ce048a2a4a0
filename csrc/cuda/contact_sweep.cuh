// Pairs of a warp's vertices in a sweep: their terms of the blocks before an update, its limit after it. All vertices
// of a color see positions from before any of them moved, so no vertex waits for another.
#pragma once

#include "../contact/passes.h"
#include "group.cuh"

namespace diffvbd::cuda {
namespace {

// Entry of the list and the thread of the warp that found it.
struct Found {
  int entry, thread;  // entry < 0: none
  __device__ __forceinline__ bool there() const { return entry >= 0; }
  // Value of the thread that found it. All threads of the warp must call it.
  template <class U>
  __device__ __forceinline__ U of(U own) const {
    return __shfl_sync(kWholeWarp, own, thread);
  }
  template <class T>
  __device__ __forceinline__ Vec3<T> of(const Vec3<T>& own) const {
    return {of(own.x), of(own.y), of(own.z)};
  }
};
constexpr int kFound = 2 * kSlice;  // entries that a warp collects before it works on them

// Calls f(Found) for the entries of the warp's vertices that are near(entry), 32 at a time, those of a vertex in the
// order of its list. `share` threads have one vertex; `lane` is the number of this one among them. All threads of the
// warp call it and f together. collected [kFound]: shared memory of the warp.
template <int share, class Near, class F>
__device__ __forceinline__ void each_near(const contact::PairList::Entries& all, int lane, Found* collected,
                                          const Near& near, const F& f) {
  const auto thread = static_cast<int>(threadIdx.x % kSlice);
  int count = 0, first = 0;
  for (bool more = true; more || count > 0;) {
    more = __any_sync(kWholeWarp, first < all.count);
    if (more) {
      const int entry = first + lane < all.count ? all.first[first + lane] : -1;
      const bool is_near = entry >= 0 && near(entry);
      const unsigned threads = __ballot_sync(kWholeWarp, is_near);
      if (is_near) collected[count + __popc(threads & ((1u << thread) - 1))] = {entry, thread};
      count += __popc(threads), first += share;
      __syncwarp();
    }
    if (count == 0 || (more && count < kSlice)) continue;
    f(thread < count ? collected[thread] : Found{-1, thread});  // called in one place only: f is long
    count = count < kSlice ? 0 : count - kSlice;
    const Found left = collected[kSlice + thread];
    __syncwarp();
    if (thread < count) collected[thread] = left;
    __syncwarp();
  }
}

// Sums of gradients and Hessians of the warp's vertices from all of its threads, in a fixed order. Each thread of a
// vertex keeps some of its numbers.
template <int lanes, class T>
struct BlockSums {
  static constexpr int kGroups = kSlice / lanes, kOwn = (kContactScalars + lanes - 1) / lanes;
  T (*slots)[kContactScalars];  // [32] of the warp, in shared memory
  T own[kOwn] = {};
  // from: a thread of the vertex of g and H. All threads of the warp must call it.
  __device__ __forceinline__ void add(const Vec3<T>& g, const Sym3<T>& H, int from) {
    T values[] = {g.x, g.y, g.z, H.xx, H.xy, H.xz, H.yy, H.yz, H.zz};
    if constexpr (lanes == kSlice) {
      add_of_one(values);
    } else {
      add_of_several(values, from);
    }
  }
  // Sums of the vertex of this thread.
  __device__ __forceinline__ void store(T* to) const {
    const int lane = threadIdx.x % kSlice / kGroups;
#pragma unroll
    for (int i = 0; i < kOwn; ++i) {
      if (lane + i * lanes < kContactScalars) to[lane + i * lanes] = own[i];
    }
  }

 private:
  // Sums of a warp with one vertex.
  __device__ __forceinline__ void add_of_one(T (&values)[kContactScalars]) {
    const int lane = threadIdx.x % kSlice;
#pragma unroll
    for (int offset = 1; offset < kSlice; offset *= 2) add_from(values, offset);
#pragma unroll
    for (int k = 0; k < kContactScalars; ++k) own[0] += lane == k ? values[k] : T(0);
  }
  __device__ __forceinline__ void add_of_several(const T (&values)[kContactScalars], int from) {
    const int thread = threadIdx.x % kSlice, group = thread % kGroups, lane = thread / kGroups;
    for (int k = 0; k < kContactScalars; ++k) slots[thread][k] = values[k];
    unsigned mine = 0;  // threads with contributions to the vertex of this one
    for (int g_of = 0; g_of < kGroups; ++g_of) {
      const unsigned threads = __ballot_sync(kWholeWarp, from % kGroups == g_of);
      if (group == g_of) mine = threads;
    }
    __syncwarp();
    constexpr int kAhead = 4;  // slots read at once
    while (mine) {
      T part[kAhead][kOwn] = {};
#pragma unroll
      for (int u = 0; u < kAhead; ++u, mine &= mine - 1) {
        const T* slot = slots[max(__ffs(static_cast<int>(mine)) - 1, 0)];
#pragma unroll
        for (int i = 0; i < kOwn; ++i) {
          if (mine && lane + i * lanes < kContactScalars) part[u][i] = slot[lane + i * lanes];
        }
      }
#pragma unroll
      for (int u = 0; u < kAhead; ++u) {
#pragma unroll
        for (int i = 0; i < kOwn; ++i) own[i] += part[u][i];
      }
    }
    __syncwarp();
  }
};

// Positions in a sweep: colors that have moved are in other rows than the rest.
template <class T>
struct SweepRows {
  const T *rows, *moved;
  const int32_t* position;
  int64_t first, last;  // positions of the current color
  __device__ __forceinline__ bool goes(int v) const {
    const int at = __ldg(position + v);
    return first <= at && at < last;
  }
  // of the current color
  __device__ __forceinline__ bool together(int v, int) const { return goes(v); }
  __device__ __forceinline__ Vec3<T> operator()(int v) const {
    const int at = __ldg(position + v);
    return load_row(at < first ? moved : rows, at);
  }
};
// Positions in a reversed sweep: the current color as before its update, from the tape.
template <class T>
struct TapeRows {
  SweepRows<T> now;  // one array of rows
  const T* tape;     // of the scene and sweep [., active]
  const int32_t* block_rank;
  int64_t active;
  __device__ __forceinline__ bool together(int v, int u) const { return now.together(v, u); }
  __device__ __forceinline__ Vec3<T> operator()(int v) const {
    const int at = __ldg(now.position + v);
    if (at < now.first || now.last <= at) return load_row(now.rows, at);
    const T* from = tape + (__ldg(block_rank + at / kSlice) + at % kSlice);
    return {__ldg(from), __ldg(from + active), __ldg(from + 2 * active)};
  }
};
template <class T>
struct UserRows {
  const T* x;
  __device__ __forceinline__ Vec3<T> operator()(int v) const { return diffvbd::vector_at(x + int64_t{3} * v); }
};

using contact::ContactAdjoints;
using contact::ContactInputs;

// Pairs of a warp. Where several warps share a vertex, each takes one kind: threads with pairs of different kinds would
// wait for each other.
enum PairRole { kAllPairs = -1, kPoints = 0, kEdges = 1, kLagged = 2 };  // kRoles in all
__device__ __forceinline__ bool takes_lagged(int role) { return role == kAllPairs || role == kLagged; }

// Shared memory of a warp.
constexpr int kKept = 64;  // near entries that are kept from before the update
template <class T>
struct PairMemory {
  Found collected[kFound], kept[kKept];
  T slots[kSlice][kContactScalars];
  int exponents[kSlice];  // of the warp's vertices
};
// Messages between the warps of a block that share a vertex.
template <class T>
struct Messages {
  T term[kRoles][kContactScalars], from[3], to[3], bar[3];
  int exponents[kRoles];
};
template <class T>
__device__ __forceinline__ PairMemory<T>& pair_memory() {
  __shared__ PairMemory<T> memory[kWarpsPerBlock];
  static_assert(sizeof(memory) + sizeof(Messages<T>) <= kPairBytes && kCooperativeWarps <= kWarpsPerBlock);
  return memory[threadIdx.x / kSlice];
}

// Positions of a scene while the blocks [begin, end) move.
template <class T>
__device__ __forceinline__ SweepRows<T> sweep_rows(const StepView<T>& s, int64_t scene, int64_t begin, int64_t end,
                                                   const MovingRows<T>& all) {
  const int64_t rows = scene * s.positions * kRow;
  return {all.x + rows, all.moved + rows, s.w.position, begin * kSlice, end * kSlice};
}
// Positions in the reverse.
template <class T>
__device__ __forceinline__ SweepRows<T> settled_rows(const StepView<T>& s, int64_t scene, int64_t begin, int64_t end) {
  return sweep_rows(s, scene, begin, end, MovingRows<T>{s.w.x, s.w.x});
}
// Positions in the reverse, before the color is restored.
template <class T>
__device__ __forceinline__ TapeRows<T> tape_rows_of(const StepView<T>& s, int64_t scene, int sweep, int64_t begin,
                                                    int64_t end) {
  const int64_t rows = (scene * s.sweeps + sweep) * s.tape_rows;
  return {settled_rows(s, scene, begin, end), s.tape + rows * s.plan.num_active, s.plan.block_rank, s.plan.num_active};
}

// Pairs of a vertex for the warp that updates it; `rows` gives positions.
template <class T, int lanes, class Rows>
struct PairsOf {
  static constexpr int share = threads_of(lanes);
  // Whether near pairs are kept for limit(), which the same warp calls after the update. The reverse must find near
  // pairs in the same way.
  static constexpr bool remembers = lanes == kManyLanes;
  const ContactInputs<T>& in;
  const LaneLayout<lanes>& at;
  const contact::Source<T, Rows> source;
  const int vertex, role;  // vertex -1: a phantom
  const T h;
  PairMemory<T>& memory;
  contact::PairList::Entries listed{nullptr, 0}, lagged{nullptr, 0};
  int kept = kKept + 1;  // near entries; more than kKept: not all are kept
  T clear = T(0);        // least gap of the other pairs that this thread has seen

  __device__ __forceinline__ PairsOf(const StepView<T>& s, const ContactInputs<T>& in, const LaneLayout<lanes>& at,
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
  // It refers to rows of the caller: a copy would not stay in registers.
  PairsOf(const StepView<T>&, const ContactInputs<T>&, const LaneLayout<lanes>&, Rows&&, int = kAllPairs) = delete;
  __device__ __forceinline__ bool takes(int entry) const {  // of listed pairs
    if (role == kAllPairs) return true;
    const int kind = __ldg(in.listed.pairs + contact::kPairRow * int64_t{entry >> 2} + 4);
    return role == (kind == contact::kEdgeEdge ? kEdges : kPoints);
  }
  __device__ __forceinline__ bool touches() const {
    return vertex >= 0 && (listed.count > 0 || lagged.count > 0 || in.planes > 0);
  }

  // Stores the pair terms of the vertex's block [kContactScalars] for its PairTerm, and keeps which pairs are near.
  __device__ __forceinline__ void gather(T* to) {
    BlockSums<share, T> sums{memory.slots};
    if (remembers) kept = 0, clear = T(std::numeric_limits<float>::infinity());
    if (__any_sync(kWholeWarp, touches())) gather_into(sums);
    sums.store(to);
  }

  __device__ __forceinline__ contact::TrustRegion<T> trust_region() const {
    return vertex < 0 ? contact::TrustRegion<T>{} : contact::TrustRegion<T>(source, vertex);
  }
  // Exponent of the limit of an update by d from the position `from`.
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
      const int before = found.of(exponent), place = found.thread % LaneLayout<lanes>::groups;
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
    // A warp with one vertex sums in its threads first.
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

// Gathers the adjoints that pairs scattered to the warp's vertices: those of their state into bar [3].
template <class T, int lanes, class Rows>
__device__ __forceinline__ void take_scattered(const ContactView<T>& c, const PairsOf<T, lanes, Rows>& pairs, T* bar) {
  const int64_t scene = pairs.source.scene;
  Vec3<T> now = zero3<T>(), prev = zero3<T>();
  if (pairs.touches()) {
    contact::gather_pairs(c.in, c.slots, scene, pairs.vertex, pairs.at.lane, pairs.share, now, prev);
  }
  __syncwarp();
  pairs.at.template sum<T>(now, prev);
  if (pairs.vertex < 0 || pairs.at.lane != 0) return;
  bar[0] = now.x, bar[1] = now.y, bar[2] = now.z;
  if (pairs.touches()) diffvbd::add_to(c.slots.prev + 3 * (scene * c.in.corners + pairs.vertex), prev);
}

// Scatters the adjoints of the pair terms of a warp's vertices into the slots of the pairs.
template <class T, int lanes>
__device__ __forceinline__ void scatter_pairs(const StepView<T>& s, const ContactView<T>& c,
                                              const LaneLayout<lanes>& at, int role, int64_t begin, int64_t end) {
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
    const T* turn = s.w.reversed + 6 * row;
    p = diffvbd::vector_at(turn), d_raw = diffvbd::vector_at(turn + 3);
  }
  // f(vertex, p, d_raw), of the thread that found the entry
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
  diffvbd::add_to(s.w.x_bar + kRow * row, own);
  diffvbd::add_to(c.slots.prev + 3 * (pairs.source.scene * in.corners + pairs.vertex), -own);
}

template <class T>
__device__ __forceinline__ Messages<T>& message_memory() {
  __shared__ Messages<T> memory;
  return memory;
}

}  // namespace

}  // namespace diffvbd::cuda
