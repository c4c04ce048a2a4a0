// Star of a vertex that a group of threads of one warp shares: memory and sums, so that sweep/vertex.h runs unchanged.
#pragma once

#include "../sweep/block.h"
#include "../sweep/vertex.h"
#include "records.cuh"
#include "step.h"

namespace diffvbd::cuda {

constexpr int kRoles = 3, kCooperativeWarps = 1 + kRoles;

// Barrier of the warps that share a vertex, from different places in the code.
__device__ __forceinline__ void sync_cooperative() {
  asm volatile("barrier.sync 1, %0;" ::"n"(kCooperativeWarps * kSlice) : "memory");
}

template <class T>
struct PairTerm {
  const T* at = nullptr;  // [count, kContactScalars]
  int count = 0;
  const T* bar = nullptr;  // [3]  in the reverse: adjoint that pairs scattered, or null
  bool meets = false;      // the values are ready after the barrier
  __device__ __forceinline__ void meet() {
    if (meets) sync_cooperative();
    meets = false;
  }
  __device__ __forceinline__ ContactTerm<T> sum() {
    meet();
    ContactTerm<T> out{zero3<T>(), diagonal(T(0))};
    for (int i = 0; i < count; ++i) {
      const T* a = at + i * kContactScalars;
      out.g += Vec3<T>{a[0], a[1], a[2]};
      out.H += Sym3<T>{a[3], a[4], a[5], a[6], a[7], a[8]};
    }
    return out;
  }
  __device__ __forceinline__ Vec3<T> scattered() {
    meet();
    return bar ? Vec3<T>{bar[0], bar[1], bar[2]} : zero3<T>();
  }
};

// Rows that a thread loads at once; in the reverse, which has the registers, all of a common mesh: each wait costs a
// microsecond.
DIFFVBD_FN constexpr int rows_at_once(int lanes, bool reverse) {
  if (lanes >= kManyLanes) return 1;
  if (reverse && lanes > 1) return lanes == kFewLanes ? 9 : 5;
  return lanes == kSomeLanes ? 3 : 4;
}

// Shared memory of a warp for the stars of its vertices.
template <class T, int lanes>
__device__ __forceinline__ T* memory_of_warp(const StepView<T>& s, bool reverse) {
  extern __shared__ __align__(16) unsigned char memory[];
  const int warp = warp_of_block(), size = shared_scalars<T>(s.degree, s.valence, s.stages, lanes, reverse);
  if constexpr (lanes == kSpillLanes)
    return s.spill + (blockIdx.x * (blockDim.x / kSlice) + warp) * static_cast<int64_t>(size);
  return reinterpret_cast<T*>(memory) + warp * size;
}

// Incident tets of a group's vertex. Shared memory of the warp, in this order: the stages of their records; `near`, the
// neighbours' positions [degree, 3, groups]; `sums`, the adjoints of these: of each thread [degree, 3, kSlice], or of
// each corner of each pair [3 valence + 1, 3, groups].
template <class T, int lanes_, bool reverse = false>
struct GroupStar : Records<T, lanes_, reverse> {
  using Base = Records<T, lanes_, reverse>;
  static constexpr int lanes = Base::lanes;
  static constexpr bool gather = gathers(lanes_);
  using P = LaneLayout<lanes_>;
  using Base::at;
  using Base::real;
  using Base::s;
  using Base::size;
  T *near, *sums;
  int first_edge, degree;

  __device__ __forceinline__ GroupStar(const StepView<T>& s, const P& at, const StarSpans& spans, T* shared)
      : Base(s, at, spans.slots, shared),
        near(shared + Base::shared_scalars() + at.group),
        first_edge(spans.edges.begin),
        degree(spans.edges.end - spans.edges.begin) {
    if (s.has_tets && degree > 0) ask_places(at.lane);
  }

  // Rows of the neighbours that a thread loads next, requested early.
  static constexpr int kAtOnce = rows_at_once(lanes, reverse);
  int32_t places[kAtOnce];
  __device__ __forceinline__ void ask_places(int start) {
    const int32_t* adjacent = s.plan.adjacent + static_cast<int64_t>(first_edge) * kSlice + at.v;
#pragma unroll
    for (int u = 0; u < kAtOnce; ++u) {
      places[u] = __ldg(adjacent + min(start + u * lanes, degree - 1) * kSlice);
    }
  }
  __device__ __forceinline__ void fetch_neighbours(bool own) { fetch_neighbours<false>(own, {s.w.x, s.w.x}, 0); }
  // With `apart`, colors move into other rows: positions below `first` have moved.
  template <bool apart>
  __device__ __forceinline__ void fetch_neighbours(bool own, const MovingRows<T>& rows, int64_t first) {
    const T *x = rows.x + at.scene * s.positions * kRow, *moved = rows.moved + at.scene * s.positions * kRow;
    const int pinned = first_pinned();
    for (int start = at.lane; start < degree; start += kAtOnce * lanes) {
      if (start != at.lane) ask_places(start);
      Vec3<T> n[kAtOnce];
#pragma unroll
      for (int u = 0; u < kAtOnce; ++u) {
        n[u] = load_row(apart && places[u] < first ? moved : x, places[u], own);
      }
#pragma unroll
      for (int u = 0; u < kAtOnce; ++u) {
        const int a = start + u * lanes;
        if (a >= degree) continue;
        T* to = near + a * 3 * P::groups;
        to[0] = n[u].x;
        to[P::groups] = n[u].y;
        to[2 * P::groups] = n[u].z;
        if (a / lanes < kSlice && places[u] >= pinned) leads_to_pinned |= 1u << a / lanes;
      }
    }
    __syncwarp();
  }
  __device__ __forceinline__ int first_pinned() const { return __ldg(s.plan.color_block + s.plan.colors) * kSlice; }
  unsigned leads_to_pinned = 0;  // bit set of the first 32 edges of a thread
  __device__ __forceinline__ void clear_sums(T* shared) {
    shared += Base::shared_scalars();
    if constexpr (gather) {
      sums = shared + s.degree * 3 * P::groups + at.group;
      if (at.lane < 3) sums[(9 * Base::count() + at.lane) * P::groups] = T(0);  // for padding
    } else {
      sums = shared + s.degree * 3 * P::groups + threadIdx.x % kSlice;
      for (int a = 0; a < 3 * degree; ++a) sums[a * kSlice] = T(0);
    }
  }

  mutable int where;  // of the current pair
  __device__ __forceinline__ Vec3<T> neighbour(int a) const {
    const T* from = near + a * 3 * P::groups;
    return {from[0], from[P::groups], from[2 * P::groups]};
  }

  __device__ __forceinline__ TetPair<T> pair(int e) const {
    const PairRecord<T> now = Base::take(e);
    where = now.where;
    TetPair<T> out;
    out.xj = neighbour(where & kMaxDegree);
    out.xk = neighbour(where >> kLocalBits & kMaxDegree);
    out.xl = neighbour(where >> 2 * kLocalBits);
#pragma unroll
    for (int i = 0; i < kPairRest; ++i) out.rest[i] = now.rest[i];
#pragma unroll
    for (int i = 0; i < kMaterialScalars; ++i) out.material[i] = now.material[i];
    if constexpr (reverse) {
      if (s.w.material_bar && !s.one_material && !Base::repeats) {  // loaded long before the addition
        const T* before = s.w.material_bar + pair_index(e) * kMaterialScalars;
#pragma unroll
        for (int i = 0; i < kMaterialScalars; ++i) material_bar[i] = before[i];
      }
    }
    return out;
  }
  template <class... R>
  __device__ __forceinline__ void total(R&... values) const {
    if constexpr (lanes > 1) P::template sum<T>(values...);
  }

  // The threads of a warp visit stars together, so one ill-conditioned block takes all along.
  __device__ __forceinline__ bool any(bool condition) const { return __any_sync(kWholeWarp, condition); }
  __device__ __forceinline__ void rewind() const { Base::begin(); }
  // Takes the sums of a copy.
  __device__ __forceinline__ void adopt(const GroupStar& a) const {
#pragma unroll
    for (int i = 0; i < kMaterialScalars; ++i) material_bar[i] = a.material_bar[i];
  }
  __device__ __forceinline__ const Vec3<T>& predictor(const Block<T>& b) const { return b.y; }
  PairTerm<T>* pairs = nullptr;
  __device__ __forceinline__ ContactTerm<T> contact(const Block<T>&) const { return pairs->sum(); }

  __device__ __forceinline__ void put(int row, const Vec3<T>& v) const {
    T* to = sums + row * 3 * P::groups;
    to[0] = v.x;
    to[P::groups] = v.y;
    to[2 * P::groups] = v.z;
  }
  __device__ __forceinline__ void scatter(int neighbour, const Vec3<T>& v) const {
    T* to = sums + neighbour * 3 * kSlice;
    to[0] += v.x;
    to[kSlice] += v.y;
    to[2 * kSlice] += v.z;
  }
  __device__ __forceinline__ const GroupStar& local() const { return *this; }  // it has the sums
  template <class Law, int wanted>
  __device__ __forceinline__ Vec3<T> reverse_tets(const Reversed<T>& update) const {
    return diffvbd::reverse_tets<Law, wanted>(*this, update);
  }
  template <int wanted>
  __device__ static constexpr bool wants(int what) {
    return (wanted & what) != 0;
  }
  __device__ __forceinline__ void add(int e, const TetAdjoint<T>& a) const {
    if constexpr (gather) {
      const int row = 3 * (e * lanes + at.lane);
      if (real(e)) put(row, a.xj), put(row + 1, a.xk), put(row + 2, a.xl);
    } else {
      scatter(where & kMaxDegree, a.xj);
      scatter(where >> kLocalBits & kMaxDegree, a.xk);
      scatter(where >> 2 * kLocalBits, a.xl);
    }
  }
  __device__ __forceinline__ int64_t pair_index(int e) const {
    return at.scene * s.plan.slots * kSlice + Base::slot(e) + at.v;
  }
  __device__ __forceinline__ void add_material(int e, const T* bar) const {
    if (s.one_material) {
#pragma unroll
      for (int i = 0; i < kMaterialScalars; ++i) material_bar[i] += bar[i];
    } else if (real(e)) {
      T* to = s.w.material_bar + pair_index(e) * kMaterialScalars;
#pragma unroll
      for (int i = 0; i < kMaterialScalars; ++i) to[i] = (reverse ? material_bar[i] : to[i]) + bar[i];
    }
  }
  __device__ __forceinline__ void add_rest(int e, const T* bar) const {
    if (!real(e)) return;
    T* to = s.w.rest_bar + pair_index(e) * kPairRest;
#pragma unroll
    for (int i = 0; i < kPairRest; ++i) to[i] += bar[i];
  }
  mutable T material_bar[kMaterialScalars] = {};  // of a scene with one material; otherwise of the current pair

  // Writes the rows of the vertex's edges: sums over its threads in their order. Pinned vertices have no turn; rows
  // that lead to them accumulate over the sweeps.
  __device__ __forceinline__ void scatter_rows() const {
    __syncwarp();
    T* rows = s.w.rows + at.scene * (static_cast<int64_t>(s.plan.edge_slots) * kSlice + 1) * kRow;
    if constexpr (gather) {
      for (int a = at.lane; a - at.lane < degree; a += lanes) {  // the warp of one vertex stays together
        const Vec3<T> sum = gathered(first_edge + min(a, degree - 1), a < degree);
        if (a < degree) scatter_row(rows, a, sum);
      }
    } else {
      for (int a = at.lane; a < degree; a += lanes) {
        const T* from = sums - at.lane * P::groups + a * 3 * kSlice;
        Vec3<T> sum = zero3<T>();
#pragma unroll
        for (int l = 0; l < lanes; ++l) {
          const T* p = from + l * P::groups;
          sum += Vec3<T>{p[0], p[kSlice], p[2 * kSlice]};
        }
        scatter_row(rows, a, sum);
      }
    }
  }

 private:
  __device__ __forceinline__ void scatter_row(T* rows, int a, Vec3<T> sum) const {
    const int64_t edge = static_cast<int64_t>(first_edge + a) * kSlice + at.v;
    const bool adds =
        a / lanes < kSlice ? (leads_to_pinned >> a / lanes & 1) != 0 : __ldg(s.plan.adjacent + edge) >= first_pinned();
    if (adds) sum += load_row(rows, edge);
    store_row(rows, edge, sum);
  }
  // Sum of the contributions to an edge, in the order of its entries. All threads of the warp must call it.
  __device__ __forceinline__ Vec3<T> gathered(int edge, bool there) const {
    constexpr int kAhead = 4;  // entries loaded at once
    const int begin = __ldg(s.plan.edge_entry + edge), end = __ldg(s.plan.edge_entry + edge + 1);
    const int most = __reduce_max_sync(kWholeWarp, there ? end - begin : 0);
    Vec3<T> sum = zero3<T>();
    for (int i = begin; i < begin + most; i += kAhead) {
      int entries[kAhead];
#pragma unroll
      for (int u = 0; u < kAhead; ++u) {
        entries[u] = __ldg(s.plan.entry + static_cast<int64_t>(min(i + u, end - 1)) * kSlice + at.v);
      }
#pragma unroll
      for (int u = 0; u < kAhead; ++u) {
        const T* p = sums + entries[u] * 3 * P::groups;
        sum += select(i + u < end, Vec3<T>{p[0], p[P::groups], p[2 * P::groups]}, zero3<T>());
      }
    }
    return sum;
  }
};

// Adjoints that the neighbours' updates added to a vertex since its last turn (as in cpu/scene.h): of all rows, or of
// those below a bound.
template <bool all, class T, int lanes_>
__device__ __forceinline__ Vec3<T> pull_rows(const StepView<T>& s, const LaneLayout<lanes_>& at, const Span& incoming,
                                             int below = 0) {
  constexpr int lanes = threads_of(lanes_), batch = rows_at_once(lanes, true);
  const int none = s.plan.edge_slots * kSlice;  // row that stays zero
  const T* rows = s.w.rows + at.scene * (static_cast<int64_t>(none) + 1) * kRow;
  Vec3<T> sum = zero3<T>();
  // A warp of one vertex stays together in the loop; otherwise the sum below would wait for its last thread.
  const int own = lanes == kSlice ? 0 : at.lane, after = at.lane - own;
  for (int start = incoming.begin + own; start < incoming.end; start += batch * lanes) {
    int row[batch];
    Vec3<T> part[batch];
#pragma unroll
    for (int u = 0; u < batch; ++u) {
      const int e = start + after + u * lanes;
      row[u] = e < incoming.end ? __ldg(s.plan.incoming + static_cast<int64_t>(e) * kSlice + at.v) : none;
      if (!all && row[u] >= below) row[u] = none;
    }
#pragma unroll
    for (int u = 0; u < batch; ++u) part[u] = load_row(rows, row[u]);
#pragma unroll
    for (int u = 0; u < batch; ++u) sum += part[u];
  }
  if constexpr (lanes > 1) {
    __syncwarp();  // threads of several vertices leave the loop one by one, and partial shuffles are slower
    LaneLayout<lanes_>::template sum<T>(sum);
  }
  return sum;
}

// x: rows of the color.
template <class Set, class T, int lanes>
__device__ __forceinline__ Block<T> load_block(const StepView<T>& s, const LaneLayout<lanes>& at, bool own,
                                               const T* x) {
  Block<T> out;
  const int64_t position = static_cast<int64_t>(at.block) * kSlice + at.v;
  const int64_t vectors = at.scene * s.positions * 3;
  out.state.x = load_row(x, at.scene * s.positions + position, own);
  out.state.x_prev = zero3<T>();
  out.state.origin = zero3<T>();
  if constexpr (Set::reads_x_prev) out.state.x_prev = load3(s.w.x_prev + vectors, at.block, at.v);
  if constexpr (Set::of_vertices) {
    if (s.w.origin) out.state.origin = load3(s.w.origin + vectors, at.block, at.v);
  }
  out.state.h = s.parameters.time_step;
  out.y = load3(s.w.y + vectors, at.block, at.v);
  out.mass = __ldg(s.mass.data + at.scene * s.mass.scene + position);
  if constexpr (Set::of_vertices) {
    const int vertex = max(0, __ldg(s.plan.order + position));
    const T* data = s.data.data + at.scene * s.data.scene;
    Set::for_each([&](auto energy, int k) {
      using E = decltype(energy);
      out.data_count[k] = E::per_vertex && !kOwnLaw ? E::stride : s.data_count[k];
      out.data[k] = data + s.data_start[k] + (E::per_vertex ? static_cast<int64_t>(vertex) * E::stride : 0);
    });
  }
  return out;
}

}  // namespace diffvbd::cuda
