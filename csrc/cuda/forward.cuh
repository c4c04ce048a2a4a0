// The sweeps, one instantiation for each set of energies and number of threads per vertex.
#pragma once

#include <utility>

#include "schedule.cuh"

namespace diffvbd::cuda {
namespace {

// What the threads of a warp do at one turn.
struct Turn {
  int64_t scene;
  int sweep, block, part;
};

// Updates a warp's vertices; false, and nothing is done, where a usual set finds a block that it does not suit.
template <class Set, class T, int lanes>
__device__ __forceinline__ bool update(const StepView<T>& s, T* shared, const Turn& turn) {
  const Place<lanes> at(turn.scene, turn.block, turn.part);
  const int rank = __ldg(s.plan.block_rank + at.block) + at.v, end_rank = __ldg(s.plan.block_rank + at.block + 1);
  if (rank - at.group >= end_rank) return true;  // the whole warp: phantoms alone
  GroupStar<T, lanes> star(s, at, shared);
  if (s.has_tets) star.fetch_neighbours(s.own);
  const Block<T> b = load_block<Set>(s, at, s.own);
  if constexpr (Set::usual && Set::filters) {
    if (star.any(is_oblique<Set>(b, b.state.x))) return false;
  }
  const StepParameters<T> q = of_sweep(s.parameters, turn.sweep + 1 == s.sweeps);
  const NewtonStep<T> newton = newton_step<Set>(b, star, q);
  if constexpr (Set::usual) {
    if (is_rare<Set>(b, star, newton.H)) return false;
  }
  const Update<T> u = safeguarded<Set>(b, newton.d_raw, q);
  const int64_t position = static_cast<int64_t>(at.block) * kSlice + at.v;
  if (at.lane == 0) store_row(s.w.x, at.scene * s.positions + position, moved<Set>(b.state.x, u));
  if (s.tape_policy != kNoTape && at.lane == 0 && rank < end_rank) {
    const int rows = tape_rows(s.tape_policy, Set::keeps_positions);
    T* to = s.tape + (at.scene * s.sweeps + turn.sweep) * rows * s.plan.num_active + rank;
    const auto put = [&](const T& value) {
      *to = value;
      to += s.plan.num_active;
    };
    record<Set>(s.tape_policy == kFullTape, b, newton, put);
  }
  return true;
}

// Out of line, so that what few vertices need takes no registers from the others.
template <class Set, class T, int lanes>
__device__ __noinline__ void rare_update(const StepView<T>& s, T* shared, Turn turn) {
  update<Set, T, lanes>(s, shared, turn);
}

// What the usual blocks take: the rare ones must do with as many.
template <class T, class Set>
constexpr int forward_registers() {
  if (sizeof(T) == sizeof(float)) return Set::contact ? 96 : 80;
  return Set::contact ? 160 : Set::filters ? 144 : 128;
}

template <class T, int mask, int lanes>
__global__ void __maxnreg__((forward_registers<T, EnergySet<mask>>()))
    sweep_forward(const __grid_constant__ StepView<T> s, const __grid_constant__ Range range) {
  using Set = EnergySet<mask>;
  T* const shared = memory_of_warp<T, lanes>(s, false);
  wait_for_previous();
  each_color<T, lanes>(s, range, false, [&](int64_t scene, int sweep, int block, int part) {
    const Turn turn{scene, sweep, block, part};
    if (!update<Usual<Set>, T, lanes>(s, shared, turn)) rare_update<Set, T, lanes>(s, shared, turn);
    __syncwarp();
  });
}

template <class T, int mask, int lanes>
constexpr SweepKernel<T> forward_variant() {
  if constexpr (is_built(mask, lanes)) return sweep_forward<T, mask, lanes>;
  return nullptr;
}

template <class T, int lanes, int... n>
SweepKernel<T> pick_forward(int index, std::integer_sequence<int, n...>) {
  static constexpr SweepKernel<T> table[kEnergySets] = {forward_variant<T, energy_mask(n), lanes>()...};
  return table[index];
}

}  // namespace

template <class T>
SweepKernel<T> forward_kernel(int energies, int lanes) {
  constexpr auto sets = std::make_integer_sequence<int, kEnergySets>{};
  const int index = energy_index(energies);
  switch (lanes) {
    case kFewLanes:
      return pick_forward<T, kFewLanes>(index, sets);
    case kSomeLanes:
      return pick_forward<T, kSomeLanes>(index, sets);
    case kManyLanes:
      return pick_forward<T, kManyLanes>(index, sets);
    default:
      return pick_forward<T, kSpillLanes>(index, sets);
  }
}

}  // namespace diffvbd::cuda

#define DIFFVBD_INSTANTIATE_FORWARD(T) \
  template diffvbd::cuda::SweepKernel<T> diffvbd::cuda::forward_kernel<T>(int, int);
