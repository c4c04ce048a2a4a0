// Copies between the user's arrays and sweep order, once a step, a thread for each vertex or tet.
#pragma once

#include "common.cuh"
#include "group.cuh"

namespace diffvbd::cuda {
namespace {

constexpr int kFrameThreads = 256;

template <class T>
__device__ __forceinline__ Vec3<T> load_user(const Batched<const T>& t, int64_t scene, int64_t vertex) {
  const T* a = t.data + scene * t.scene + 3 * t.item * vertex;
  return {a[0], a[1], a[2]};
}
template <class T>
__device__ __forceinline__ void store_user(T* p, int64_t index, const Vec3<T>& a) {
  p += 3 * index;
  p[0] = a.x;
  p[1] = a.y;
  p[2] = a.z;
}
// y = x + h v + h^2 a; a pinned vertex goes where it is prescribed.
template <class T>
__device__ __forceinline__ Vec3<T> predict(const StepInputs<T>& in, int64_t scene, int64_t vertex, bool pinned) {
  const Vec3<T> x = load_user(in.x_prev, scene, vertex);
  if (pinned) return in.prescribed.data ? load_user(in.prescribed, scene, vertex) : x;
  const T h = in.parameters.time_step;
  const Vec3<T> v = load_user(in.v, scene, vertex), a = load_user(in.acceleration, scene, vertex);
  return x + h * v + (h * h) * a;
}

// Fills a chunk's arrays in sweep order. Forward: x is the start of the sweeps. Reverse: x is their end (`ends`), with
// x_bar.
template <class T>
__global__ void load_vertices(const __grid_constant__ StepInputs<T> in, const __grid_constant__ StepView<T> s,
                              int64_t base, const T* ends, const T* x_bar, const T* v_bar, unsigned* barrier) {
  const int64_t i = own_item();
  if (i == 0) *barrier = 0;  // of the next cooperative grid
  if (i >= s.scenes * s.positions) return;
  const int64_t local = i / s.positions, scene = base + local, position = i - local * s.positions;
  const int64_t block = position / kSlice;
  const int v = static_cast<int>(position % kSlice);
  int64_t vertex = __ldg(s.plan.order + position);
  const bool phantom = vertex < 0;  // a copy of the first vertex of its block: always a defined state
  if (phantom) vertex = __ldg(s.plan.order + block * kSlice);
  const bool pinned = block >= __ldg(s.plan.color_block + s.plan.colors);
  const int64_t vectors = local * s.positions * 3;
  const Vec3<T> y = in.fused ? predict(in, scene, vertex, pinned) : load_user(in.y, scene, vertex);
  store3(s.w.y + vectors, block, v, y);
  const int64_t own = scene * s.plan.num_vertices + vertex;
  if (s.w.position && local == 0 && !phantom) s.w.position[vertex] = static_cast<int32_t>(position);
  if (ends) {
    store_row(s.w.x, i, Vec3<T>{ends[3 * own], ends[3 * own + 1], ends[3 * own + 2]});
    Vec3<T> bar = zero3<T>();
    if (x_bar) bar += Vec3<T>{x_bar[3 * own], x_bar[3 * own + 1], x_bar[3 * own + 2]};
    if (v_bar) {
      const T rate = T(1) / in.parameters.time_step;
      bar += rate * Vec3<T>{v_bar[3 * own], v_bar[3 * own + 1], v_bar[3 * own + 2]};
    }
    store_row(s.w.x_bar, i, phantom ? zero3<T>() : bar);
  } else {
    const Vec3<T> x = in.fused ? y : load_user(in.x_start, scene, vertex);
    store_row(s.w.x, i, x);
    if (s.w.moved) store_row(s.w.moved, i, x);  // pinned vertices stay there
  }
  if (s.w.x_prev) store3(s.w.x_prev + vectors, block, v, load_user(in.x_prev, scene, vertex));
  if (s.w.origin) store3(s.w.origin + vectors, block, v, load_user(in.origin, scene, vertex));
  if (local == 0 || in.mass.scene != 0) {
    s.w.mass[(in.mass.scene != 0 ? local : 0) * s.positions + position] = in.mass.data[scene * in.mass.scene + vertex];
  }
}

template <class T>
__global__ void store_vertices(const __grid_constant__ StepInputs<T> in, const __grid_constant__ StepView<T> s,
                               int64_t base, T* x, T* velocity) {
  const int64_t i = own_item();
  if (i >= s.scenes * s.positions) return;
  const int64_t local = i / s.positions, scene = base + local;
  const int64_t vertex = __ldg(s.plan.order + (i - local * s.positions));
  if (vertex < 0) return;
  const Vec3<T> end = load_row(s.w.x, i);
  const int64_t own = scene * s.plan.num_vertices + vertex;
  store_user(x, own, end);
  if (velocity)
    store_user(velocity, own, (T(1) / in.parameters.time_step) * (end - load_user(in.x_prev, scene, vertex)));
}

// Material of each pair, where it differs from tet to tet.
template <class T>
__global__ void load_material(const __grid_constant__ StepInputs<T> in, const __grid_constant__ StepView<T> s,
                              int64_t base, int64_t scenes) {
  const int64_t pairs = static_cast<int64_t>(s.plan.slots) * kSlice;
  const int64_t i = own_item();
  if (i >= scenes * pairs) return;
  const int64_t local = i / pairs, scene = base + local;
  const int pair = max(0, __ldg(s.plan.pair + (i - local * pairs)));
  const int64_t tet = pair >> 2;
#pragma unroll
  for (int m = 0; m < kMaterialScalars; ++m) {
    const Batched<const T>& given = in.material[m];
    s.w.material[kMaterialScalars * i + m] = given.data[scene * given.scene + tet * given.item];
  }
}

// Adjoints left in the rows after the last reversed update: of lower colors for a vertex that moves, of all for a
// pinned one.
template <class T>
__device__ __forceinline__ Vec3<T> rows_left(const StepView<T>& s, int64_t scene, int block, int v, bool pinned) {
  LaneLayout<1> at(scene, block, 0);
  at.v = v;
  if (pinned) return pull_rows<true>(s, at, span_of(s.plan.block_incoming, block));
  int color = 0;
  while (block >= __ldg(s.plan.color_block + color + 1)) ++color;
  return pull_rows<false>(s, at, span_of(s.plan.block_incoming, block),
                          __ldg(s.plan.block_edge + __ldg(s.plan.color_block + color)) * kSlice);
}

template <class T>
__global__ void store_adjoints(const __grid_constant__ StepInputs<T> in, const __grid_constant__ StepView<T> s,
                               int64_t base, const __grid_constant__ StepAdjoints<T> out) {
  const int64_t i = own_item();
  if (i >= s.scenes * s.positions) return;
  const int64_t local = i / s.positions, scene = base + local, position = i - local * s.positions;
  const int64_t vertex = __ldg(s.plan.order + position);
  if (vertex < 0) return;
  const int block = static_cast<int>(position / kSlice), v = static_cast<int>(position % kSlice);
  const bool pinned = block >= __ldg(s.plan.color_block + s.plan.colors);
  const int64_t own = scene * s.plan.num_vertices + vertex, vectors = local * s.positions * 3;
  Vec3<T> start = load_row(s.w.x_bar, i);
  start += rows_left(s, local, block, v, pinned);
  const Vec3<T> y = load3(s.w.y_bar + vectors, block, v);
  if (out.mass) out.mass[own] = s.w.mass_bar[i];
  if (!in.fused) {
    store_user(out.x_start, own, start);
    store_user(out.y, own, y);
    store_user(out.x_prev, own, s.w.x_prev_bar ? load3(s.w.x_prev_bar + vectors, block, v) : zero3<T>());
  } else {
    const T h = in.parameters.time_step;
    const Vec3<T> all = start + y, none = zero3<T>();
    const bool prescribed = pinned && in.prescribed.data != nullptr;
    Vec3<T> x = prescribed ? none : all;
    if (out.v_bar) x -= (T(1) / h) * Vec3<T>{out.v_bar[3 * own], out.v_bar[3 * own + 1], out.v_bar[3 * own + 2]};
    if (out.x) store_user(out.x, own, x);
    if (out.v) store_user(out.v, own, pinned ? none : h * all);
    if (out.acceleration) store_user(out.acceleration, own, pinned ? none : (h * h) * all);
    if (out.prescribed) store_user(out.prescribed, own, prescribed ? all : none);
  }
  for (int k = 0; out.data && k < kVertexEnergies; ++k) {
    if (is_per_vertex(k, VertexEnergies{})) {
      T* to = out.data + scene * in.data_size + s.data_start[k] + vertex * s.data_count[k];
      for (int c = 0; c < s.data_count[k]; ++c) {
        to[c] = s.w.data_bar[(local * s.data_scalars + s.data_row[k] + c) * s.positions + position];
      }
    }
  }
}

// Sums over a tet's four pairs, in the order of its corners.
template <class T>
__global__ void store_tets(const __grid_constant__ StepView<T> s, int64_t base,
                           const __grid_constant__ StepAdjoints<T> out, bool material) {
  const int64_t i = own_item();
  if (i >= s.scenes * s.plan.num_tets) return;
  const int64_t local = i / s.plan.num_tets, scene = base + local, tet = i - local * s.plan.num_tets;
  const int64_t pairs = static_cast<int64_t>(s.plan.slots) * kSlice, to = scene * s.plan.num_tets + tet;
  T material_bar[kMaterialScalars] = {}, rest[kRestScalars] = {};
#pragma unroll
  for (int a = 0; a < 4; ++a) {
    const int64_t at = __ldg(s.plan.tet_pair + 4 * tet + a);
    if (at < 0) continue;
    if (material) {
      const T* m = s.w.material_bar + (local * pairs + at) * kMaterialScalars;
#pragma unroll
      for (int k = 0; k < kMaterialScalars; ++k) material_bar[k] += m[k];
    }
    if (out.rest) {
      const T* r = s.w.rest_bar + (local * pairs + at) * kPairRest;
#pragma unroll
      for (int b = 0; b < kPairRest; ++b) rest[TetLayout::rest_index(a, b)] += r[b];
    }
  }
  for (int k = 0; material && k < kMaterialScalars; ++k) out.material[k][to] = material_bar[k];
  for (int k = 0; out.rest && k < kRestScalars; ++k) out.rest[to * kRestScalars + k] = rest[k];
}

// out[r] = sum over i < count of values[r stride + i step], a block for each row, in an order fixed by the count.
template <class T>
__global__ void sum_rows(const T* values, int64_t stride, int64_t step, int64_t count, T* out, int64_t out_stride) {
  __shared__ T part[kFrameThreads];
  const T* row = values + static_cast<int64_t>(blockIdx.x) * stride;
  T sum = T(0);
  for (int64_t i = threadIdx.x; i < count; i += kFrameThreads) sum += row[i * step];
  part[threadIdx.x] = sum;
  reduce_block<kFrameThreads>(part, [](T& own, const T& other) { own += other; });
  if (threadIdx.x == 0) out[blockIdx.x * out_stride] = part[0];
}

}  // namespace
}  // namespace diffvbd::cuda
