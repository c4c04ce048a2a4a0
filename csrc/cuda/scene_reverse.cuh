// Transposed sweeps of a step, a scene per thread.
#pragma once

#include "scene.cuh"

namespace diffvbd::cuda {
namespace {

// Whether the predictor needs a tile: only for values that the tape lacks, and for masses.
template <class T>
DIFFVBD_FN bool reads_y(const StepAdjoints<T>& out, int policy, bool filters) {
  return out.mass != nullptr || (filters && policy != kFullTape);
}

// Columns of a thread's scene.
template <class T>
struct Columns {
  T* x;
  const T* y;
  T *x_bar, *y_bar;
};

// Reversed visits of a scene, counted down: visit n has rank (n - 1) % active in sweep (n - 1) / active.
template <class Set, int wanted, bool common, class T>
struct ReverseVisits {
  const StepInputs<T>& in;
  const T* tape;
  const StepAdjoints<T>& out;
  const GroupPlan& plan;
  const Columns<T>& columns;
  int64_t scene;
  SceneStar<T, common> star;

  __device__ __forceinline__ ReverseVisits(const StepInputs<T>& in, const T* tape, const StepAdjoints<T>& out,
                                           const GroupPlan& plan, const Visits<T>& list, const Columns<T>& columns,
                                           int64_t scene)
      : in(in),
        tape(tape),
        out(out),
        plan(plan),
        columns(columns),
        scene(scene),
        star(in, &out, plan, list, columns.x, columns.x_bar, scene) {}

  __device__ __forceinline__ Recalled<T> read(int k, int r) const {
    const int rows = tape_rows(in.tape_policy, Set::kept_scalars);
    const T* from = tape + ((static_cast<int64_t>(k) * rows) * plan.num_active + r) * in.scenes + scene;
    const auto get = [&] {
      const T value = __ldg(from);
      from += plan.num_active * in.scenes;
      return value;
    };
    return recall<Set, T>(in.tape_policy == kFullTape, get);
  }

  // Returns how many are left: a well-conditioned set stops before a block that it does not suit.
  __device__ __forceinline__ int run(int left) {
    if (left > 0) {
      int64_t start[kVertexEnergies];
      data_starts(in, plan, start);
      int k = (left - 1) / plan.num_active, r = (left - 1) % plan.num_active;
      // the tape of a visit is prefetched during the visit before it
      Recalled<T> next = read(k, r);
      for (; left > 0; --left) {
        const int rank = r;
        const bool last = k + 1 == in.sweeps;
        Recalled<T> now = next;
        if (--r < 0) r = plan.num_active - 1, --k;
        if (left > 1) next = read(k, r);
        if (!visit(start, rank, last, now)) break;
      }
    }
    if (left == 0 && out.material[0] && one_for_items(in.material)) {
#pragma unroll
      for (int m = 0; m < kMaterialScalars; ++m) out.material[m][scene] = star.material_bar[m];
    }
    return left;
  }

 private:
  __device__ __forceinline__ bool visit(const int64_t* start, int rank, bool last, Recalled<T>& now) {
    const bool full = in.tape_policy == kFullTape;
    const int vertex = star.go_to(rank);
    const StepParameters<T> q = of_sweep(in.parameters, last);
    Block<T> b = load_scene_block<Set>(in, plan, start, scene, vertex, columns.x, columns.y);
    if constexpr (Set::well_conditioned && Set::filters) {
      if (is_oblique<Set>(b, now.x_old, out.data != nullptr)) return false;
    }
    const Update<T> u = replayed<Set>(b, star, now, full, q);
    if constexpr (Set::well_conditioned) {
      if (needs_refinement<Set>(b, star, now.H)) return false;
    }
    set_column3(columns.x, vertex, b.state.x);
    const BlockAdjoint<T> bar = reverse_vertex<Set, wanted>(
        b, star, u, now, column3(columns.x_bar, vertex), q, out.data != nullptr, [&](int e, int i, const T& value) {
          const bool own = is_per_vertex(e, VertexEnergies{});
          const int64_t place = start[e] + (own ? static_cast<int64_t>(vertex) * in.data_count[e] : 0) + i;
          out.data[scene * in.data_size + place] += value;
        });
    set_column3(columns.x_bar, vertex, bar.x);
    set_column3(columns.y_bar, vertex, column3(columns.y_bar, vertex) + bar.y);
    if (out.mass) out.mass[scene * plan.num_vertices + vertex] += bar.mass;
    if constexpr (Set::reads_x_prev) {
      T* to = out.x_prev + (scene * plan.num_vertices + vertex) * 3;
      to[0] += bar.x_prev.x;
      to[1] += bar.x_prev.y;
      to[2] += bar.x_prev.z;
    }
    return true;
  }
};

// Clears what a first attempt may have added to the adjoints of a scene.
template <class T>
__device__ void clear_scene(const StepInputs<T>& in, const StepAdjoints<T>& out, const GroupPlan& plan, int64_t scene) {
  const auto clear = [&](T* p, int64_t count) {
    for (int64_t i = 0; p != nullptr && i < count; ++i) p[scene * count + i] = T(0);
  };
  clear(out.mass, plan.num_vertices);
  clear(out.x_prev, 3 * int64_t{plan.num_vertices});
  for (int m = 0; !one_for_items(in.material) && m < kMaterialScalars; ++m) clear(out.material[m], plan.num_tets);
  clear(out.rest, int64_t{plan.num_tets} * kRestScalars);
  clear(out.data, in.data_size);
}

// Blocks of a multiprocessor that share its registers. In float64 three would spill: a million cubes took a twelfth
// longer.
template <class T>
constexpr int scene_reverse_blocks() {
  return sizeof(T) == sizeof(double) ? 2 : 3;
}

// A well-conditioned set marks the scenes that it does not suit; the other sets repeat those.
template <class T, class Set, int wanted, bool common>
__global__ void __launch_bounds__(kMaxSceneThreads, scene_reverse_blocks<T>())
    scene_reverse(const __grid_constant__ StepInputs<T> in, const T* ends, const T* tape,
                  const __grid_constant__ StepAdjoints<T> out, const __grid_constant__ GroupPlan plan,
                  uint8_t* ill_conditioned) {
  extern __shared__ __align__(16) unsigned char memory[];
  const Visits<T> list(in, plan, memory);
  const int size = 3 * plan.num_vertices, lane = threadIdx.x % kSlice;
  const bool needs_y = reads_y(out, in.tape_policy, Set::filters);
  T* const x_tile = tiles_of_warp<T>(plan, memory, needs_y ? 4 : 3);
  T *const bar_tile = x_tile + size * kColumn, *const y_bar_tile = bar_tile + size * kColumn;
  T* const y_tile = needs_y ? y_bar_tile + size * kColumn : nullptr;
  T *const x = x_tile + lane, *const x_bar = bar_tile + lane, *const y_bar = y_bar_tile + lane;
  const T* const y = needs_y ? y_tile + lane : nullptr;
  const T h = in.parameters.time_step, rate = T(1) / h;
  const int64_t stride = static_cast<int64_t>(gridDim.x) * blockDim.x;
  for (int64_t base = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x / kSlice * kSlice; base < in.scenes;
       base += stride) {
    const int64_t scene = base + lane;
    const unsigned mine = scenes_to_do<Set>(ill_conditioned, scene, in.scenes);
    if (mine == 0) continue;
    if (needs_y) load_start(in, plan, list, base, static_cast<T*>(nullptr), y_tile);
    each_element(
        base, in.scenes, size,
        [&](int64_t from) {
          T bar = out.x_bar ? __ldg(out.x_bar + from) : T(0);
          if (out.v_bar) bar += rate * __ldg(out.v_bar + from);
          return Pair<T>{__ldg(ends + from), bar};
        },
        [&](int64_t, int to, const Pair<T>& value) {
          x_tile[to] = value.first;
          bar_tile[to] = value.second;
          y_bar_tile[to] = T(0);
        });
    __syncwarp();
    if (mine >> lane & 1) {
      if constexpr (!Set::well_conditioned) clear_scene(in, out, plan, scene);
      const Columns<T> columns{x, y, x_bar, y_bar};
      ReverseVisits<Set, wanted, common, T> visits(in, tape, out, plan, list, columns, scene);
      const int left = visits.run(in.sweeps * plan.num_active);
      if (marks<Set>()) ill_conditioned[scene] = left > 0;
    }
    __syncwarp();
    each_element(
        base, in.scenes, size, [&](int64_t to) { return out.v_bar ? rate * __ldg(out.v_bar + to) : T(0); },
        [&](int64_t to, int from, const T& of_velocity) {
          if (!(mine >> from % kColumn & 1)) return;
          const T begin = bar_tile[from], moved_y = y_bar_tile[from];
          if (!in.fused) {
            out.x_start[to] = begin;
            out.y[to] = moved_y;
            return;
          }
          const bool pinned = !list.moves(from / kColumn / 3), prescribed = pinned && in.prescribed.data != nullptr;
          const T all = begin + moved_y;
          if (out.x) out.x[to] = (prescribed ? T(0) : all) - of_velocity;
          if (out.v) out.v[to] = pinned ? T(0) : h * all;
          if (out.acceleration) out.acceleration[to] = pinned ? T(0) : h * h * all;
          if (out.prescribed) out.prescribed[to] = prescribed ? all : T(0);
        });
    __syncwarp();
  }
}

template <class T>
using SceneReverse = void (*)(StepInputs<T>, const T*, const T*, StepAdjoints<T>, GroupPlan, uint8_t*);

template <class T, template <int> class Variant, int wanted, bool common, int... n>
SceneReverse<T> pick_scene_reverse(int index, std::integer_sequence<int, n...>) {
  static constexpr SceneReverse<T> table[kFreeSets] = {
      scene_reverse<T, typename Variant<free_mask(n)>::Set, wanted, common>...};
  return table[index];
}
template <class T, template <int> class Variant, bool common>
SceneReverse<T> pick_scene_reverse(int energies, int wanted) {
  constexpr auto sets = std::make_integer_sequence<int, kFreeSets>{};
  const int index = free_index(energies);
  // differentiated rest shapes are not common, or their memory traffic dominates
  if (wanted & kRest) return pick_scene_reverse<T, Variant, kMaterial | kRest, false>(index, sets);
  if (wanted & kMaterial) return pick_scene_reverse<T, Variant, kMaterial, common>(index, sets);
  return pick_scene_reverse<T, Variant, kState, common>(index, sets);
}

}  // namespace

template <class T>
cudaError_t run_scene_reverse(const HostPlan& host, const StepInputs<T>& in, const T* ends, const T* tape,
                              const StepAdjoints<T>& out, const Choice& choice, uint8_t* ill_conditioned,
                              cudaStream_t stream) {
  const GroupPlan& plan = host.plan;
  if (plan.num_vertices > kSmallMesh) return cudaErrorInvalidConfiguration;
  const auto clear = [&](T* p, int64_t per_scene) {
    return p ? cudaMemsetAsync(p, 0, in.scenes * per_scene * sizeof(T), stream) : cudaSuccess;
  };
  const bool per_tet = !one_for_items(in.material);
  if (auto error = clear(out.mass, plan.num_vertices)) return error;
  if (auto error = clear(out.x_prev, 3 * int64_t{plan.num_vertices})) return error;
  for (T* material : out.material) {
    if (auto error = clear(per_tet ? material : nullptr, plan.num_tets)) return error;
  }
  if (auto error = clear(out.rest, int64_t{plan.num_tets} * kRestScalars)) return error;
  if (auto error = clear(out.data, in.data_size)) return error;
  const int tiles = reads_y(out, in.tape_policy, any_filter(in.energies, VertexEnergies{})) ? 4 : 3;
  StepInputs<T> inputs = in;
  StepAdjoints<T> adjoints = out;
  GroupPlan list = plan;
  void* arguments[] = {&inputs, &ends, &tape, &adjoints, &list, &ill_conditioned};
  const auto usual = is_common(in) ? pick_scene_reverse<T, WellConditionedVariant, true>(in.energies, choice.wanted)
                                   : pick_scene_reverse<T, WellConditionedVariant, false>(in.energies, choice.wanted);
  const auto error = launch_scenes(usual, arguments, in, plan, tiles, choice, stream);
  if (error != cudaSuccess) return error;
  const auto again = is_common(in) ? pick_scene_reverse<T, IllConditionedVariant, true>(in.energies, choice.wanted)
                                   : pick_scene_reverse<T, IllConditionedVariant, false>(in.energies, choice.wanted);
  return launch_scenes(again, arguments, in, plan, tiles, choice, stream);
}

}  // namespace diffvbd::cuda
