// The gradient of the potential at every vertex at once, a thread each, and its transpose. One instantiation for each
// set of energies without contact.
#pragma once

#include <utility>

#include "coarse.h"
#include "group.cuh"

namespace diffvbd::cuda {
namespace {

// The star of a thread's vertex, which reads its neighbours where they stand.
template <class T>
struct ThreadStar {
  const StepView<T>& s;
  const T* ways;
  int64_t scene;
  int block, v, first, count, first_edge, degree, pinned;
  T shared_material[kTetScalars];
  mutable int where;  // of the pair at work
  mutable T material_bar[kTetScalars] = {};

  // ways: of all positions, in the reverse
  __device__ __forceinline__ ThreadStar(const StepView<T>& s, const T* ways, int64_t scene, int block, int v)
      : s(s), ways(ways + scene * s.positions * kRow), scene(scene), block(block), v(v) {
    first = __ldg(s.plan.block_slot + block);
    count = s.has_tets ? __ldg(s.plan.block_slot + block + 1) - first : 0;
    first_edge = __ldg(s.plan.block_edge + block);
    degree = __ldg(s.plan.block_edge + block + 1) - first_edge;
    pinned = __ldg(s.plan.color_block + s.plan.colors) * kSlice;
    if (!s.one_material) return;
#pragma unroll
    for (int m = 0; m < kTetScalars; ++m) shared_material[m] = __ldg(s.material[m].data + scene * s.material[m].scene);
  }

  __device__ __forceinline__ int size() const { return count; }
  __device__ __forceinline__ const ThreadStar& local() const { return *this; }
  __device__ __forceinline__ bool any(bool condition) const { return __any_sync(kWholeWarp, condition); }
  __device__ __forceinline__ void rewind() const {}
  template <class... R>
  __device__ __forceinline__ void total(R&...) const {}

  __device__ __forceinline__ int neighbour(int a) const {
    return __ldg(s.plan.adjacent + static_cast<int64_t>(first_edge + a) * kSlice + v);
  }
  __device__ __forceinline__ Vec3<T> position(int a) const {
    return load_row(s.w.x + scene * s.positions * kRow, neighbour(a), true);
  }
  __device__ __forceinline__ TetPair<T> pair(int e) const {
    const int64_t base = static_cast<int64_t>(first + e) * kSlice;
    where = __ldg(s.plan.local + base + v);
    TetPair<T> out;
    const T* rest = s.rest.data + scene * s.rest.scene + base * kRestRow;
    constexpr int width = Pack<T>::size;
#pragma unroll
    for (int i = 0; i < kRestRow; i += width) {
      const Pack<T> part = load_constant(rest + i * kSlice + v * width);
#pragma unroll
      for (int k = 0; k < width && i + k < kPairRest; ++k) out.rest[i + k] = part.v[k];
    }
    const T* material = s.w.material + scene * s.material_scene + (base + v) * kTetScalars;
#pragma unroll
    for (int m = 0; m < kTetScalars; ++m) out.material[m] = s.one_material ? shared_material[m] : __ldg(material + m);
    out.xj = position(where & kMaxDegree);
    out.xk = position(where >> kLocalBits & kMaxDegree);
    out.xl = position(where >> 2 * kLocalBits);
    return out;
  }
  __device__ __forceinline__ PairWay<T> way(int) const {
    const auto of = [&](int a) { return load_row(ways, neighbour(a), true); };
    return {of(where & kMaxDegree), of(where >> kLocalBits & kMaxDegree), of(where >> 2 * kLocalBits)};
  }

  template <int wanted>
  __device__ static constexpr bool wants(int what) {
    return (wanted & what) != 0;
  }
  __device__ __forceinline__ int64_t pair_index(int e) const { return (scene * s.plan.slots + first + e) * kSlice + v; }
  __device__ __forceinline__ void add_material(int e, const T* bar) const {
    if (s.one_material) {
#pragma unroll
      for (int i = 0; i < kTetScalars; ++i) material_bar[i] += bar[i];
    } else {
      T* to = s.w.material_bar + pair_index(e) * kTetScalars;
#pragma unroll
      for (int i = 0; i < kTetScalars; ++i) to[i] += bar[i];
    }
  }
  __device__ __forceinline__ void add_rest(int e, const T* bar) const {
    T* to = s.w.rest_bar + pair_index(e) * kPairRest;
#pragma unroll
    for (int i = 0; i < kPairRest; ++i) to[i] += bar[i];
  }
  template <class Law, int wanted>
  __device__ __forceinline__ Vec3<T> multiply_tets(const Vec3<T>& x, const Vec3<T>& w, const T& minus_h2) const {
    bool touches = false;
    for (int a = 0; a < degree; ++a) touches = touches || neighbour(a) >= pinned;
    if (touches) send_to_pinned<Law>(s, scene, block, v, x, w, minus_h2);
    return diffvbd::multiply_tets<Law, wanted>(*this, x, w, minus_h2);
  }
  // The plan lists no tets of pinned vertices: what reaches them goes by rows, which add up (GroupStar::send_rows). Out
  // of line with a star of its own, so that this one stays in registers.
  template <class Law>
  __device__ __noinline__ static void send_to_pinned(const StepView<T>& s, int64_t scene, int block, int v,
                                                     const Vec3<T> x, const Vec3<T> w, T minus_h2) {
    const ThreadStar star(s, s.w.x, scene, block, v);
    T* rows = s.w.rows + scene * (static_cast<int64_t>(s.plan.edge_slots) * kSlice + 1) * kRow;
    const auto send = [&](int a, const Vec3<T>& bar) {
      if (star.neighbour(a) < star.pinned) return;
      const int64_t edge = static_cast<int64_t>(star.first_edge + a) * kSlice + v;
      store_row(rows, edge, load_row(rows, edge, true) + bar);
    };
    const Vec3<T> p = -w, none = zero3<T>();
    for (int e = 0; e < star.count; ++e) {
      const TetPair<T> tet = star.pair(e);
      const TetAdjoint<T> bar = Law::block_vjp(tet, Law::view(tet, x, none, p), none, p, minus_h2);
      send(star.where & kMaxDegree, bar.xj);
      send(star.where >> kLocalBits & kMaxDegree, bar.xk);
      send(star.where >> 2 * kLocalBits, bar.xl);
    }
  }
};

template <class T, int mask>
__global__ void __launch_bounds__(kGradientThreads, 4)
    gradient_of_vertices(const __grid_constant__ StepView<T> s, const __grid_constant__ CoarseWork<T> w) {
  using Set = EnergySet<mask>;
  const int64_t active = static_cast<int64_t>(__ldg(s.plan.color_block + s.plan.colors)) * kSlice;
  const int64_t i = static_cast<int64_t>(blockIdx.x) * kGradientThreads + threadIdx.x;
  if (i >= s.scenes * active) return;  // whole warps
  const int64_t scene = i / active, position = i - scene * active;
  Place<1> at(scene, static_cast<int>(position / kSlice), 0);
  at.v = static_cast<int>(position % kSlice);
  const ThreadStar<T> star(s, w.way, scene, at.block, at.v);
  const Block<T> b = load_block<Set>(s, at, true);
  const System<Set, T> system = assemble<Set>(b, star, s.parameters);
  store_row(w.gradient, scene * s.positions + position, system.axes.from(system.g));
}

template <class T, int mask, int wanted>
__global__ void __launch_bounds__(kGradientThreads, 4)
    reverse_gradients(const __grid_constant__ StepView<T> s, const __grid_constant__ CoarseWork<T> w) {
  using Set = EnergySet<mask>;
  const int64_t active = static_cast<int64_t>(__ldg(s.plan.color_block + s.plan.colors)) * kSlice;
  const int64_t i = static_cast<int64_t>(blockIdx.x) * kGradientThreads + threadIdx.x;
  if (i >= s.scenes * active) return;
  const int64_t scene = i / active, position = i - scene * active, row = scene * s.positions + position;
  if (__ldg(s.plan.order + position) < 0) return;
  Place<1> at(scene, static_cast<int>(position / kSlice), 0);
  at.v = static_cast<int>(position % kSlice);
  const ThreadStar<T> star(s, w.way, scene, at.block, at.v);
  const Block<T> b = load_block<Set>(s, at, true);
  const BlockAdjoint<T> out = reverse_gradient<Set, wanted>(
      b, star, load_row(w.way, row, true), s.parameters, s.w.data_bar != nullptr, [&](int k, int d, const T& value) {
        s.w.data_bar[(scene * s.data_scalars + s.data_row[k] + d) * s.positions + position] += value;
      });
  store_row(s.w.x_bar, row, load_row(s.w.x_bar, row, true) + out.x);
  const auto add3 = [&](T* bars, const Vec3<T>& add) {
    T* to = bars + scene * s.positions * 3;
    store3(to, at.block, at.v, load_own3(to, at.block, at.v) + add);
  };
  add3(s.w.y_bar, out.y);
  if (s.w.mass_bar) s.w.mass_bar[row] += out.mass;
  if constexpr (Set::reads_x_prev) add3(s.w.x_prev_bar, out.x_prev);
  if constexpr ((wanted & kMaterial) != 0) {
    for (int m = 0; s.one_material && m < kTetScalars; ++m) {
      s.w.material_bar[row * kTetScalars + m] += star.material_bar[m];
    }
  }
}

template <class T, int mask>
constexpr GradientKernel<T> gradient_variant() {
  if constexpr ((mask & kPaperBlock) == 0) return gradient_of_vertices<T, mask>;
  return nullptr;
}
template <class T, int... n>
GradientKernel<T> pick_gradient(int index, std::integer_sequence<int, n...>) {
  static constexpr GradientKernel<T> table[kFreeSets] = {gradient_variant<T, free_mask(n)>()...};
  return table[index];
}

template <class T, int wanted, int mask>
constexpr GradientKernel<T> reverse_gradient_variant() {
  if constexpr ((mask & kPaperBlock) == 0) return reverse_gradients<T, mask, wanted>;
  return nullptr;
}
template <class T, int wanted, int... n>
GradientKernel<T> pick_reverse_gradient(int index, std::integer_sequence<int, n...>) {
  static constexpr GradientKernel<T> table[kFreeSets] = {reverse_gradient_variant<T, wanted, free_mask(n)>()...};
  return table[index];
}

}  // namespace

template <class T>
GradientKernel<T> gradient_reverse_kernel(int energies, int wanted) {
  constexpr auto sets = std::make_integer_sequence<int, kFreeSets>{};
  const int index = free_index(energies);
  if (wanted & kRest) return pick_reverse_gradient<T, kMaterial | kRest>(index, sets);
  if (wanted & kMaterial) return pick_reverse_gradient<T, kMaterial>(index, sets);
  return pick_reverse_gradient<T, kState>(index, sets);
}
template <class T>
GradientKernel<T> gradient_kernel(int energies) {
  return pick_gradient<T>(free_index(energies), std::make_integer_sequence<int, kFreeSets>{});
}

}  // namespace diffvbd::cuda

#define DIFFVBD_INSTANTIATE_GRADIENT(T)                                             \
  template diffvbd::cuda::GradientKernel<T> diffvbd::cuda::gradient_kernel<T>(int); \
  template diffvbd::cuda::GradientKernel<T> diffvbd::cuda::gradient_reverse_kernel<T>(int, int);
