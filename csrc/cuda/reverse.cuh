// Transposed sweeps: an instance for each set of energies, wanted adjoints and number of threads per vertex.
#pragma once

#include <utility>

#include "contact_sweep.cuh"
#include "schedule.cuh"

namespace diffvbd::cuda {
namespace {

// Two warps of each scheduler fit, about as many as shared memory allows, and well-conditioned blocks do not spill:
// spills cost more than a third warp gains. In float32 without floors or contact four fit.
template <class T, class Set>
constexpr int reverse_registers() {
  return sizeof(T) == sizeof(float) && !Set::keeps_positions ? 128 : 240;
}
constexpr int kCooperativeRegisters = 255;  // a block for each vertex: such warps are few

// Vertices of a warp at one turn, counted from the last sweep.
struct Turn {
  int64_t scene;
  int number, block, part;
};

// Reverses the updates of a warp's vertices. Returns false and does nothing where a well-conditioned set meets a block
// that it does not suit.
template <class Set, int wanted, class T, int lanes>
__device__ __forceinline__ bool reverse_update(const StepView<T>& s, T* shared, const Turn& turn, PairTerm<T>& pairs) {
  const LaneLayout<lanes> at(turn.scene, turn.block, turn.part);
  const int64_t scene = at.scene, position = static_cast<int64_t>(at.block) * kSlice + at.v,
                row = scene * s.positions + position;
  // Tape and accumulators are requested first: they have the longest latency.
  const Span ranks = span_of(s.plan.block_rank, at.block), incoming = span_of(s.plan.block_incoming, at.block);
  const StarSpans spans = spans_of(s.plan, at.block);
  const int rank = ranks.begin + at.v, end_rank = ranks.end;
  if (rank - at.group >= end_rank) return true;  // a warp of phantoms
  const bool real = rank < end_rank, full = s.tape_policy == kFullTape;
  const T* from =
      s.tape + (scene * s.sweeps + (s.sweeps - 1 - turn.number)) * s.tape_rows * s.plan.num_active + (real ? rank : 0);
  const auto get = [&] {
    const T value = __ldg(from);
    from += s.plan.num_active;
    return value;
  };
  Recalled<T> r = recall<Set, T>(full, get);
  const Vec3<T> y_bar = load_own3(s.w.y_bar + scene * s.positions * 3, at.block, at.v);
  const bool writes = at.lane == 0 && real;
  T material_bar[kMaterialScalars];  // of all updates so far
  if constexpr ((wanted & kMaterial) != 0) {
    if (s.one_material && writes) {
#pragma unroll
      for (int i = 0; i < kMaterialScalars; ++i) material_bar[i] = s.w.material_bar[row * kMaterialScalars + i];
    }
  }
  GroupStar<T, lanes, true> star(s, at, spans, shared);
  star.pairs = &pairs;
  star.repeats = !full;
  Block<T> b = load_block<Set>(s, at, false, s.w.x);
  int exponent = 0;  // of the update's limit
  if constexpr (Set::contact) {
    const int64_t step = (s.base + scene) * s.sweeps + s.sweeps - 1 - turn.number;
    if (real) exponent = __ldg(s.limits + step * s.plan.num_vertices + __ldg(s.plan.order + position));
  }
  Vec3<T> end_bar = load_row(s.w.x_bar, row) + pull_rows<true>(s, at, incoming);
  if (s.has_tets) star.fetch_neighbours(false);
  if constexpr (Set::well_conditioned) {
    if constexpr (Set::filters) {
      if (star.any(is_oblique<Set>(b, r.x_old, s.w.data_bar != nullptr))) return false;
    }
    if (full) {
      Block<T> before = b;
      if constexpr (Set::keeps_positions) before.state.x = r.x_old;
      if (needs_refinement<Set>(before, star, r.H)) return false;
    }
  }
  if (s.has_tets) star.clear_sums(shared);
  if constexpr (Set::contact) end_bar += pairs.scattered();
  Vec3<T> x_bar = end_bar;
  if constexpr (Set::contact) x_bar = contact::limit_of<T>(exponent) * end_bar;
  const StepParameters<T> q = of_sweep(s.parameters, turn.number == 0);
  const Update<T> u = replayed<Set>(b, star, r, full, q);
  if constexpr (Set::well_conditioned) {
    if (!full && needs_refinement<Set>(b, star, r.H)) return false;
  }
  star.repeats = false;
  BlockAdjoint<T> out =
      reverse_vertex<Set, wanted>(b, star, u, r, x_bar, q, s.w.data_bar != nullptr, [&](int k, int i, const T& value) {
        if (writes) s.w.data_bar[(scene * s.data_scalars + s.data_row[k] + i) * s.positions + position] += value;
      });
  if (s.has_tets) {
    if constexpr ((wanted & kMaterial) != 0) {
      if (s.one_material) {
        star.total(star.material_bar);
#pragma unroll
        for (int i = 0; i < kMaterialScalars; ++i) {
          if (writes) s.w.material_bar[row * kMaterialScalars + i] = material_bar[i] + star.material_bar[i];
        }
      }
    }
    star.scatter_rows();
  }
  if constexpr (Set::contact) out.x += end_bar - x_bar;  // the truncated part stays at the start
  if (writes) {
    store_row(s.w.x, row, b.state.x);
    store_row(s.w.x_bar, row, out.x);
    store3(s.w.y_bar + scene * s.positions * 3, at.block, at.v, y_bar + out.y);
    if (s.w.mass_bar) s.w.mass_bar[row] += out.mass;
    if constexpr (Set::reads_x_prev) {
      T* to = s.w.x_prev_bar + scene * s.positions * 3;
      store3(to, at.block, at.v, load_own3(to, at.block, at.v) + out.x_prev);
    }
    if constexpr (Set::contact) {
      T* turned = s.w.reversed + 6 * row;
      turned[0] = out.p.x, turned[1] = out.p.y, turned[2] = out.p.z;
      turned[3] = u.d_raw.x, turned[4] = u.d_raw.y, turned[5] = u.d_raw.z;
    }
  }
  return true;
}

// Out of line, so that the few vertices that need it cost the others no registers.
template <class Set, int wanted, class T, int lanes>
__device__ __noinline__ void reverse_ill_conditioned(const StepView<T>& s, T* shared, Turn turn, PairTerm<T> pairs) {
  reverse_update<Set, wanted, T, lanes>(s, shared, turn, pairs);
}

template <class Set, int wanted, class T, int lanes>
__device__ __forceinline__ void reverse_any(const StepView<T>& s, T* shared, const Turn& turn, PairTerm<T> pairs) {
  if (!reverse_update<WellConditioned<Set>, wanted, T, lanes>(s, shared, turn, pairs)) {
    reverse_ill_conditioned<Set, wanted, T, lanes>(s, shared, turn, pairs);
  }
}

// With contact, a block for a vertex: the first warp reverses its update, the others gather what pairs scattered to it
// and, where no tape has the block, its pair terms.
template <class Set, int wanted, class T>
__device__ __forceinline__ void reverse_update_cooperative(const StepView<T>& s, const ContactView<T>& c, T* shared,
                                                           const Turn& turn, int begin, int end) {
  const LaneLayout<kManyLanes> at(turn.scene, turn.block, turn.part);
  const int vertex = __ldg(s.plan.order + static_cast<int64_t>(at.block) * kSlice + at.v);
  const int role = static_cast<int>(threadIdx.x / kSlice) - 1;
  if (vertex < 0) return;
  Messages<T>& message = message_memory<T>();
  const bool full = s.tape_policy == kFullTape;
  if (role >= 0) {
    const TapeRows<T> rows = tape_rows_of(s, at.scene, s.sweeps - 1 - turn.number, begin, end);
    PairsOf<T, kManyLanes, TapeRows<T>> pairs(s, c.in, at, rows, role);
    if (role == kLagged) take_scattered(c, pairs, message.bar);
    if (!full) pairs.gather(message.term[role]);
    sync_cooperative();  // both are ready
  } else {
    reverse_any<Set, wanted, T, kManyLanes>(s, shared, turn, {message.term[0], full ? 0 : kRoles, message.bar, true});
  }
  sync_cooperative();  // and have been read
}

// Out of line: the same for all sets.
template <class T>
__device__ __noinline__ void scatter_cooperative(const StepView<T>& s, const ContactView<T>& c, int64_t scene,
                                                 int block, int part, int begin, int end) {
  const int role = static_cast<int>(threadIdx.x / kSlice) - 1;
  if (role >= 0) scatter_pairs(s, c, LaneLayout<kManyLanes>(scene, block, part), role, begin, end);
}

template <class T, int mask, int wanted, int lanes>
__global__ void __maxnreg__((reverse_registers<T, EnergySet<mask>>()))
    sweep_reverse(const __grid_constant__ StepView<T> s, const __grid_constant__ Range range) {
  using Set = EnergySet<mask>;
  T* const shared = memory_of_warp<T, lanes>(s, true);
  wait_for_previous();
  each_color<T, lanes>(s, range, true, [&](int64_t scene, int number, int block, int part, int, int) {
    const LaneLayout<lanes> at(scene, block, part);
    const int64_t row = scene * s.positions + static_cast<int64_t>(block) * kSlice + at.v;
    PairTerm<T> pairs;
    if (Set::contact) pairs.at = s.w.contact + row * kContactScalars, pairs.count = s.tape_policy != kFullTape;
    reverse_any<Set, wanted, T, lanes>(s, shared, Turn{scene, number, block, part}, pairs);
    __syncwarp();
  });
}
// With contact, a block for each vertex, in one launch for all sweeps; or for each color, without the scatter to its
// pairs.
template <class T, int mask, int wanted>
__global__ void __maxnreg__(kCooperativeRegisters)
    reverse_cooperative(const __grid_constant__ StepView<T> s, const __grid_constant__ Range range,
                        const __grid_constant__ ContactView<T> c) {
  T* const shared = memory_of_warp<T, kManyLanes>(s, true);  // of the first warp
  wait_for_previous();
  const auto visit = [&](int64_t scene, int number, int block, int part, int begin, int end) {
    reverse_update_cooperative<EnergySet<mask>, wanted>(s, c, shared, Turn{scene, number, block, part}, begin, end);
  };
  const auto scatter = [&](int64_t scene, int, int block, int part, int begin, int end) {
    scatter_cooperative(s, c, scene, block, part, begin, end);
  };
  // Without pairs and friction on planes there is nothing to scatter.
  const auto any_of = [&](const contact::PairList& list) {
    const int64_t first = s.base * c.in.corners, end = (s.base + s.scenes) * c.in.corners;
    return __ldg(list.ptr + first) < __ldg(list.ptr + end);
  };
  const bool scatters =
      range.regime == kGrid && (c.in.planes > 0 || any_of(c.in.listed) || (c.in.lag && any_of(c.in.lagged)));
  each_color_by_blocks(s, range, true, visit, scatter, scatters);
}

template <class T, int mask, int wanted, int lanes>
SweepKernel reverse_variant() {
  if constexpr (!is_built(mask, lanes)) {
    return nullptr;
  } else if constexpr (EnergySet<mask>::contact && lanes == kManyLanes) {
    return reinterpret_cast<SweepKernel>(&reverse_cooperative<T, mask, wanted>);
  } else {
    return reinterpret_cast<SweepKernel>(&sweep_reverse<T, mask, wanted, lanes>);
  }
}

template <class T, int wanted, int lanes, int... n>
SweepKernel pick_reverse(int index, std::integer_sequence<int, n...>) {
  static SweepKernel const table[kEnergySets] = {reverse_variant<T, compiled_mask(energy_mask(n)), wanted, lanes>()...};
  return table[index];
}

}  // namespace

template <class T, int wanted, int lanes>
SweepKernel reverse_kernel(int energies) {
  return pick_reverse<T, wanted, lanes>(energy_index(energies), std::make_integer_sequence<int, kEnergySets>{});
}

}  // namespace diffvbd::cuda
