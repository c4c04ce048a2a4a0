// Sweeps: an instance for each set of energies and number of threads per vertex.
#pragma once

#include <utility>

#include "contact_sweep.cuh"
#include "schedule.cuh"

namespace diffvbd::cuda {
namespace {

// Vertices of a warp at one turn.
struct Turn {
  int64_t scene;
  int sweep, block, part;
  int begin, end;      // blocks of the color
  bool apart = false;  // whether earlier sweeps of this launch left all vertices in the rows of moved ones
  template <class T>
  __device__ __forceinline__ MovingRows<T> rows(const StepView<T>& s) const {
    return apart ? MovingRows<T>{s.w.moved, s.w.x} : MovingRows<T>{s.w.x, s.w.moved};
  }
  __device__ __forceinline__ int64_t first() const { return int64_t{begin} * kSlice; }
};

// Start and end of an update.
template <class T>
struct Path {
  Vec3<T> from, to;
};

// Updates a warp's vertices. Returns false and does nothing where a well-conditioned set meets a block that it does not
// suit. With contact the caller moves the vertices.
template <class Set, class T, int lanes>
__device__ __forceinline__ bool update(const StepView<T>& s, T* shared, const Turn& turn, PairTerm<T>& pairs,
                                       Path<T>& path) {
  const LaneLayout<lanes> at(turn.scene, turn.block, turn.part);
  const Span ranks = span_of(s.plan.block_rank, at.block);
  const StarSpans spans = spans_of(s.plan, at.block);
  const int rank = ranks.begin + at.v, end_rank = ranks.end;
  if (rank - at.group >= end_rank) return true;  // a warp of phantoms
  GroupStar<T, lanes> star(s, at, spans, shared);
  star.pairs = &pairs;
  const MovingRows<T> rows = Set::contact ? turn.rows(s) : MovingRows<T>{s.w.x, s.w.x};
  const Block<T> b = load_block<Set>(s, at, s.own, rows.x);
  if (s.has_tets) star.template fetch_neighbours<Set::contact>(s.own, rows, turn.first());
  if constexpr (Set::well_conditioned && Set::filters) {
    if (star.any(is_oblique<Set>(b, b.state.x))) return false;
  }
  const StepParameters<T> q = of_sweep(s.parameters, turn.sweep + 1 == s.sweeps);
  const NewtonStep<T> newton = newton_step<Set>(b, star, q);
  if constexpr (Set::well_conditioned) {
    if (needs_refinement<Set>(b, star, newton.H)) return false;
  }
  const Update<T> u = update_of<Set>(b, star, newton, q);
  const int64_t position = static_cast<int64_t>(at.block) * kSlice + at.v;
  path = {b.state.x, moved<Set>(b.state.x, u)};
  if (!Set::contact && at.lane == 0) store_row(s.w.x, at.scene * s.positions + position, path.to);
  if (s.tape_policy != kNoTape && at.lane == 0 && rank < end_rank) {
    T* to = s.tape + (at.scene * s.sweeps + turn.sweep) * s.tape_rows * s.plan.num_active + rank;
    const auto put = [&](const T& value) {
      *to = value;
      to += s.plan.num_active;
    };
    record<Set>(s.tape_policy == kFullTape, b, newton, u, put);
  }
  return true;
}

// Out of line, so that the few vertices that need it cost the others no registers.
template <class Set, class T, int lanes>
__device__ __noinline__ Path<T> ill_conditioned_update(const StepView<T>& s, T* shared, Turn turn, PairTerm<T> pairs) {
  Path<T> path{};
  update<Set, T, lanes>(s, shared, turn, pairs, path);
  return path;
}

template <class Set, class T, int lanes>
__device__ __forceinline__ Path<T> update_any(const StepView<T>& s, T* shared, const Turn& turn, PairTerm<T> pairs) {
  Path<T> path{};
  if (!update<WellConditioned<Set>, T, lanes>(s, shared, turn, pairs, path)) {
    path = ill_conditioned_update<Set, T, lanes>(s, shared, turn, pairs);
  }
  return path;
}

// With contact, a block for a vertex: the first warp updates it, the others evaluate its pairs.
template <class Set, class T>
__device__ __forceinline__ void update_cooperative(const StepView<T>& s, const ContactView<T>& c, T* shared,
                                                   const Turn& turn) {
  const LaneLayout<kManyLanes> at(turn.scene, turn.block, turn.part);
  const int64_t position = static_cast<int64_t>(at.block) * kSlice + at.v;
  const int vertex = __ldg(s.plan.order + position), role = static_cast<int>(threadIdx.x / kSlice) - 1;
  if (vertex < 0) return;
  Messages<T>& message = message_memory<T>();
  if (role >= 0) {
    const SweepRows<T> rows = sweep_rows(s, at.scene, turn.begin, turn.end, turn.rows(s));
    PairsOf<T, kManyLanes, SweepRows<T>> pairs(s, c.in, at, rows, role);
    const contact::TrustRegion<T> region = pairs.trust_region();  // loaded long before it is needed
    pairs.gather(message.term[role]);
    sync_cooperative();  // pair terms are ready
    sync_cooperative();  // the end of the update is ready
    if (role != kLagged) {
      const Vec3<T> from = diffvbd::vector_at(message.from);
      const int exponent = pairs.limit(region, from, diffvbd::vector_at(message.to) - from);
      if (at.lane == 0) message.exponents[role] = exponent;
    }
    sync_cooperative();  // the exponents are ready
    return;
  }
  Path<T> path = update_any<Set, T, kManyLanes>(s, shared, turn, {message.term[0], kRoles, nullptr, true});
  if (at.lane == 0) {
    message.from[0] = path.from.x, message.from[1] = path.from.y, message.from[2] = path.from.z;
    message.to[0] = path.to.x, message.to[1] = path.to.y, message.to[2] = path.to.z;
  }
  sync_cooperative();
  sync_cooperative();
  if (at.lane != 0) return;
  const int exponent = max(message.exponents[kPoints], message.exponents[kEdges]);
  if (exponent > 0) path.to = path.from + contact::limit_of<T>(exponent) * (path.to - path.from);
  store_row(turn.rows(s).moved, at.scene * s.positions + position, path.to);
  c.truncations[((s.base + at.scene) * s.sweeps + turn.sweep) * c.in.num_vertices + vertex] =
      static_cast<uint8_t>(exponent);
}

// Registers of well-conditioned blocks; the ill-conditioned ones make do with as many.
template <class T, class Set, int lanes>
constexpr int forward_registers() {
  if (sizeof(T) == sizeof(float)) return Set::contact ? 96 : 80;
  if (lanes >= kManyLanes) return 168;  // such warps are few
  return Set::contact ? 168 : Set::filters ? 144 : 128;
}

template <class T, int mask, int lanes>
__global__ void __maxnreg__((forward_registers<T, EnergySet<mask>, lanes>()))
    sweep_forward(const __grid_constant__ StepView<T> s, const __grid_constant__ Range range) {
  using Set = EnergySet<mask>;
  T* const shared = memory_of_warp<T, lanes>(s, false);
  wait_for_previous();
  each_color<T, lanes>(s, range, false, [&](int64_t scene, int sweep, int block, int part, int begin, int end) {
    update_any<Set, T, lanes>(s, shared, Turn{scene, sweep, block, part, begin, end}, {});
    __syncwarp();
  });
}
// With contact: pair terms have been assembled, and limits follow.
template <class T, int mask, int lanes>
__global__ void __maxnreg__((forward_registers<T, EnergySet<mask>, lanes>()))
    sweep_between(const __grid_constant__ StepView<T> s, const __grid_constant__ Range range,
                  const __grid_constant__ ContactView<T> c) {
  T* const shared = memory_of_warp<T, lanes>(s, false);
  wait_for_previous();
  each_color<T, lanes>(s, range, false, [&](int64_t scene, int sweep, int block, int part, int begin, int end) {
    const LaneLayout<lanes> at(scene, block, part);
    const int64_t row = scene * s.positions + static_cast<int64_t>(block) * kSlice + at.v;
    const PairTerm<T> pairs{s.w.contact + row * kContactScalars, 1};
    const Path<T> path =
        update_any<EnergySet<mask>, T, lanes>(s, shared, {scene, sweep, block, part, begin, end}, pairs);
    const bool real = __ldg(s.plan.order + static_cast<int64_t>(block) * kSlice + at.v) >= 0;
    if (at.lane == 0 && real) store_row(s.w.moved, row, path.to);
    __syncwarp();
  });
}
// A block for each vertex, in one launch for all sweeps or for each color.
template <class T, int mask>
__global__ void __maxnreg__((forward_registers<T, EnergySet<mask>, kManyLanes>()))
    sweep_cooperative(const __grid_constant__ StepView<T> s, const __grid_constant__ Range range,
                      const __grid_constant__ ContactView<T> c) {
  T* const shared = memory_of_warp<T, kManyLanes>(s, false);  // of the first warp
  wait_for_previous();
  const auto visit = [&](int64_t scene, int sweep, int block, int part, int begin, int end) {
    const bool apart = (sweep - range.first_sweep) % 2 != 0;
    update_cooperative<EnergySet<mask>>(s, c, shared, Turn{scene, sweep, block, part, begin, end, apart});
  };
  each_color_by_blocks(s, range, false, visit, nullptr);
}

template <class T, int mask, int lanes>
SweepKernel forward_variant() {
  if constexpr (!is_built(mask, lanes)) {
    return nullptr;
  } else if constexpr (EnergySet<mask>::contact && lanes == kManyLanes) {
    return reinterpret_cast<SweepKernel>(&sweep_cooperative<T, mask>);
  } else if constexpr (EnergySet<mask>::contact) {
    return reinterpret_cast<SweepKernel>(&sweep_between<T, mask, lanes>);
  } else {
    return reinterpret_cast<SweepKernel>(&sweep_forward<T, mask, lanes>);
  }
}

template <class T, int lanes, int... n>
SweepKernel pick_forward(int index, std::integer_sequence<int, n...>) {
  static SweepKernel const table[kEnergySets] = {forward_variant<T, compiled_mask(energy_mask(n)), lanes>()...};
  return table[index];
}

}  // namespace

template <class T>
SweepKernel forward_kernel(int energies, int lanes) {
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
