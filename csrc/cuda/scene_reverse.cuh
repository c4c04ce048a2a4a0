// The transposed sweeps of a step, a scene per thread.
#pragma once

#include "scene.cuh"

namespace diffvbd::cuda {
namespace {

template <class T, int mask, int wanted>
__global__ void __launch_bounds__(kMaxSceneThreads) scene_reverse(const __grid_constant__ StepInputs<T> in,
                                                               const T* ends, const T* tape,
                                                               const __grid_constant__ StepAdjoints<T> out,
                                                               const __grid_constant__ GroupPlan plan) {
  using Set = EnergySet<mask>;
  extern __shared__ __align__(16) unsigned char memory[];
  const Visits<T> list(in, plan, memory);
  const int size = 3 * plan.num_vertices, lane = threadIdx.x % kSlice, rows = tape_rows(in.tape_policy, Set::filters);
  T* const tile = tiles_of_warp(in, plan, memory, 4);
  T *const y_tile = tile + size * kColumn, *const bar_tile = y_tile + size * kColumn,
           *const y_bar_tile = bar_tile + size * kColumn;
  T *const x = tile + lane, *const y = y_tile + lane, *const x_bar = bar_tile + lane, *const y_bar = y_bar_tile + lane;
  int64_t start[kVertexEnergies];
  data_starts(in, plan, start);
  const T h = in.parameters.time_step, rate = T(1) / h;
  const int64_t stride = static_cast<int64_t>(gridDim.x) * blockDim.x;
  for (int64_t base = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x / kSlice * kSlice;
       base < in.scenes; base += stride) {
    load_start(in, plan, list, base, static_cast<T*>(nullptr), y_tile);
    each_element(base, in.scenes, size, [&](int64_t from, int to) {
      tile[to] = ends[from];
      T bar = out.x_bar ? out.x_bar[from] : T(0);
      if (out.v_bar) bar += rate * out.v_bar[from];
      bar_tile[to] = bar;
      y_bar_tile[to] = T(0);
    });
    __syncwarp();
    if (base + lane < in.scenes) {
      const int64_t scene = base + lane;
      SceneStar<T> star{in, &out, list, x, x_bar, scene, 0, 0, plan.num_tets, T(0), T(0)};
      if (Set::elastic && in.mu.item == 0) star.mu = __ldg(in.mu.data + scene * in.mu.scene);
      if (Set::elastic && in.lam.item == 0) star.lam = __ldg(in.lam.data + scene * in.lam.scene);
      for (int k = in.sweeps - 1; k >= 0; --k) {
        for (int r = plan.num_active - 1; r >= 0; --r) {
          const int vertex = list.visit[2 * r] & kMaxDegree;
          star.count = list.visit[2 * r] >> kLocalBits;
          star.first = list.visit[2 * r + 1];
          Block<T> b = load_scene_block<Set>(in, plan, start, scene, vertex, x, y);
          const T* from = tape + ((static_cast<int64_t>(k) * rows) * plan.num_active + r) * in.scenes + scene;
          const auto get = [&] {
            const T value = __ldg(from);
            from += plan.num_active * in.scenes;
            return value;
          };
          if (in.tape_policy == kCompactTape || Set::filters) b.state.x = {get(), get(), get()};
          Vec3<T> d_raw;
          Sym3<T> H;
          if (in.tape_policy == kFullTape) {
            d_raw = {get(), get(), get()};
            H = {get(), get(), get(), get(), get(), get()};
          } else {
            const System<T> system = assemble<Set>(b, star, in.parameters);
            d_raw = newton_step(b, system, in.parameters);
            H = system.H;
          }
          const Update<T> u = safeguarded<Set>(b, d_raw, in.parameters);
          if (in.tape_policy == kFullTape && !Set::filters) b.state.x -= u.step;
          set_column3(x, vertex, b.state.x);
          const BlockAdjoint<T> bar = reverse_vertex<Set, wanted>(
              b, star, u, H, column3(x_bar, vertex), in.parameters, out.data != nullptr,
              [&](int e, int i, const T& value) {
                const bool own = is_per_vertex(e, VertexEnergies{});
                const int64_t place = start[e] + (own ? static_cast<int64_t>(vertex) * in.data_count[e] : 0) + i;
                out.data[scene * in.data_size + place] += value;
              });
          set_column3(x_bar, vertex, bar.x);
          set_column3(y_bar, vertex, column3(y_bar, vertex) + bar.y);
          if (out.mass) out.mass[scene * plan.num_vertices + vertex] += bar.mass;
          if constexpr (Set::reads_x_prev) {
            T* to = out.x_prev + scene * size + 3 * vertex;
            to[0] += bar.x_prev.x;
            to[1] += bar.x_prev.y;
            to[2] += bar.x_prev.z;
          }
        }
      }
      if (out.mu && in.mu.item == 0 && in.lam.item == 0) {
        out.mu[scene] = star.mu_bar;
        out.lam[scene] = star.lam_bar;
      }
    }
    __syncwarp();
    each_element(base, in.scenes, size, [&](int64_t to, int from) {
      const T begin = bar_tile[from], moved_y = y_bar_tile[from];
      if (!in.fused) {
        out.x_start[to] = begin;
        out.y[to] = moved_y;
        return;
      }
      const bool pinned = !list.moves(from / kColumn / 3), held = pinned && in.held.data != nullptr;
      const T all = begin + moved_y;
      if (out.x) out.x[to] = (held ? T(0) : all) - (out.v_bar ? rate * out.v_bar[to] : T(0));
      if (out.v) out.v[to] = pinned ? T(0) : h * all;
      if (out.acceleration) out.acceleration[to] = pinned ? T(0) : h * h * all;
      if (out.held) out.held[to] = held ? all : T(0);
    });
    __syncwarp();
  }
}

template <class T>
using SceneReverse = void (*)(StepInputs<T>, const T*, const T*, StepAdjoints<T>, GroupPlan);

constexpr int useful(int mask, int wanted) { return (mask & 3) == 0 ? kState : wanted; }

template <class T, int wanted, int... n>
SceneReverse<T> pick_scene_reverse(int index, std::integer_sequence<int, n...>) {
  static constexpr SceneReverse<T> table[kEnergySets] = {
      scene_reverse<T, energy_mask(n), useful(energy_mask(n), wanted)>...};
  return table[index];
}

}  // namespace

template <class T>
cudaError_t run_scene_reverse(const HostPlan& host, const StepInputs<T>& in, const T* ends, const T* tape,
                              const StepAdjoints<T>& out, const Choice& choice, cudaStream_t stream) {
  const GroupPlan& plan = host.plan;
  if (plan.num_vertices > kSmallMesh) return cudaErrorInvalidConfiguration;
  const auto clear = [&](T* p, int64_t per_scene) {
    return p ? cudaMemsetAsync(p, 0, in.scenes * per_scene * sizeof(T), stream) : cudaSuccess;
  };
  const bool per_tet = in.mu.item != 0 || in.lam.item != 0;
  if (auto error = clear(out.mass, plan.num_vertices)) return error;
  if (auto error = clear(out.x_prev, 3 * int64_t{plan.num_vertices})) return error;
  if (auto error = clear(per_tet ? out.mu : nullptr, plan.num_tets)) return error;
  if (auto error = clear(per_tet ? out.lam : nullptr, plan.num_tets)) return error;
  if (auto error = clear(out.rest, int64_t{plan.num_tets} * kRestScalars)) return error;
  if (auto error = clear(out.data, in.data_size)) return error;
  constexpr auto sets = std::make_integer_sequence<int, kEnergySets>{};
  const int index = energy_index(in.energies);
  const auto kernel = choice.wanted & kRest       ? pick_scene_reverse<T, kMaterial | kRest>(index, sets)
                      : choice.wanted & kMaterial ? pick_scene_reverse<T, kMaterial>(index, sets)
                                                  : pick_scene_reverse<T, kState>(index, sets);
  StepInputs<T> inputs = in;
  StepAdjoints<T> adjoints = out;
  GroupPlan list = plan;
  void* arguments[] = {&inputs, &ends, &tape, &adjoints, &list};
  return launch_scenes(kernel, arguments, in, plan, 4, choice, stream);
}

}  // namespace diffvbd::cuda

#define DIFFVBD_INSTANTIATE_SCENE_REVERSE(T)                                                                        \
  template cudaError_t diffvbd::cuda::run_scene_reverse<T>(const HostPlan&, const StepInputs<T>&, const T*,         \
                                                           const T*, const StepAdjoints<T>&, const Choice&,        \
                                                           cudaStream_t);
