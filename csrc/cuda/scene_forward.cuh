// Sweeps of a step, a scene per thread.
#pragma once

#include "scene.cuh"

namespace diffvbd::cuda {
namespace {

// Updates the r-th vertex in sweep k. Returns false and does nothing where a well-conditioned set meets a block that it
// does not suit.
template <class Set, bool common, class T>
__device__ __forceinline__ bool visit(const StepInputs<T>& in, const StepOutputs<T>& out, const GroupPlan& plan,
                                      SceneStar<T, common>& star, T* x, const T* y, int64_t scene, int k, int r) {
  const int vertex = star.go_to(r);
  int64_t start[kVertexEnergies];
  data_starts(in, plan, start);
  const StepParameters<T> q = of_sweep(in.parameters, k + 1 == in.sweeps);
  const Block<T> b = load_scene_block<Set>(in, plan, start, scene, vertex, x, y);
  if constexpr (Set::well_conditioned && Set::filters) {
    if (is_oblique<Set>(b, b.state.x)) return false;
  }
  const NewtonStep<T> newton = newton_step<Set>(b, star, q);
  if constexpr (Set::well_conditioned) {
    if (needs_refinement<Set>(b, star, newton.H)) return false;
  }
  const Update<T> u = update_of<Set>(b, star, newton, q);
  set_column3(x, vertex, moved<Set>(b.state.x, u));
  if (in.tape_policy == kNoTape) return true;
  const int rows = tape_rows(in.tape_policy, Set::kept_scalars);
  T* to = out.tape + ((static_cast<int64_t>(k) * rows) * plan.num_active + r) * in.scenes + scene;
  const auto put = [&](const T& value) {
    *to = value;
    to += plan.num_active * in.scenes;
  };
  record<Set>(in.tape_policy == kFullTape, b, newton, u, put);
  return true;
}

// A well-conditioned set marks the scenes that it does not suit; the other sets repeat those.
template <class T, class Set, bool common>
__global__ void __launch_bounds__(kMaxSceneThreads, 4)
    scene_forward(const __grid_constant__ StepInputs<T> in, const __grid_constant__ StepOutputs<T> out,
                  const __grid_constant__ GroupPlan plan, uint8_t* ill_conditioned) {
  extern __shared__ __align__(16) unsigned char memory[];
  const Visits<T> list(in, plan, memory);
  const int size = 3 * plan.num_vertices, lane = threadIdx.x % kSlice;
  T *const x_tile = tiles_of_warp<T>(plan, memory, 2), *const y_tile = x_tile + size * kColumn;
  T *const x = x_tile + lane, *const y = y_tile + lane;
  const int64_t stride = static_cast<int64_t>(gridDim.x) * blockDim.x;
  for (int64_t base = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x / kSlice * kSlice; base < in.scenes;
       base += stride) {
    const int64_t scene = base + lane;
    const unsigned mine = scenes_to_do<Set>(ill_conditioned, scene, in.scenes);
    if (mine == 0) continue;
    load_start(in, plan, list, base, x_tile, y_tile);
    __syncwarp();
    if (mine >> lane & 1) {
      SceneStar<T, common> star(in, nullptr, plan, list, x, nullptr, scene);
      bool suits = true;
      for (int k = 0; suits && k < in.sweeps; ++k) {
        for (int r = 0; suits && r < plan.num_active; ++r) {
          suits = visit<Set, common>(in, out, plan, star, x, y, scene, k, r);
        }
      }
      if (marks<Set>()) ill_conditioned[scene] = !suits;
    }
    __syncwarp();
    const T rate = T(1) / in.parameters.time_step;
    each_element(
        base, in.scenes, size, [&](int64_t from) { return out.v ? __ldg(in.x_prev.data + from) : T(0); },
        [&](int64_t to, int from, const T& before) {
          if (!(mine >> from % kColumn & 1)) return;
          out.x[to] = x_tile[from];
          if (out.v) out.v[to] = rate * (x_tile[from] - before);
        });
    __syncwarp();
  }
}

template <class T>
using SceneForward = void (*)(StepInputs<T>, StepOutputs<T>, GroupPlan, uint8_t*);

template <class T, bool common, template <int> class Variant, int... n>
SceneForward<T> pick_scene_forward(int index, std::integer_sequence<int, n...>) {
  static constexpr SceneForward<T> table[kFreeSets] = {
      scene_forward<T, typename Variant<free_mask(n)>::Set, common>...};
  return table[index];
}

}  // namespace

template <class T>
cudaError_t run_scene_forward(const HostPlan& host, const StepInputs<T>& in, const StepOutputs<T>& out,
                              const Choice& choice, uint8_t* ill_conditioned, cudaStream_t stream) {
  if (host.plan.num_vertices > kSmallMesh) return cudaErrorInvalidConfiguration;
  constexpr auto sets = std::make_integer_sequence<int, kFreeSets>{};
  const int index = free_index(in.energies);
  StepInputs<T> inputs = in;
  StepOutputs<T> outputs = out;
  GroupPlan plan = host.plan;
  void* arguments[] = {&inputs, &outputs, &plan, &ill_conditioned};
  const auto usual = is_common(in) ? pick_scene_forward<T, true, WellConditionedVariant>(index, sets)
                                   : pick_scene_forward<T, false, WellConditionedVariant>(index, sets);
  const auto error = launch_scenes(usual, arguments, in, plan, 2, choice, stream);
  if (error != cudaSuccess) return error;
  const auto again = is_common(in) ? pick_scene_forward<T, true, IllConditionedVariant>(index, sets)
                                   : pick_scene_forward<T, false, IllConditionedVariant>(index, sets);
  return launch_scenes(again, arguments, in, plan, 2, choice, stream);
}

}  // namespace diffvbd::cuda
