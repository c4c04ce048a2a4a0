// The sweeps, one instantiation for each set of energies.
#pragma once

#include <utility>

#include "kernels.h"

namespace diffvbd {
namespace {

template <class T, int mask>
__attribute__((flatten)) void forward_color(const Plan& plan, const SceneView<T>& s, const StepParameters<T>& q,
                                            int sweep, int tape, int64_t begin, int64_t end) {
  using R = Lanes<T>;
  using Set = EnergySet<mask>;
  const int rows = tape_rows(tape, Set::kept_scalars);
  for (int64_t block = begin; block < end; ++block) {
    R values[kMaxEnergyData];
    const Block<R> b = load_block<Set>(plan, s, block, q, values);
    const NewtonStep<R> newton = newton_step<Set>(b, LaneStar<T>(plan, s, block), q);
    const Update<R> u = update_of<Set>(b, newton, q);
    store_rows(s.x, block, moved<Set>(b.state.x, u));
    if (tape == kNoTape) continue;
    const int count = plan.block_rank[block + 1] - plan.block_rank[block];
    T* at = s.tape + static_cast<int64_t>(sweep) * rows * plan.num_active + plan.block_rank[block];
    const auto put = [&](const R& value) {
      value.store(at, count);
      at += plan.num_active;
    };
    record<Set>(tape == kFullTape, b, newton, u, put);
  }
}

template <class T, int mask>
constexpr SweepKernel<T> forward_variant() {
  if constexpr (is_compiled(mask)) return forward_color<T, with_rare(mask)>;
  return nullptr;
}
template <class T, int... n>
SweepKernel<T> pick_forward(int index, std::integer_sequence<int, n...>) {
  static constexpr SweepKernel<T> table[kEnergySets] = {forward_variant<T, energy_mask(n)>()...};
  return table[index];
}

}  // namespace
}  // namespace diffvbd
