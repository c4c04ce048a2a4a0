// A group of threads of one warp shares a vertex: memory and sums, so that core/vertex.h runs unchanged.
#pragma once

#include "../core/vertex.h"
#include "step.h"

namespace diffvbd::cuda {

// 16 bytes: the widest load of a thread
template <class T>
struct alignas(16) Pack {
  static constexpr int size = 16 / sizeof(T);
  T v[size];
};

// Values that other multiprocessors write during the launch come from the L2 cache.
template <class T>
__device__ __forceinline__ Pack<T> load_shared_state(const T* p) {
  const float4 a = __ldcg(reinterpret_cast<const float4*>(p));
  return reinterpret_cast<const Pack<T>&>(a);
}
template <class T>
__device__ __forceinline__ Pack<T> load_constant(const T* p) {
  const float4 a = __ldg(reinterpret_cast<const float4*>(p));
  return reinterpret_cast<const Pack<T>&>(a);
}
template <class T>
__device__ __forceinline__ void store(T* p, const Pack<T>& a) {
  *reinterpret_cast<float4*>(p) = reinterpret_cast<const float4&>(a);
}

// rows of x, y, z and one unused
template <class T>
__device__ __forceinline__ Vec3<T> load_row(const T* rows, int64_t row) {
  const T* p = rows + kRow * row;
  const Pack<T> a = load_shared_state(p);
  if constexpr (Pack<T>::size == 4) {
    return {a.v[0], a.v[1], a.v[2]};
  } else {
    return {a.v[0], a.v[1], load_shared_state(p + 2).v[0]};
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
__device__ __forceinline__ void add3(T* p, int block, int v, const Vec3<T>& b) {
  T* a = p + static_cast<int64_t>(block) * 3 * kSlice + v;
  a[0] += b.x;
  a[kSlice] += b.y;
  a[2 * kSlice] += b.z;
}

constexpr unsigned kWholeWarp = 0xffffffffu;

// Where a thread stands: vertex `v` of a block, and which of the `lanes` threads of that vertex it is. Neighbouring
// threads have neighbouring vertices, so that their loads lie side by side.
template <int lanes>
struct Place {
  static constexpr int groups = kSlice / lanes;  // vertices of a warp
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
  const int warp = threadIdx.x / kSlice, size = shared_scalars(s.degree, lanes, reverse);
  if constexpr (lanes == kSpillLanes) return s.spill + (blockIdx.x * (blockDim.x / kSlice) + warp) * static_cast<int64_t>(size);
  return reinterpret_cast<T*>(memory) + warp * size;
}

// The incident tets of a group's vertex. `near` holds the neighbours' positions, [degree, 3, groups] in the warp's own
// shared memory; `sums` what a reversed update adds to them, [degree, 3, kSlice], each thread its own.
template <class T, int lanes>
struct GroupStar {
  using P = Place<lanes>;
  const StepView<T>& s;
  const P& at;
  T *near, *sums;
  int first, count, first_edge, degree;
  T mu, lam;  // of a scene with one material

  __device__ __forceinline__ GroupStar(const StepView<T>& s, const P& at, T* shared)
      : s(s), at(at), near(shared + at.group) {
    first = __ldg(s.plan.block_slot + at.block);
    count = __ldg(s.plan.block_slot + at.block + 1) - first;
    first_edge = __ldg(s.plan.block_edge + at.block);
    degree = __ldg(s.plan.block_edge + at.block + 1) - first_edge;
    mu = lam = T(0);
    if (s.one_material) {
      mu = __ldg(s.mu.data + at.scene * s.mu.scene);
      lam = __ldg(s.lam.data + at.scene * s.lam.scene);
    }
  }

  __device__ __forceinline__ void fetch_neighbours() {
    const T* x = s.w.x + at.scene * s.positions * kRow;
#pragma unroll 4
    for (int a = at.lane; a < degree; a += lanes) {
      const Vec3<T> n = load_row(x, __ldg(s.plan.adjacent + static_cast<int64_t>(first_edge + a) * kSlice + at.v));
      T* to = near + a * 3 * P::groups;
      to[0] = n.x;
      to[P::groups] = n.y;
      to[2 * P::groups] = n.z;
    }
    __syncwarp();
  }
  __device__ __forceinline__ void clear_sums(T* shared) {
    sums = shared + s.degree * 3 * P::groups + threadIdx.x % kSlice;
    for (int a = 0; a < 3 * degree; ++a) sums[a * kSlice] = T(0);
  }

  __device__ __forceinline__ int size() const { return (count + lanes - 1) / lanes; }
  __device__ __forceinline__ int64_t slot(int e) const {
    return static_cast<int64_t>(first + min(e * lanes + at.lane, count - 1)) * kSlice;
  }
  __device__ __forceinline__ bool real(int e) const { return lanes == 1 || e * lanes + at.lane < count; }
  __device__ __forceinline__ Vec3<T> neighbour(int a) const {
    const T* from = near + a * 3 * P::groups;
    return {from[0], from[P::groups], from[2 * P::groups]};
  }

  __device__ __forceinline__ TetPair<T> pair(int e) const {
    const int64_t base = slot(e);
    const int where = __ldg(s.plan.local + base + at.v);
    TetPair<T> out;
    out.xj = neighbour(where & kMaxDegree);
    out.xk = neighbour(where >> kLocalBits & kMaxDegree);
    out.xl = neighbour(where >> 2 * kLocalBits);
    const T* rest = s.rest.data + at.scene * s.rest.scene + base * 4;
    if constexpr (Pack<T>::size == 4) {
      const Pack<T> r = load_constant(rest + at.v * 4);
      out.k_ij = r.v[0], out.k_ik = r.v[1], out.k_il = r.v[2], out.c6 = r.v[3];
    } else {
      const Pack<T> r = load_constant(rest + at.v * 2), q = load_constant(rest + 2 * kSlice + at.v * 2);
      out.k_ij = r.v[0], out.k_ik = r.v[1], out.k_il = q.v[0], out.c6 = q.v[1];
    }
    out.mu = mu, out.lam = lam;
    if (!s.one_material) {
      const T* m = s.w.material + at.scene * s.material_scene + (base + at.v) * 2;
      out.mu = __ldg(m), out.lam = __ldg(m + 1);
    }
    if (!real(e)) out.k_ij = out.k_ik = out.k_il = out.c6 = T(0), out.mu = out.lam = T(0);
    return out;
  }
  template <class... R>
  __device__ __forceinline__ void total(R&... values) const {
    if constexpr (lanes > 1) (P::sum(values), ...);
  }

  __device__ __forceinline__ void send(int a, const Vec3<T>& v) const {
    T* to = sums + a * 3 * kSlice;
    to[0] += v.x;
    to[kSlice] += v.y;
    to[2 * kSlice] += v.z;
  }
  template <int wanted>
  __device__ __forceinline__ void add(int e, const TetPairAdjoint<T>& a) const {
    const int64_t base = slot(e);
    const int where = __ldg(s.plan.local + base + at.v);
    send(where & kMaxDegree, a.xj);
    send(where >> kLocalBits & kMaxDegree, a.xk);
    send(where >> 2 * kLocalBits, a.xl);
    if constexpr ((wanted & kMaterial) != 0) {
      if (s.one_material) {
        material_bar[0] += a.mu;
        material_bar[1] += a.lam;
      } else if (real(e)) {
        T* m = s.w.material_bar + (at.scene * s.plan.slots * kSlice + base + at.v) * 2;
        m[0] += a.mu;
        m[1] += a.lam;
      }
    }
    if constexpr ((wanted & kRest) != 0) {
      if (real(e)) {
        T* r = s.w.rest_bar + (at.scene * s.plan.slots * kSlice + base + at.v) * 4;
        r[0] += a.k_ij;
        r[1] += a.k_ik;
        r[2] += a.k_il;
        r[3] += a.c6;
      }
    }
  }
  mutable T material_bar[2] = {T(0), T(0)};

  // Writes the rows of the vertex's edges: the sums of its threads, in their order.
  __device__ __forceinline__ void send_rows() const {
    __syncwarp();
    T* rows = s.w.rows + at.scene * (static_cast<int64_t>(s.plan.edge_slots) * kSlice + 1) * kRow;
    const T* from = sums - at.lane * P::groups;
    for (int a = at.lane; a < degree; a += lanes) {
      Vec3<T> sum = zero3<T>();
#pragma unroll
      for (int l = 0; l < lanes; ++l) {
        const T* p = from + a * 3 * kSlice + l * P::groups;
        sum += Vec3<T>{p[0], p[kSlice], p[2 * kSlice]};
      }
      store_row(rows, static_cast<int64_t>(first_edge + a) * kSlice + at.v, sum);
    }
  }
};

// What the neighbours' updates have added to a vertex since its last turn (as in cpu/scene.h).
template <class T, int lanes>
__device__ __forceinline__ Vec3<T> pull_rows(const StepView<T>& s, const Place<lanes>& at, int64_t below) {
  const T* rows = s.w.rows + at.scene * (static_cast<int64_t>(s.plan.edge_slots) * kSlice + 1) * kRow;
  Vec3<T> sum = zero3<T>();
  const int end = __ldg(s.plan.block_incoming + at.block + 1);
#pragma unroll 4
  for (int e = __ldg(s.plan.block_incoming + at.block) + at.lane; e < end; e += lanes) {
    const int row = __ldg(s.plan.incoming + static_cast<int64_t>(e) * kSlice + at.v);
    if (row < below) sum += load_row(rows, row);
  }
  Place<lanes>::sum(sum);
  return sum;
}

template <class Set, class T, int lanes>
__device__ __forceinline__ Block<T> load_block(const StepView<T>& s, const Place<lanes>& at) {
  Block<T> out;
  const int64_t position = static_cast<int64_t>(at.block) * kSlice + at.v;
  const int64_t vectors = at.scene * s.positions * 3;
  out.state.x = load_row(s.w.x, at.scene * s.positions + position);
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

// All threads of a cooperative launch wait for each other; `turn` counts the meetings.
__device__ __forceinline__ void grid_barrier(unsigned* counter, unsigned& turn) {
  __syncthreads();
  turn += gridDim.x;
  if (threadIdx.x == 0) {
    __threadfence();
    atomicAdd(counter, 1u);
    while (*reinterpret_cast<volatile unsigned*>(counter) < turn) {
    }
    __threadfence();
  }
  __syncthreads();
}

// Calls visit(scene, block, part) for the warps' share of each color, with barriers between colors.
template <class T, int lanes, class Visit>
__device__ __forceinline__ void each_color(const StepView<T>& s, const Range& range, bool backward, Visit&& visit) {
  const bool own = range.regime == kBlock;
  const int64_t scenes_at_once = own ? 1 : s.scenes;
  const unsigned warp = threadIdx.x / kSlice, warps_of_block = blockDim.x / kSlice;
  const unsigned first = own ? warp : blockIdx.x * warps_of_block + warp;
  const unsigned stride = own ? warps_of_block : gridDim.x * warps_of_block;
  unsigned turn = 0;
  for (int64_t own_scene = own ? blockIdx.x : 0; own_scene < (own ? s.scenes : 1); own_scene += gridDim.x) {
    for (int k = range.first_sweep; k < range.end_sweep; ++k) {
      for (int c = range.first_color; c < range.end_color; ++c) {
        // the reverse meets what is pinned (color `colors`) after the last color, at the end of each sweep
        const int color = backward && c < s.plan.colors ? s.plan.colors - 1 - c : c;
        const int begin = __ldg(s.plan.color_block + color);
        const int end = color < s.plan.colors ? __ldg(s.plan.color_block + color + 1) : s.plan.blocks;
        const unsigned parts = static_cast<unsigned>(end - begin) * lanes;
        for (unsigned i = first; i < parts * static_cast<unsigned>(scenes_at_once); i += stride) {
          const unsigned scene = scenes_at_once == 1 ? 0 : i / parts, part = i - scene * parts;
          visit(own_scene + scene, k, color, begin + static_cast<int>(part / lanes), static_cast<int>(part % lanes));
        }
        if (own) {
          __syncthreads();
        } else if (range.regime == kGrid) {
          grid_barrier(range.barrier, turn);
        }
      }
    }
  }
}

}  // namespace diffvbd::cuda
