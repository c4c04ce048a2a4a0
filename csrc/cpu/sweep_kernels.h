// The sweeps, one instantiation for each set of energies.
#pragma once

#include <utility>

#include "coarse_kernels.h"
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
    const LaneStar<T> star(plan, s, block);
    const NewtonStep<R> newton = newton_step<Set>(b, star, q);
    const Update<R> u = update_of<Set>(b, star, newton, q);
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
  if constexpr (is_compiled(mask)) return forward_color<T, with_optional(mask)>;
  return nullptr;
}
template <class T, int... n>
SweepKernel<T> pick_forward(int index, std::integer_sequence<int, n...>) {
  static constexpr SweepKernel<T> table[kEnergySets] = {forward_variant<T, energy_mask(n)>()...};
  return table[index];
}

}  // namespace

// The transposed sweeps, one instantiation for each set of energies.

namespace {

template <class T, int mask>
__attribute__((flatten)) void reverse_color(const Plan& plan, const SceneView<T>& s, const StepParameters<T>& q,
                                            int sweep, int tape, int64_t begin, int64_t end) {
  using R = Lanes<T>;
  using Set = EnergySet<mask>;
  const int rows = tape_rows(tape, Set::kept_scalars);
  for (int64_t block = begin; block < end; ++block) {
    const int count = plan.block_rank[block + 1] - plan.block_rank[block];
    const T* at = s.tape + static_cast<int64_t>(sweep) * rows * plan.num_active + plan.block_rank[block];
    const auto get = [&] {
      const R value = R::load(at, count);
      at += plan.num_active;
      return value;
    };
    const LaneStar<T> star(plan, s, block, fresh_rows(plan, s.rows, block));
    R values[kMaxEnergyData];
    Block<R> b = load_block<Set>(plan, s, block, q, values);
    Recalled<R> r = recall<Set, R>(tape == kFullTape, get);
    const Update<R> u = replayed<Set>(b, star, r, tape == kFullTape, q);
    store_rows(s.x, block, b.state.x);

    const Vec3<R> end_bar = load_rows(s.x_bar, block) + pull_rows(plan, s.rows, block);
    Vec3<R> x_bar = end_bar;
    if constexpr (Set::contact) x_bar = R::load(s.limit + block * kLanes) * end_bar;
    BlockAdjoint<R> out = reverse_vertex<Set, kMaterial | kRest>(
        b, star, u, r, x_bar, q, s.data_bar != nullptr, [&](int k, int i, const R& value) {
          const int64_t row = b.data[k] - values + i;
          LaneStar<T>::accumulate(s.data_bar + (row * plan.blocks + block) * kLanes, value);
        });
    if constexpr (Set::contact) out.x += end_bar - x_bar;  // what a limit holds back stays where it was
    store_rows(s.x_bar, block, out.x);
    add3(s.y_bar, block, out.y);
    LaneStar<T>::accumulate(s.mass_bar + block * kLanes, out.mass);
    if constexpr (Set::reads_x_prev) add3(s.x_prev_bar, block, out.x_prev);
    if constexpr (Set::contact) {
      const R values[] = {out.p.x, out.p.y, out.p.z, u.d_raw.x, u.d_raw.y, u.d_raw.z};
      for (int i = 0; i < 6; ++i) values[i].store(s.turn + (block * 6 + i) * kLanes);
    }
  }
}

template <class T, int mask>
constexpr SweepKernel<T> reverse_variant() {
  if constexpr (is_compiled(mask)) return reverse_color<T, with_optional(mask)>;
  return nullptr;
}
template <class T, int... n>
SweepKernel<T> pick_reverse(int index, std::integer_sequence<int, n...>) {
  static constexpr SweepKernel<T> table[kEnergySets] = {reverse_variant<T, energy_mask(n)>()...};
  return table[index];
}

}  // namespace

}  // namespace diffvbd

namespace diffvbd::DIFFVBD_SET {

// The loops of the instruction set DIFFVBD_SET: the body of the files sweep_<scalar>_<set>.cpp.

template <class T>
SweepKernel<T> forward(int energies) {
  return pick_forward<T>(energy_index(energies), std::make_integer_sequence<int, kEnergySets>{});
}
template <class T>
SweepKernel<T> reverse(int energies) {
  return pick_reverse<T>(energy_index(energies), std::make_integer_sequence<int, kEnergySets>{});
}

template <class T>
CoarseKernels<T> coarse(int energies) {
  return pick_coarse<T>(free_index(energies), std::make_integer_sequence<int, kFreeSets>{});
}

// Boxes are single precision: of the scalars one has the kernel, and it costs the other no room for inlining.
template <class T>
OverlapKernel meet() {
  if constexpr (std::is_same_v<T, float>) return overlap_boxes;
  return nullptr;
}

template <class T>
Kernels<T> sweep_kernels() {
  return {forward<T>, reverse<T>, coarse<T>, {add_lanes<T>, reverse_lanes<T>}, meet<T>()};
}

}  // namespace diffvbd::DIFFVBD_SET
