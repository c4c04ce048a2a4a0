// A scene per thread: the scenes of a batch share their mesh, so that the threads of a warp visit the same vertex of 32
// scenes at once. Positions lie in shared memory, a column for each thread; what all share is read once for all.
#pragma once

#include <algorithm>
#include <utility>

#include "group.cuh"
#include "scene_kernels.h"

namespace diffvbd::cuda {
namespace {

constexpr int kMaxSceneThreads = 128;
constexpr int kColumn = kSlice + 1;  // distance of a column's entries: one more than a warp, against bank conflicts

// What the threads of a block share: the list of visits, and the rest scalars unless scenes have their own.
template <class T>
struct Visits {
  const int32_t *visit, *pair;  // as in GroupPlan
  const T* rest;                // [pairs, 4] or null
  uint64_t active;              // mask of the vertices that sweeps move

  // rounded, so that the pairs' rows are aligned
  DIFFVBD_FN static size_t visit_ints(const GroupPlan& plan) { return (2 * static_cast<size_t>(plan.num_active) + 3) / 4 * 4; }
  DIFFVBD_FN static size_t ints(const GroupPlan& plan) {
    return visit_ints(plan) + 16 * static_cast<size_t>(plan.num_tets);
  }
  __device__ __forceinline__ Visits(const StepInputs<T>& in, const GroupPlan& plan, unsigned char* memory) {
    int32_t* to = reinterpret_cast<int32_t*>(memory);
    const int visits = static_cast<int>(visit_ints(plan)), pairs = 16 * plan.num_tets;
    for (int i = threadIdx.x; i < 2 * plan.num_active; i += blockDim.x) to[i] = __ldg(plan.visit + i);
    for (int i = threadIdx.x; i < pairs; i += blockDim.x) to[visits + i] = __ldg(plan.visit_pair + i);
    visit = to;
    pair = to + visits;
    __syncthreads();
    rest = nullptr;
    if (in.rest.scene == 0 && in.rest.data) {
      T* own = reinterpret_cast<T*>(to + ints(plan));
      for (int i = threadIdx.x; i < 4 * plan.num_tets; i += blockDim.x) load_rest(in.rest.data, pair[4 * i + 2], own + 4 * i);
      rest = own;
    }
    active = 0;
    for (int r = 0; r < plan.num_active; ++r) active |= uint64_t{1} << (visit[2 * r] & kMaxDegree);
    __syncthreads();
  }
  // Pairs of inactive corners stand in no list: their entries are zero and are never read.
  __device__ __forceinline__ static void load_rest(const T* packed, int pair, T* to) {
    constexpr int width = Pack<T>::size;
    const T* from = packed + (static_cast<int64_t>(pair / kSlice) * 4 * kSlice + pair % kSlice * width);
#pragma unroll
    for (int a = 0; a < 4; ++a) to[a] = __ldg(from + a / width * width * kSlice + a % width);
  }
  __device__ __forceinline__ bool moves(int vertex) const { return active >> vertex & 1; }
};

template <class T>
__device__ __forceinline__ Vec3<T> column3(const T* column, int vertex) {
  const T* a = column + 3 * vertex * kColumn;
  return {a[0], a[kColumn], a[2 * kColumn]};
}
template <class T>
__device__ __forceinline__ void set_column3(T* column, int vertex, const Vec3<T>& v) {
  T* a = column + 3 * vertex * kColumn;
  a[0] = v.x;
  a[kColumn] = v.y;
  a[2 * kColumn] = v.z;
}

// Calls visit(element of [scenes, 3 V], place in a tile) for what a warp's scenes own of an array, side by side.
template <class F>
__device__ __forceinline__ void each_element(int64_t base, int64_t scenes, int size, F&& visit) {
  const int count = static_cast<int>(min(static_cast<int64_t>(kSlice), scenes - base)) * size;
  int item = threadIdx.x % kSlice, scene = 0;
  for (int g = item; g < count; g += kSlice, item += kSlice) {
    while (item >= size) item -= size, ++scene;
    visit(base * size + g, item * kColumn + scene);
  }
}

// The incident tets of one vertex in 32 scenes. x_bar is null in the forward.
template <class T>
struct SceneStar {
  const StepInputs<T>& in;
  const StepAdjoints<T>* out;
  const Visits<T>& list;
  const T* x;
  T* x_bar;
  int64_t scene;
  int first, count, num_tets;
  T mu, lam;

  __device__ __forceinline__ int size() const { return count; }
  template <class... R>
  __device__ __forceinline__ void total(R&...) const {}
  __device__ __forceinline__ int4 entry(int e) const {
    return reinterpret_cast<const int4*>(list.pair)[first + e];
  }
  __device__ __forceinline__ TetPair<T> pair(int e) const {
    const int4 row = entry(e);
    TetPair<T> p;
    p.xj = column3(x, row.x & kMaxDegree);
    p.xk = column3(x, row.x >> kLocalBits & kMaxDegree);
    p.xl = column3(x, row.x >> 2 * kLocalBits);
    T rest[4];
    if (list.rest) {
      const T* from = list.rest + 4 * (first + e);
#pragma unroll
      for (int a = 0; a < 4; ++a) rest[a] = from[a];
    } else {
      Visits<T>::load_rest(in.rest.data + scene * in.rest.scene, row.z, rest);
    }
    p.k_ij = rest[0], p.k_ik = rest[1], p.k_il = rest[2], p.c6 = rest[3];
    p.mu = in.mu.item == 0 ? mu : __ldg(in.mu.data + scene * in.mu.scene + row.y);
    p.lam = in.lam.item == 0 ? lam : __ldg(in.lam.data + scene * in.lam.scene + row.y);
    return p;
  }
  __device__ __forceinline__ void send(int vertex, const Vec3<T>& v) const {
    T* to = x_bar + 3 * vertex * kColumn;
    to[0] += v.x;
    to[kColumn] += v.y;
    to[2 * kColumn] += v.z;
  }
  template <int wanted>
  __device__ __forceinline__ void add(int e, const TetPairAdjoint<T>& a) const {
    const int4 row = entry(e);
    send(row.x & kMaxDegree, a.xj);
    send(row.x >> kLocalBits & kMaxDegree, a.xk);
    send(row.x >> 2 * kLocalBits, a.xl);
    if constexpr ((wanted & kMaterial) != 0) {
      mu_bar += a.mu;
      lam_bar += a.lam;
      if (real && out->mu && (in.mu.item != 0 || in.lam.item != 0)) {
        out->mu[scene * num_tets + row.y] += a.mu;
        out->lam[scene * num_tets + row.y] += a.lam;
      }
    }
    if constexpr ((wanted & kRest) != 0) {
      if (real) {
        T* r = out->rest + (scene * num_tets + row.y) * kRestScalars;
        r[weight_index(row.w, other_corner(row.w, 0))] += a.k_ij;
        r[weight_index(row.w, other_corner(row.w, 1))] += a.k_ik;
        r[weight_index(row.w, other_corner(row.w, 2))] += a.k_il;
        r[kRestScalars - 1] += a.c6;
      }
    }
  }
  mutable T mu_bar = T(0), lam_bar = T(0);
  bool real = true;  // threads after the last scene repeat it, and write nothing
};

template <class Set, class T>
__device__ __forceinline__ Block<T> load_scene_block(const StepInputs<T>& in, const GroupPlan& plan,
                                                     const int64_t* data_start, int64_t scene, int vertex, const T* x,
                                                     const T* y) {
  Block<T> b;
  const auto user = [&](const Batched<const T>& t) {
    const T* a = t.data + scene * t.scene + 3 * vertex;
    return Vec3<T>{__ldg(a), __ldg(a + 1), __ldg(a + 2)};
  };
  b.state.x = column3(x, vertex);
  b.state.x_prev = zero3<T>();
  b.state.origin = zero3<T>();
  if constexpr (Set::reads_x_prev) b.state.x_prev = user(in.x_prev);
  if constexpr (Set::of_vertices) {
    if (in.origin.data) b.state.origin = user(in.origin);
  }
  b.state.h = in.parameters.time_step;
  b.y = column3(y, vertex);
  b.mass = __ldg(in.mass.data + scene * in.mass.scene + vertex);
  Set::for_each([&](auto energy, int k) {
    using E = decltype(energy);
    b.data_count[k] = E::per_vertex ? E::stride : in.data_count[k];
    b.data[k] = in.data.data + scene * in.data.scene + data_start[k] +
                (E::per_vertex ? static_cast<int64_t>(vertex) * E::stride : 0);
  });
  return b;
}

// Where the data of each energy starts among those of a scene.
template <class T>
__device__ __forceinline__ void data_starts(const StepInputs<T>& in, const GroupPlan& plan, int64_t* start) {
  int64_t at = 0;
#pragma unroll
  for (int k = 0; k < kVertexEnergies; ++k) {
    start[k] = at;
    at += static_cast<int64_t>(in.data_count[k]) * (is_per_vertex(k, VertexEnergies{}) ? plan.num_vertices : 1);
  }
}

// A warp's tiles hold x and y, in the reverse x_bar and y_bar too.
template <class T>
__device__ __forceinline__ T* tiles_of_warp(const StepInputs<T>& in, const GroupPlan& plan, unsigned char* memory,
                                            int tiles) {
  T* all = reinterpret_cast<T*>(reinterpret_cast<int32_t*>(memory) + Visits<T>::ints(plan)) +
           (in.rest.scene == 0 ? 16 * plan.num_tets : 0);
  return all + threadIdx.x / kSlice * tiles * 3 * plan.num_vertices * kColumn;
}

// Fills the tiles of y and, in the forward, of where the sweeps start.
template <class T>
__device__ __forceinline__ void load_start(const StepInputs<T>& in, const GroupPlan& plan, const Visits<T>& list,
                                           int64_t base, T* x, T* y) {
  const int size = 3 * plan.num_vertices;
  if (!in.fused) {
    each_element(base, in.scenes, size, [&](int64_t from, int to) {
      if (x) x[to] = in.x_start.data[from];
      y[to] = in.y.data[from];
    });
    return;
  }
  const T h = in.parameters.time_step;
  each_element(base, in.scenes, size, [&](int64_t from, int to) {
    const int item = to / kColumn, vertex = item / 3;
    const int64_t scene = base + to % kColumn;
    T value = in.x_prev.data[from];
    if (list.moves(vertex)) {
      const T a = in.acceleration.data[scene * in.acceleration.scene + (in.acceleration.item ? item : item % 3)];
      value = value + h * in.v.data[from] + (h * h) * a;
    } else if (in.held.data) {
      value = in.held.data[scene * in.held.scene + item];
    }
    y[to] = value;
    if (x) x[to] = value;
  });
}

// One launch: as many blocks as the device holds, each going on until all scenes are done.
template <class T, class K>
cudaError_t launch_scenes(K kernel, void** arguments, const StepInputs<T>& in, const GroupPlan& plan, int tiles,
                          const Choice& choice, cudaStream_t stream) {
  const void* function = reinterpret_cast<const void*>(kernel);
  const size_t common = 4 * Visits<T>::ints(plan) + (in.rest.scene == 0 ? 16 * sizeof(T) * plan.num_tets : 0);
  const size_t of_warp = sizeof(T) * tiles * 3 * plan.num_vertices * kColumn;
  if (common + of_warp > choice.shared) return cudaErrorInvalidConfiguration;
  const auto warps = std::min<size_t>(kMaxSceneThreads / kSlice, (choice.shared - common) / of_warp);
  const size_t shared = common + warps * of_warp;
  const int threads = static_cast<int>(warps) * kSlice;
  if (shared > 48 * 1024) {
    const auto attribute = cudaFuncAttributeMaxDynamicSharedMemorySize;
    if (auto error = cudaFuncSetAttribute(function, attribute, static_cast<int>(shared))) return error;
  }
  int resident = 0;
  if (auto error = cudaOccupancyMaxActiveBlocksPerMultiprocessor(&resident, function, threads, shared)) return error;
  const int64_t needed = (in.scenes + threads - 1) / threads;
  const auto blocks = std::min<int64_t>(needed, int64_t{std::max(1, resident)} * choice.multiprocessors);
  return cudaLaunchKernel(function, dim3(static_cast<unsigned>(blocks)), dim3(threads), arguments, shared, stream);
}

}  // namespace
}  // namespace diffvbd::cuda
