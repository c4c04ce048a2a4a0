// A scene per thread: the scenes of a batch share their mesh, so the threads of a warp visit the same vertex of 32
// scenes at once. Positions are in shared memory, a column for each thread; what scenes share is read once.
#pragma once

#include <algorithm>
#include <utility>

#include "group.cuh"
#include "step.h"

namespace diffvbd::cuda {
namespace {

constexpr int kMaxSceneThreads = 128;
constexpr int kColumn = kSlice + 1;  // stride of a column: one more than a warp, against bank conflicts

// A step takes two kernels: one of well-conditioned sets for all scenes, and one for the scenes that it has marked.
template <int mask>
struct WellConditionedVariant {
  using Set = WellConditioned<EnergySet<mask>>;
};
template <int mask>
struct IllConditionedVariant {
  using Set = EnergySet<mask>;
};
template <class Set>
constexpr bool marks() {
  return Set::well_conditioned;
}
// Bit set of the threads of the warp that have a scene to do.
template <class Set>
__device__ __forceinline__ unsigned scenes_to_do(const uint8_t* ill_conditioned, int64_t scene, int64_t scenes) {
  bool mine = scene < scenes;
  if constexpr (!Set::well_conditioned) mine = mine && ill_conditioned[scene] != 0;
  return __ballot_sync(kWholeWarp, mine);
}

// Shared by the threads of a block: the list of visits, and the rest scalars unless scenes have their own.
template <class T>
struct Visits {
  const int2* visit;  // vertex + (its pairs << kLocalBits), its first pair
  const int4* pair;   // offsets of j, k, l in a column; tet
  const T* rest;      // [pairs, kRestRow]
  uint64_t active;    // mask of the vertices that sweeps move

  // Integers of the visits, rounded so that the pairs' rows are aligned.
  DIFFVBD_FN static int visit_ints(const GroupPlan& plan) { return (2 * plan.num_active + 3) / 4 * 4; }
  DIFFVBD_FN static size_t bytes(const GroupPlan& plan) {
    return 4 * (static_cast<size_t>(visit_ints(plan)) + 16 * static_cast<size_t>(plan.num_tets)) +
           4 * kRestRow * sizeof(T) * static_cast<size_t>(plan.num_tets);
  }
  __device__ __forceinline__ Visits(const StepInputs<T>& in, const GroupPlan& plan, unsigned char* memory) {
    int32_t* to = reinterpret_cast<int32_t*>(memory);
    int4* pairs = reinterpret_cast<int4*>(to + visit_ints(plan));
    T* own = reinterpret_cast<T*>(pairs + 4 * plan.num_tets);
    for (int i = threadIdx.x; i < 2 * plan.num_active; i += blockDim.x) to[i] = __ldg(plan.visit + i);
    for (int i = threadIdx.x; i < 4 * plan.num_tets; i += blockDim.x) {
      const int32_t* row = plan.visit_pair + 4 * i;
      const int where = __ldg(row);
      pairs[i] = {3 * kColumn * (where & kMaxDegree), 3 * kColumn * (where >> kLocalBits & kMaxDegree),
                  3 * kColumn * (where >> 2 * kLocalBits), __ldg(row + 1)};
      if (in.rest.scene == 0 && in.rest.data) load_rest(in.rest.data, __ldg(row + 2), own + kRestRow * i);
    }
    visit = reinterpret_cast<const int2*>(to);
    pair = pairs;
    rest = own;
    __syncthreads();
    active = 0;
    for (int r = 0; r < plan.num_active; ++r) active |= uint64_t{1} << (visit[r].x & kMaxDegree);
  }
  // Pairs of inactive corners are in no list: their entries are zero and never read.
  __device__ __forceinline__ static void load_rest(const T* packed, int pair, T* to) {
    constexpr int width = Pack<T>::size;
    const T* from = packed + (static_cast<int64_t>(pair / kSlice) * kRestRow * kSlice + pair % kSlice * width);
#pragma unroll
    for (int a = 0; a < kRestRow; ++a) to[a] = __ldg(from + a / width * width * kSlice + a % width);
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

// Elements of a warp's scenes in an array [scenes, 3 V]: load(element) for several at once, then keep(element, index in
// a tile, value) for each.
template <class Load, class Keep>
__device__ __forceinline__ void each_element(int64_t base, int64_t scenes, int size, Load&& load, Keep&& keep) {
  constexpr int batch = 8;
  const int count = static_cast<int>(min(static_cast<int64_t>(kSlice), scenes - base)) * size;
  const int lane = threadIdx.x % kSlice;
  int item = lane, scene = 0;
  for (int start = lane; start < count; start += batch * kSlice) {
    decltype(load(base)) values[batch];
#pragma unroll
    for (int u = 0; u < batch; ++u) {
      const int g = start + u * kSlice;
      if (g < count) values[u] = load(base * size + g);
    }
#pragma unroll
    for (int u = 0; u < batch; ++u, item += kSlice) {
      const int g = start + u * kSlice;
      if (g >= count) continue;
      while (item >= size) item -= size, ++scene;
      keep(base * size + g, item * kColumn + scene, values[u]);
    }
  }
}

template <class T>
struct Pair {
  T first, second;
};

// Incident tets of one vertex in 32 scenes. common: scenes share their rest shape, and tets of a scene their material.
// x_bar is null in the forward.
template <class T, bool common>
struct SceneStar {
  const StepInputs<T>& in;
  const StepAdjoints<T>* out;
  const GroupPlan& plan;
  const Visits<T>& list;
  const T* x;
  T* x_bar;
  int64_t scene;
  int vertex, first, count;
  T material[kMaterialScalars];  // of all tets, if they share it

  __device__ __forceinline__ SceneStar(const StepInputs<T>& in, const StepAdjoints<T>* out, const GroupPlan& plan,
                                       const Visits<T>& list, const T* x, T* x_bar, int64_t scene)
      : in(in), out(out), plan(plan), list(list), x(x), x_bar(x_bar), scene(scene) {
#pragma unroll
    for (int m = 0; m < kMaterialScalars; ++m) {
      const Batched<const T>& given = in.material[m];
      material[m] = given.data && given.item == 0 ? __ldg(given.data + scene * given.scene) : T(0);
    }
  }
  __device__ __forceinline__ int go_to(int rank) {
    const int2 v = list.visit[rank];
    count = in.rest.data ? v.x >> kLocalBits : 0;
    first = v.y;
    vertex = v.x & kMaxDegree;
    return vertex;
  }
  __device__ __forceinline__ int size() const { return count; }
  template <class... R>
  __device__ __forceinline__ void total(R&...) const {}
  __device__ __forceinline__ bool any(bool condition) const { return condition; }
  __device__ __forceinline__ void rewind() const {}
  __device__ __forceinline__ void adopt(const SceneStar& a) const {
#pragma unroll
    for (int m = 0; m < kMaterialScalars; ++m) material_bar[m] = a.material_bar[m];
  }
  // A block may lack its y (scene_reverse.cuh); the few ill-conditioned ones load it.
  __device__ __forceinline__ Vec3<T> predictor(const Block<T>& b) const {
    const auto load = [&](const Batched<const T>& t, int c) { return __ldg(t.data + scene * t.scene + c); };
    Vec3<T> y;
    T* to[3] = {&y.x, &y.y, &y.z};
    const T h = in.parameters.time_step;
#pragma unroll
    for (int c = 0; c < 3; ++c) {
      const int item = 3 * vertex + c;
      *to[c] = in.fused ? load(in.x_prev, item) + h * load(in.v, item) +
                              (h * h) * load(in.acceleration, in.acceleration.item ? item : c)
                        : load(in.y, item);
    }
    return y;
  }
  __device__ __forceinline__ Vec3<T> at(int offset) const {
    const T* a = x + offset;
    return {a[0], a[kColumn], a[2 * kColumn]};
  }
  __device__ __forceinline__ TetPair<T> pair(int e) const {
    const int4 row = list.pair[first + e];
    TetPair<T> p;
    p.xj = at(row.x);
    p.xk = at(row.y);
    p.xl = at(row.z);
#pragma unroll
    for (int m = 0; m < kMaterialScalars; ++m) p.material[m] = material[m];
    const Pack<T>* shared = reinterpret_cast<const Pack<T>*>(list.rest + kRestRow * (first + e));
    T rest[kRestRow];
#pragma unroll
    for (int a = 0; a < kRestRow; ++a) rest[a] = shared[a / Pack<T>::size].v[a % Pack<T>::size];
    if constexpr (!common) {
      if (in.rest.scene != 0) {
        const int pair = __ldg(plan.visit_pair + 4 * (first + e) + 2);
        Visits<T>::load_rest(in.rest.data + scene * in.rest.scene, pair, rest);
      }
#pragma unroll
      for (int m = 0; m < kMaterialScalars; ++m) {
        const Batched<const T>& given = in.material[m];
        if (given.item != 0) p.material[m] = __ldg(given.data + scene * given.scene + row.w);
      }
    }
#pragma unroll
    for (int a = 0; a < kPairRest; ++a) p.rest[a] = rest[a];
    return p;
  }
  __device__ __forceinline__ void scatter(int offset, const Vec3<T>& v) const {
    T* to = x_bar + offset;
    to[0] += v.x;
    to[kColumn] += v.y;
    to[2 * kColumn] += v.z;
  }
  __device__ __forceinline__ const SceneStar& local() const { return *this; }  // it has the sums
  template <class Law, int wanted>
  __device__ __forceinline__ Vec3<T> reverse_tets(const Reversed<T>& update) const {
    return diffvbd::reverse_tets<Law, wanted>(*this, update);
  }
  template <int wanted>
  __device__ static constexpr bool wants(int what) {
    return (wanted & what) != 0;
  }
  __device__ __forceinline__ void add(int e, const TetAdjoint<T>& a) const {
    const int4 row = list.pair[first + e];
    scatter(row.x, a.xj);
    scatter(row.y, a.xk);
    scatter(row.z, a.xl);
  }
  __device__ __forceinline__ void add_material(int e, const T* bar) const {
#pragma unroll
    for (int m = 0; m < kMaterialScalars; ++m) material_bar[m] += bar[m];
    if (!common && out->material[0] && !one_for_items(in.material)) {
      const int64_t tet = scene * plan.num_tets + list.pair[first + e].w;
#pragma unroll
      for (int m = 0; m < kMaterialScalars; ++m) out->material[m][tet] += bar[m];
    }
  }
  __device__ __forceinline__ void add_rest(int e, const T* bar) const {
    const int own = __ldg(plan.visit_pair + 4 * (first + e) + 3);
    T* to = out->rest + (scene * plan.num_tets + list.pair[first + e].w) * kRestScalars;
#pragma unroll
    for (int a = 0; a < kPairRest; ++a) to[TetLayout::rest_index(own, a)] += bar[a];
  }
  mutable T material_bar[kMaterialScalars] = {};
};

// y: null where nothing depends on it.
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
  b.y = y ? column3(y, vertex) : zero3<T>();
  b.mass = __ldg(in.mass.data + scene * in.mass.scene + vertex);
  Set::for_each([&](auto energy, int k) {
    using E = decltype(energy);
    b.data_count[k] = E::per_vertex ? E::stride : in.data_count[k];
    b.data[k] = in.data.data + scene * in.data.scene + data_start[k] +
                (E::per_vertex ? static_cast<int64_t>(vertex) * E::stride : 0);
  });
  return b;
}

// Start of the data of each energy among those of a scene.
template <class T>
__device__ __forceinline__ void data_starts(const StepInputs<T>& in, const GroupPlan& plan, int64_t* start) {
  int64_t at = 0;
#pragma unroll
  for (int k = 0; k < kVertexEnergies; ++k) {
    start[k] = at;
    at += static_cast<int64_t>(in.data_count[k]) * (is_per_vertex(k, VertexEnergies{}) ? plan.num_vertices : 1);
  }
}

// Tiles of a warp, one for each array of positions.
template <class T>
__device__ __forceinline__ T* tiles_of_warp(const GroupPlan& plan, unsigned char* memory, int tiles) {
  T* all = reinterpret_cast<T*>(memory + Visits<T>::bytes(plan));
  return all + threadIdx.x / kSlice * tiles * 3 * plan.num_vertices * kColumn;
}

// Fills the tiles of y and of the start of the sweeps; either may be null.
template <class T>
__device__ __forceinline__ void load_start(const StepInputs<T>& in, const GroupPlan& plan, const Visits<T>& list,
                                           int64_t base, T* x, T* y) {
  const int size = 3 * plan.num_vertices;
  if (!in.fused) {
    each_element(
        base, in.scenes, size,
        [&](int64_t from) { return Pair<T>{x ? __ldg(in.x_start.data + from) : T(0), __ldg(in.y.data + from)}; },
        [&](int64_t, int to, const Pair<T>& value) {
          if (x) x[to] = value.first;
          if (y) y[to] = value.second;
        });
    return;
  }
  const T h = in.parameters.time_step;
  each_element(
      base, in.scenes, size,
      [&](int64_t from) { return Pair<T>{__ldg(in.x_prev.data + from), __ldg(in.v.data + from)}; },
      [&](int64_t, int to, const Pair<T>& state) {
        const int item = to / kColumn;
        const int64_t scene = base + to % kColumn;
        T value = state.first;
        if (list.moves(item / 3)) {
          const T* a = in.acceleration.data + scene * in.acceleration.scene;
          value = value + h * state.second + (h * h) * __ldg(a + (in.acceleration.item ? item : item % 3));
        } else if (in.prescribed.data) {
          value = in.prescribed.data[scene * in.prescribed.scene + item];
        }
        if (y) y[to] = value;
        if (x) x[to] = value;
      });
}

template <class T>
bool is_common(const StepInputs<T>& in) {
  return in.rest.scene == 0 && one_for_items(in.material);
}

// One launch of as many blocks as the device holds, which loop over the scenes.
template <class T, class K>
cudaError_t launch_scenes(K kernel, void** arguments, const StepInputs<T>& in, const GroupPlan& plan, int tiles,
                          const Choice& choice, cudaStream_t stream) {
  const void* function = reinterpret_cast<const void*>(kernel);
  const size_t common = Visits<T>::bytes(plan);
  const size_t of_warp = sizeof(T) * tiles * 3 * plan.num_vertices * kColumn;
  if (common + of_warp > choice.shared) return cudaErrorInvalidConfiguration;
  // block size with most warps on a multiprocessor
  int threads = 0, resident = 0;
  size_t shared = 0;
  for (int warps = 1; warps <= kMaxSceneThreads / kSlice; ++warps) {
    const size_t bytes = common + warps * of_warp;
    if (bytes > choice.shared) break;
    if (bytes > 48 * 1024) {
      const auto attribute = cudaFuncAttributeMaxDynamicSharedMemorySize;
      if (auto error = cudaFuncSetAttribute(function, attribute, static_cast<int>(choice.shared))) return error;
    }
    int blocks = 0;
    if (auto error = cudaOccupancyMaxActiveBlocksPerMultiprocessor(&blocks, function, warps * kSlice, bytes)) {
      return error;
    }
    if (blocks * warps * kSlice < resident * threads) continue;
    threads = warps * kSlice, resident = blocks, shared = bytes;
  }
  const int64_t needed = (in.scenes + threads - 1) / threads;
  const auto blocks = std::min<int64_t>(needed, int64_t{std::max(1, resident)} * choice.multiprocessors);
  return cudaLaunchKernel(function, dim3(static_cast<unsigned>(blocks)), dim3(threads), arguments, shared, stream);
}

}  // namespace
}  // namespace diffvbd::cuda
