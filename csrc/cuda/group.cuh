// A group of threads of one warp shares a vertex: memory and sums, so that sweep/vertex.h runs unchanged.
#pragma once

#include "../sweep/vertex.h"
#include "pair_term.cuh"
#include "step.h"

namespace diffvbd::cuda {

// 16 bytes: the widest load of a thread
template <class T>
struct alignas(16) Pack {
  static constexpr int size = 16 / sizeof(T);
  T v[size];
};

// The vector type of a Pack, by whose name the loads go: a Pack that is one in disguise would live on the stack.
template <class T>
using Wide = std::conditional_t<sizeof(T) == sizeof(double), double2, float4>;
__device__ __forceinline__ Pack<double> pack(const double2& a) { return {a.x, a.y}; }
__device__ __forceinline__ Pack<float> pack(const float4& a) { return {a.x, a.y, a.z, a.w}; }

// Values that other multiprocessors may write during the launch come from the L2 cache; a block that has its scene to
// itself (`own`) can use the nearer one.
template <class T>
__device__ __forceinline__ Pack<T> load_state(const T* p, bool own) {
  const auto* from = reinterpret_cast<const Wide<T>*>(p);
  return own ? pack(*from) : pack(__ldcg(from));
}
template <class T>
__device__ __forceinline__ Pack<T> load_constant(const T* p) {
  return pack(__ldg(reinterpret_cast<const Wide<T>*>(p)));
}
__device__ __forceinline__ void store(double* p, const Pack<double>& a) {
  *reinterpret_cast<double2*>(p) = {a.v[0], a.v[1]};
}
__device__ __forceinline__ void store(float* p, const Pack<float>& a) {
  *reinterpret_cast<float4*>(p) = {a.v[0], a.v[1], a.v[2], a.v[3]};
}

// rows of x, y, z and one unused
template <class T>
__device__ __forceinline__ Vec3<T> load_row(const T* rows, int64_t row, bool own = false) {
  const T* p = rows + kRow * row;
  const Pack<T> a = load_state(p, own);
  if constexpr (Pack<T>::size == 4) {
    return {a.v[0], a.v[1], a.v[2]};
  } else {
    return {a.v[0], a.v[1], load_state(p + 2, own).v[0]};
  }
}
template <class T>
__device__ __forceinline__ void store_row(T* rows, int64_t row, const Vec3<T>& a) {
  T* p = rows + kRow * row;
  if constexpr (Pack<T>::size == 4) {
    store(p, Pack<T>{a.x, a.y, a.z, T(0)});
  } else {
    store(p, Pack<T>{a.x, a.y});
    store(p + 2, Pack<T>{a.z, T(0)});
  }
}
// packed vectors [blocks, 3, kSlice]
template <class T>
__device__ __forceinline__ Vec3<T> load3(const T* p, int block, int v) {
  const T* a = p + static_cast<int64_t>(block) * 3 * kSlice + v;
  return {__ldg(a), __ldg(a + kSlice), __ldg(a + 2 * kSlice)};
}
template <class T>
__device__ __forceinline__ void store3(T* p, int block, int v, const Vec3<T>& b) {
  T* a = p + static_cast<int64_t>(block) * 3 * kSlice + v;
  a[0] = b.x;
  a[kSlice] = b.y;
  a[2 * kSlice] = b.z;
}
// one that this thread alone writes, so that it may change during the launch
template <class T>
__device__ __forceinline__ Vec3<T> load_own3(const T* p, int block, int v) {
  const T* a = p + static_cast<int64_t>(block) * 3 * kSlice + v;
  return {a[0], a[kSlice], a[2 * kSlice]};
}

constexpr unsigned kWholeWarp = 0xffffffffu;

// Where a thread stands: vertex `v` of a block, and which of the `lanes` threads of that vertex it is. Neighbouring
// threads have neighbouring vertices, so that their loads lie side by side.
template <int lanes_>
struct Place {
  static constexpr int lanes = threads_of(lanes_), groups = kSlice / lanes;  // vertices of a warp
  int64_t scene;
  int block, v, group, lane;
  __device__ __forceinline__ Place(int64_t scene, int block, int part)
      : scene(scene), block(block), group(threadIdx.x % groups), lane(threadIdx.x % kSlice / groups) {
    v = part * groups + group;
  }
  template <class R>
  __device__ __forceinline__ static void sum(R& a) {
#pragma unroll
    for (int offset = groups; offset < kSlice; offset *= 2) a = a + __shfl_xor_sync(kWholeWarp, a, offset);
  }
  template <class R>
  __device__ __forceinline__ static void sum(Vec3<R>& a) {
    sum(a.x), sum(a.y), sum(a.z);
  }
  template <class R>
  __device__ __forceinline__ static void sum(Sym3<R>& a) {
    sum(a.xx), sum(a.xy), sum(a.xz), sum(a.yy), sum(a.yz), sum(a.zz);
  }
};

// A warp's own memory for the stars of its vertices.
template <class T, int lanes>
__device__ __forceinline__ T* memory_of_warp(const StepView<T>& s, bool reverse) {
  extern __shared__ __align__(16) unsigned char memory[];
  const int warp = threadIdx.x / kSlice, size = shared_scalars(s.degree, s.valence, lanes, reverse);
  if constexpr (lanes == kSpillLanes)
    return s.spill + (blockIdx.x * (blockDim.x / kSlice) + warp) * static_cast<int64_t>(size);
  return reinterpret_cast<T*>(memory) + warp * size;
}

// The incident tets of a group's vertex. `near` holds the neighbours' positions, [degree, 3, groups] in the warp's own
// shared memory; `sums` what a reversed update adds to them, [degree, 3, kSlice], each thread its own, or to each
// corner of each pair, [3 valence + 1, 3, groups].
template <class T, int lanes_>
struct GroupStar {
  static constexpr int lanes = threads_of(lanes_);
  static constexpr bool gather = gathers(lanes_);
  using P = Place<lanes_>;
  const StepView<T>& s;
  const P& at;
  T *near, *sums;
  int first, count, first_edge, degree;

  __device__ __forceinline__ GroupStar(const StepView<T>& s, const P& at, T* shared)
      : s(s), at(at), near(shared + at.group) {
    first = __ldg(s.plan.block_slot + at.block);
    count = s.has_tets ? __ldg(s.plan.block_slot + at.block + 1) - first : 0;
    first_edge = __ldg(s.plan.block_edge + at.block);
    degree = __ldg(s.plan.block_edge + at.block + 1) - first_edge;
    if (s.one_material) {
#pragma unroll
      for (int m = 0; m < kTetScalars; ++m) {
        next.material[m] = __ldg(s.material[m].data + at.scene * s.material[m].scene);
      }
    }
    if (s.has_tets) fetch(0);
  }

  __device__ __forceinline__ void fetch_neighbours(bool own) { fetch_neighbours<false>(own, {s.w.x, s.w.x}, 0); }
  // Several loads are under way at once: what is beyond the last neighbour repeats it, and is not stored. Where colors
  // move into other rows (`apart`), those of positions below `first` have.
  template <bool apart>
  __device__ __forceinline__ void fetch_neighbours(bool own, const MovingRows<T>& rows, int64_t first) {
    constexpr int batch = lanes >= 32 ? 1 : lanes >= 8 ? 3 : 4;
    const T *x = rows.x + at.scene * s.positions * kRow, *moved = rows.moved + at.scene * s.positions * kRow;
    const int32_t* adjacent = s.plan.adjacent + static_cast<int64_t>(first_edge) * kSlice + at.v;
    for (int start = at.lane; start < degree; start += batch * lanes) {
      int32_t index[batch];
      Vec3<T> n[batch];
#pragma unroll
      for (int u = 0; u < batch; ++u) index[u] = __ldg(adjacent + min(start + u * lanes, degree - 1) * kSlice);
#pragma unroll
      for (int u = 0; u < batch; ++u) n[u] = load_row(apart && index[u] < first ? moved : x, index[u], own);
#pragma unroll
      for (int u = 0; u < batch; ++u) {
        if (start + u * lanes >= degree) continue;
        T* to = near + (start + u * lanes) * 3 * P::groups;
        to[0] = n[u].x;
        to[P::groups] = n[u].y;
        to[2 * P::groups] = n[u].z;
      }
    }
    __syncwarp();
  }
  __device__ __forceinline__ void clear_sums(T* shared) {
    if constexpr (gather) {
      sums = shared + s.degree * 3 * P::groups + at.group;
      if (at.lane < 3) sums[(9 * count + at.lane) * P::groups] = T(0);  // what padding adds
    } else {
      sums = shared + s.degree * 3 * P::groups + threadIdx.x % kSlice;
      for (int a = 0; a < 3 * degree; ++a) sums[a * kSlice] = T(0);
    }
  }

  __device__ __forceinline__ int size() const { return (count + lanes - 1) / lanes; }
  __device__ __forceinline__ bool real(int e) const { return e * lanes + at.lane < count; }
  // a thread without a pair left takes the slot of padding
  __device__ __forceinline__ int64_t slot(int e) const {
    const int own = e * lanes + at.lane;
    return static_cast<int64_t>(own < count ? first + own : s.plan.slots - 1) * kSlice;
  }

  // What a pair reads of the mesh; always loaded one pair ahead.
  struct Record {
    int where;
    T rest[kRestRow], material[kTetScalars];
  };
  mutable Record next;
  mutable int where;     // of the pair at work
  bool repeats = false;  // whether the star is visited once more
  __device__ __forceinline__ void fetch(int e) const {
    const int64_t base = slot(e);
    next.where = __ldg(s.plan.local + base + at.v);
    const T* rest = s.rest.data + at.scene * s.rest.scene + base * kRestRow;
    constexpr int width = Pack<T>::size;
#pragma unroll
    for (int i = 0; i < kRestRow; i += width) {
      const Pack<T> part = load_constant(rest + i * kSlice + at.v * width);
#pragma unroll
      for (int k = 0; k < width; ++k) next.rest[i + k] = part.v[k];
    }
    if (!s.one_material) {
      const T* m = s.w.material + at.scene * s.material_scene + (base + at.v) * kTetScalars;
#pragma unroll
      for (int i = 0; i < kTetScalars; ++i) next.material[i] = __ldg(m + i);
    }
  }
  __device__ __forceinline__ Vec3<T> neighbour(int a) const {
    const T* from = near + a * 3 * P::groups;
    return {from[0], from[P::groups], from[2 * P::groups]};
  }

  __device__ __forceinline__ TetPair<T> pair(int e) const {
    const Record now = next;
    if (e + 1 < size()) {
      fetch(e + 1);
    } else if (repeats) {
      fetch(0);
    }
    where = now.where;
    TetPair<T> out;
    out.xj = neighbour(where & kMaxDegree);
    out.xk = neighbour(where >> kLocalBits & kMaxDegree);
    out.xl = neighbour(where >> 2 * kLocalBits);
#pragma unroll
    for (int i = 0; i < kPairRest; ++i) out.rest[i] = now.rest[i];
#pragma unroll
    for (int i = 0; i < kTetScalars; ++i) out.material[i] = now.material[i];
    return out;
  }
  template <class... R>
  __device__ __forceinline__ void total(R&... values) const {
    if constexpr (lanes > 1) (P::sum(values), ...);
  }

  // the threads of a warp visit stars together, so one that must go the longer way takes all along
  __device__ __forceinline__ bool any(bool condition) const { return __any_sync(kWholeWarp, condition); }
  __device__ __forceinline__ void rewind() const {
    if (s.has_tets) fetch(0);
  }
  // the sums of a copy
  __device__ __forceinline__ void adopt(const GroupStar& a) const {
#pragma unroll
    for (int i = 0; i < kTetScalars; ++i) material_bar[i] = a.material_bar[i];
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
  __device__ __forceinline__ void send(int neighbour, const Vec3<T>& v) const {
    T* to = sums + neighbour * 3 * kSlice;
    to[0] += v.x;
    to[kSlice] += v.y;
    to[2 * kSlice] += v.z;
  }
  __device__ __forceinline__ const GroupStar& local() const { return *this; }  // it has sums
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
      send(where & kMaxDegree, a.xj);
      send(where >> kLocalBits & kMaxDegree, a.xk);
      send(where >> 2 * kLocalBits, a.xl);
    }
  }
  __device__ __forceinline__ int64_t pair_index(int e) const {
    return at.scene * s.plan.slots * kSlice + slot(e) + at.v;
  }
  __device__ __forceinline__ void add_material(int e, const T* bar) const {
    if (s.one_material) {
#pragma unroll
      for (int i = 0; i < kTetScalars; ++i) material_bar[i] += bar[i];
    } else if (real(e)) {
      T* to = s.w.material_bar + pair_index(e) * kTetScalars;
#pragma unroll
      for (int i = 0; i < kTetScalars; ++i) to[i] += bar[i];
    }
  }
  __device__ __forceinline__ void add_rest(int e, const T* bar) const {
    if (!real(e)) return;
    T* to = s.w.rest_bar + pair_index(e) * kPairRest;
#pragma unroll
    for (int i = 0; i < kPairRest; ++i) to[i] += bar[i];
  }
  mutable T material_bar[kTetScalars] = {};

  // Writes the rows of the vertex's edges: the sums of its threads, in their order. What is pinned has no turn of its
  // own: rows that lead to it add up over the sweeps.
  __device__ __forceinline__ void send_rows(int pinned) const {
    __syncwarp();
    T* rows = s.w.rows + at.scene * (static_cast<int64_t>(s.plan.edge_slots) * kSlice + 1) * kRow;
    for (int a = at.lane; a < degree; a += lanes) {
      const int64_t edge = static_cast<int64_t>(first_edge + a) * kSlice + at.v;
      const bool adds = __ldg(s.plan.adjacent + edge) >= pinned;
      Vec3<T> sum = zero3<T>();
      if constexpr (gather) {
        const int end = __ldg(s.plan.edge_entry + first_edge + a + 1);
#pragma unroll 4
        for (int i = __ldg(s.plan.edge_entry + first_edge + a); i < end; ++i) {
          const T* p = sums + __ldg(s.plan.entry + static_cast<int64_t>(i) * kSlice + at.v) * 3 * P::groups;
          sum += Vec3<T>{p[0], p[P::groups], p[2 * P::groups]};
        }
      } else {
        const T* from = sums - at.lane * P::groups + a * 3 * kSlice;
#pragma unroll
        for (int l = 0; l < lanes; ++l) {
          const T* p = from + l * P::groups;
          sum += Vec3<T>{p[0], p[kSlice], p[2 * kSlice]};
        }
      }
      if (adds) sum += load_row(rows, edge);
      store_row(rows, edge, sum);
    }
  }
};

// What the neighbours' updates have added to a vertex since its last turn (as in cpu/scene.h); of all rows, or of those
// below a bound.
template <bool all, class T, int lanes_>
__device__ __forceinline__ Vec3<T> pull_rows(const StepView<T>& s, const Place<lanes_>& at, int below = 0) {
  constexpr int lanes = threads_of(lanes_);
  constexpr int batch = lanes >= 32 ? 1 : lanes >= 8 ? 3 : 4;
  const int none = s.plan.edge_slots * kSlice;  // the row that stays zero
  const T* rows = s.w.rows + at.scene * (static_cast<int64_t>(none) + 1) * kRow;
  Vec3<T> sum = zero3<T>();
  const int end = __ldg(s.plan.block_incoming + at.block + 1);
  for (int start = __ldg(s.plan.block_incoming + at.block) + at.lane; start < end; start += batch * lanes) {
    int row[batch];
    Vec3<T> part[batch];
#pragma unroll
    for (int u = 0; u < batch; ++u) {
      const int e = start + u * lanes;
      row[u] = e < end ? __ldg(s.plan.incoming + static_cast<int64_t>(e) * kSlice + at.v) : none;
      if (!all && row[u] >= below) row[u] = none;
    }
#pragma unroll
    for (int u = 0; u < batch; ++u) part[u] = load_row(rows, row[u]);
#pragma unroll
    for (int u = 0; u < batch; ++u) sum += part[u];
  }
  if constexpr (lanes > 1) Place<lanes_>::sum(sum);
  return sum;
}

// x: rows in which the vertices of the color are.
template <class Set, class T, int lanes>
__device__ __forceinline__ Block<T> load_block(const StepView<T>& s, const Place<lanes>& at, bool own, const T* x) {
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
      out.data_count[k] = E::per_vertex ? E::stride : s.data_count[k];
      out.data[k] = data + s.data_start[k] + (E::per_vertex ? static_cast<int64_t>(vertex) * E::stride : 0);
    });
  }
  return out;
}

}  // namespace diffvbd::cuda
