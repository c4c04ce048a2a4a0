// The sweeps of a step, a scene per thread.
#pragma once

#include "scene.cuh"

namespace diffvbd::cuda {
namespace {

template <class T, int mask>
__global__ void __launch_bounds__(kMaxSceneThreads) scene_forward(const __grid_constant__ StepInputs<T> in,
                                                               const __grid_constant__ StepOutputs<T> out,
                                                               const __grid_constant__ GroupPlan plan) {
  using Set = EnergySet<mask>;
  extern __shared__ __align__(16) unsigned char memory[];
  const Visits<T> list(in, plan, memory);
  const int size = 3 * plan.num_vertices, lane = threadIdx.x % kSlice, rows = tape_rows(in.tape_policy, Set::filters);
  T* const tile = tiles_of_warp(in, plan, memory, 2);
  T *const x = tile + lane, *const y = x + size * kColumn;
  int64_t start[kVertexEnergies];
  data_starts(in, plan, start);
  const int64_t stride = static_cast<int64_t>(gridDim.x) * blockDim.x;
  for (int64_t base = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x / kSlice * kSlice;
       base < in.scenes; base += stride) {
    load_start(in, plan, list, base, tile, tile + size * kColumn);
    __syncwarp();
    const bool real = base + lane < in.scenes;
    const int64_t scene = real ? base + lane : base;
    if (real) {
      SceneStar<T> star{in, nullptr, list, x, nullptr, scene, 0, 0, plan.num_tets, T(0), T(0)};
      if (Set::elastic && in.mu.item == 0) star.mu = __ldg(in.mu.data + scene * in.mu.scene);
      if (Set::elastic && in.lam.item == 0) star.lam = __ldg(in.lam.data + scene * in.lam.scene);
      for (int k = 0; k < in.sweeps; ++k) {
        for (int r = 0; r < plan.num_active; ++r) {
          const int vertex = list.visit[2 * r] & kMaxDegree;
          star.count = list.visit[2 * r] >> kLocalBits;
          star.first = list.visit[2 * r + 1];
          const Block<T> b = load_scene_block<Set>(in, plan, start, scene, vertex, x, y);
          const System<T> system = assemble<Set>(b, star, in.parameters);
          const Update<T> u = safeguarded<Set>(b, newton_step(b, system, in.parameters), in.parameters);
          set_column3(x, vertex, moved<Set>(b.state.x, u));
          if (in.tape_policy == kNoTape) continue;
          T* to = out.tape + ((static_cast<int64_t>(k) * rows) * plan.num_active + r) * in.scenes + scene;
          const auto put = [&](const T& value) {
            *to = value;
            to += plan.num_active * in.scenes;
          };
          if (in.tape_policy == kCompactTape || Set::filters) put(b.state.x.x), put(b.state.x.y), put(b.state.x.z);
          if (in.tape_policy == kFullTape) {
            put(u.d_raw.x), put(u.d_raw.y), put(u.d_raw.z);
            put(system.H.xx), put(system.H.xy), put(system.H.xz);
            put(system.H.yy), put(system.H.yz), put(system.H.zz);
          }
        }
      }
    }
    __syncwarp();
    const T rate = T(1) / in.parameters.time_step;
    each_element(base, in.scenes, size, [&](int64_t to, int from) {
      out.x[to] = tile[from];
      if (out.v) out.v[to] = rate * (tile[from] - in.x_prev.data[to]);
    });
    __syncwarp();
  }
}

template <class T>
using SceneForward = void (*)(StepInputs<T>, StepOutputs<T>, GroupPlan);

template <class T, int... n>
SceneForward<T> pick_scene_forward(int index, std::integer_sequence<int, n...>) {
  static constexpr SceneForward<T> table[kEnergySets] = {scene_forward<T, energy_mask(n)>...};
  return table[index];
}

}  // namespace

template <class T>
cudaError_t run_scene_forward(const HostPlan& host, const StepInputs<T>& in, const StepOutputs<T>& out,
                              const Choice& choice, cudaStream_t stream) {
  if (host.plan.num_vertices > kSmallMesh) return cudaErrorInvalidConfiguration;
  const auto kernel =
      pick_scene_forward<T>(energy_index(in.energies), std::make_integer_sequence<int, kEnergySets>{});
  StepInputs<T> inputs = in;
  StepOutputs<T> outputs = out;
  GroupPlan plan = host.plan;
  void* arguments[] = {&inputs, &outputs, &plan};
  return launch_scenes(kernel, arguments, in, plan, 2, choice, stream);
}

}  // namespace diffvbd::cuda

#define DIFFVBD_INSTANTIATE_SCENE_FORWARD(T)                                                                     \
  template cudaError_t diffvbd::cuda::run_scene_forward<T>(const HostPlan&, const StepInputs<T>&,                \
                                                           const StepOutputs<T>&, const Choice&, cudaStream_t);
