// Gradient of the potential at every vertex at once, and its transpose: an instance for each set of energies without
// contact and number of threads per vertex.
#pragma once

#include <utility>

#include "coarse.h"
#include "group.cuh"

namespace diffvbd::cuda {
namespace {

// Star with the displacements of the neighbours.
template <class T, int lanes>
struct DisplacementStar : GroupStar<T, lanes> {
  using Base = GroupStar<T, lanes>;
  using typename Base::P;
  const T* displacements;
  __device__ __forceinline__ DisplacementStar(const StepView<T>& s, const P& at, const StarSpans& spans, T* shared)
      : Base(s, at, spans, shared) {}

  __device__ __forceinline__ void fetch_displacements(const T* of, T* shared) {
    T* to = shared + this->s.degree * 3 * P::groups + this->at.group;
    displacements = to;
    of += this->at.scene * this->s.positions * kRow;
    for (int a = this->at.lane; a < this->degree; a += Base::lanes) {
      const int64_t edge = static_cast<int64_t>(this->first_edge + a) * kSlice + this->at.v;
      const Vec3<T> displacement = load_row(of, __ldg(this->s.plan.adjacent + edge), true);
      to[(3 * a) * P::groups] = displacement.x;
      to[(3 * a + 1) * P::groups] = displacement.y;
      to[(3 * a + 2) * P::groups] = displacement.z;
    }
    __syncwarp();
  }
  __device__ __forceinline__ PairDisplacement<T> displacement(int) const {
    const auto of = [&](int a) {
      const T* from = displacements + a * 3 * P::groups;
      return Vec3<T>{from[0], from[P::groups], from[2 * P::groups]};
    };
    const int where = this->where;
    return {of(where & kMaxDegree), of(where >> kLocalBits & kMaxDegree), of(where >> 2 * kLocalBits)};
  }
  __device__ __forceinline__ const DisplacementStar& local() const { return *this; }
  template <class Law, int wanted>
  __device__ __forceinline__ Vec3<T> multiply_tets(const Vec3<T>& x, const Vec3<T>& w, const T& minus_h2) const {
    Vec3<T> out = diffvbd::multiply_tets<Law, wanted>(*this, x, w, minus_h2);
    this->total(out);
    return out;
  }
};

// Adjoints of pinned vertices: the plan lists no tets of theirs, so contributions go through rows, which add up
// (GroupStar::scatter_rows). One thread of a vertex does it, out of line, so that the others need no registers for it.
template <class Law, class T>
__device__ __noinline__ void scatter_to_pinned(const StepView<T>& s, int64_t scene, int block, int v, const Vec3<T> x,
                                               const Vec3<T> w, T minus_h2) {
  const LaneLayout<1> place(scene, block, 0);
  LaneLayout<1> at = place;
  at.v = v;
  const int pinned = __ldg(s.plan.color_block + s.plan.colors) * kSlice, first_edge = __ldg(s.plan.block_edge + block);
  const auto neighbour = [&](int a) { return __ldg(s.plan.adjacent + (int64_t{first_edge} + a) * kSlice + v); };
  const T* rows_of_x = s.w.x + scene * s.positions * kRow;
  T* rows = s.w.rows + scene * (static_cast<int64_t>(s.plan.edge_slots) * kSlice + 1) * kRow;
  const auto scatter = [&](int a, const Vec3<T>& bar) {
    if (neighbour(a) < pinned) return;
    const int64_t edge = (int64_t{first_edge} + a) * kSlice + v;
    store_row(rows, edge, load_row(rows, edge, true) + bar);
  };
  const Vec3<T> p = -w, none = zero3<T>();
  for (int slot = __ldg(s.plan.block_slot + block); slot < __ldg(s.plan.block_slot + block + 1); ++slot) {
    const int64_t pair = int64_t{slot} * kSlice + v;
    const int where = __ldg(s.plan.local + pair);
    const int j = where & kMaxDegree, k = where >> kLocalBits & kMaxDegree, l = where >> 2 * kLocalBits;
    if (max(max(neighbour(j), neighbour(k)), neighbour(l)) < pinned) continue;
    TetPair<T> tet;
    tet.xj = load_row(rows_of_x, neighbour(j), true);
    tet.xk = load_row(rows_of_x, neighbour(k), true);
    tet.xl = load_row(rows_of_x, neighbour(l), true);
    constexpr int width = Pack<T>::size;
    const T* rest = s.rest.data + scene * s.rest.scene + int64_t{slot} * kSlice * kRestRow;
    for (int i = 0; i < kPairRest; ++i) {
      tet.rest[i] = __ldg(rest + i / width * width * kSlice + v * width + i % width);
    }
    for (int m = 0; m < kMaterialScalars; ++m) {
      tet.material[m] = s.one_material ? __ldg(s.material[m].data + scene * s.material[m].scene)
                                       : __ldg(s.w.material + scene * s.material_scene + pair * kMaterialScalars + m);
    }
    const TetAdjoint<T> bar = Law::block_vjp(tet, Law::view(tet, x, none, p), none, p, minus_h2);
    scatter(j, bar.xj);
    scatter(k, bar.xk);
    scatter(l, bar.xl);
  }
}

// Memory of a warp: positions of the neighbours, and their displacements in the reverse.
template <class T, int lanes>
__device__ __forceinline__ T* memory_of_gradients(const StepView<T>& s, bool reverse) {
  extern __shared__ __align__(16) unsigned char memory[];
  const int warp = threadIdx.x / kSlice, size = gradient_scalars(s.degree, lanes, reverse);
  if constexpr (lanes == kSpillLanes) {
    return s.spill + (blockIdx.x * (blockDim.x / kSlice) + warp) * static_cast<int64_t>(size);
  }
  return reinterpret_cast<T*>(memory) + warp * size;
}

// Calls visit(layout) for the warp's part of all moving vertices.
template <int lanes_, class T, class Visit>
__device__ __forceinline__ void each_vertex(const StepView<T>& s, const Visit& visit) {
  constexpr int lanes = threads_of(lanes_);
  const int64_t parts = int64_t{__ldg(s.plan.color_block + s.plan.colors)} * lanes;
  const int64_t warps = blockDim.x / kSlice, stride = int64_t{gridDim.x} * warps;
  for (int64_t i = blockIdx.x * warps + threadIdx.x / kSlice; i < s.scenes * parts; i += stride) {
    const int64_t scene = i / parts, part = i - scene * parts;
    visit(LaneLayout<lanes_>(scene, static_cast<int>(part / lanes), static_cast<int>(part % lanes)));
    __syncwarp();
  }
}

template <class T, int mask, int lanes>
__global__ void __maxnreg__(sizeof(T) == sizeof(float) ? 80 : 128)
    gradient_of_vertices(const __grid_constant__ StepView<T> s, const __grid_constant__ CoarseWork<T> w) {
  using Set = EnergySet<mask>;
  T* const shared = memory_of_gradients<T, lanes>(s, false);
  each_vertex<lanes>(s, [&](const LaneLayout<lanes>& at) {
    GroupStar<T, lanes> star(s, at, spans_of(s.plan, at.block), shared);
    const Block<T> b = load_block<Set>(s, at, true, s.w.x);
    if (s.has_tets) star.fetch_neighbours(true);
    const System<Set, T> system = assemble<Set>(b, star, s.parameters);
    const int64_t row = at.scene * s.positions + int64_t{at.block} * kSlice + at.v;
    if (at.lane == 0) store_row(w.gradient, row, system.axes.from(system.g));
  });
}

template <class T, int mask, int wanted, int lanes>
__global__ void __maxnreg__(sizeof(T) == sizeof(float) ? 128 : 168)
    reverse_gradients(const __grid_constant__ StepView<T> s, const __grid_constant__ CoarseWork<T> w) {
  using Set = EnergySet<mask>;
  T* const shared = memory_of_gradients<T, lanes>(s, true);
  const int pinned = __ldg(s.plan.color_block + s.plan.colors) * kSlice;
  each_vertex<lanes>(s, [&](const LaneLayout<lanes>& at) {
    const int64_t position = int64_t{at.block} * kSlice + at.v, row = at.scene * s.positions + position;
    const bool writes = at.lane == 0 && __ldg(s.plan.order + position) >= 0;
    DisplacementStar<T, lanes> star(s, at, spans_of(s.plan, at.block), shared);
    if (s.has_tets) star.fetch_neighbours(true), star.fetch_displacements(w.displacement, shared);
    const Block<T> b = load_block<Set>(s, at, true, s.w.x);
    const Vec3<T> displacement = load_row(w.displacement, row, true),
                  move = w.wanted ? load_row(w.wanted, row, true) : zero3<T>();
    const BlockAdjoint<T> out = reverse_gradient<Set, wanted>(
        b, star, displacement, move, s.parameters, s.w.data_bar != nullptr, [&](int k, int d, const T& value) {
          if (writes) s.w.data_bar[(at.scene * s.data_scalars + s.data_row[k] + d) * s.positions + position] += value;
        });
    bool touches = false;
    for (int a = at.lane; s.has_tets && a < star.degree; a += GroupStar<T, lanes>::lanes) {
      const int64_t edge = (int64_t{star.first_edge} + a) * kSlice + at.v;
      touches = touches || __ldg(s.plan.adjacent + edge) >= pinned;
    }
    if (star.any(touches) && writes) {
      const T h = s.parameters.time_step;
      scatter_to_pinned<typename Set::Elastic>(s, at.scene, at.block, at.v, b.state.x, displacement, -(h * h));
    }
    if constexpr ((wanted & kMaterial) != 0) {
      if (s.one_material) star.total(star.material_bar);
      for (int m = 0; s.one_material && m < kMaterialScalars; ++m) {
        if (writes) s.w.material_bar[row * kMaterialScalars + m] += star.material_bar[m];
      }
    }
    if (!writes) return;
    const auto add3 = [&](T* bars, const Vec3<T>& add) {
      T* to = bars + at.scene * s.positions * 3;
      store3(to, at.block, at.v, load_own3(to, at.block, at.v) + add);
    };
    store_row(s.w.x_bar, row, load_row(s.w.x_bar, row, true) + out.x);
    add3(s.w.y_bar, out.y);
    if (s.w.mass_bar) s.w.mass_bar[row] += out.mass;
    if constexpr (Set::reads_x_prev) add3(s.w.x_prev_bar, out.x_prev);
  });
}

template <class T, int wanted, int lanes, int mask>
constexpr GradientKernel<T> gradient_variant() {
  if constexpr ((mask & kPaperBlock) != 0 || (kOwnLaw && !gathers(lanes))) {
    return nullptr;
  } else if constexpr (wanted < 0) {
    return gradient_of_vertices<T, mask, lanes>;
  } else {
    return reverse_gradients<T, mask, wanted, lanes>;
  }
}
template <class T, int wanted, int lanes, int... n>
GradientKernel<T> pick_gradient(int index, std::integer_sequence<int, n...>) {
  static constexpr GradientKernel<T> table[kFreeSets] = {
      gradient_variant<T, wanted, lanes, compiled_mask(free_mask(n))>()...};
  return table[index];
}

}  // namespace

template <class T, int wanted>
GradientKernel<T> gradient_kernel_of(int energies, int lanes) {
  constexpr auto sets = std::make_integer_sequence<int, kFreeSets>{};
  const int index = free_index(energies);
  if (lanes == kFewLanes) return pick_gradient<T, wanted, kFewLanes>(index, sets);
  if (lanes == kSpillLanes) return pick_gradient<T, wanted, kSpillLanes>(index, sets);
  return pick_gradient<T, wanted, kManyLanes>(index, sets);
}

}  // namespace diffvbd::cuda
