// Kernels of contact: several threads for each vertex of a color or each corner point, or one for each pair.
#pragma once

#include <cstdint>

#include "../contact/friction.h"
#include "common.cuh"
#include "contact.h"
#include "contact_sweep.cuh"
#include "schedule.cuh"

namespace diffvbd::cuda {
namespace {

constexpr int kContactThreads = kWarpsPerBlock * kSlice;
// Threads for a vertex of a color, for a vertex of a small color, and for a corner point.
constexpr int kGapFraction = 8, kWide = 32, kCornerShare = 8;

// Vertices of the blocks [begin, end) that a warp works on, as one of `roles` warps.
template <int share>
struct Part {
  int64_t scene;
  int block, part, role;
  bool there;
  template <class T>
  __device__ __forceinline__ Part(const StepView<T>& s, int64_t begin, int64_t end, int roles = 1) {
    int64_t i = own_item() / kSlice;
    const int64_t parts = (end - begin) * share;
    role = roles > 1 ? static_cast<int>(i % roles) : kAllPairs;
    i /= roles;
    scene = i / parts, i -= scene * parts;
    block = static_cast<int>(begin + i / share), part = static_cast<int>(i % share);
    there = scene < s.scenes;
  }
  __device__ __forceinline__ LaneLayout<share> place() const { return {scene, block, part}; }
  template <class T>
  __device__ __forceinline__ int64_t row(const StepView<T>& s, const LaneLayout<share>& at) const {
    return scene * s.positions + static_cast<int64_t>(block) * kSlice + at.v;
  }
};

// sweep: in the reverse, whose tape has the positions of the color; otherwise negative.
template <int share, class T>
__global__ void assemble_contact(const __grid_constant__ StepView<T> s, const __grid_constant__ ContactView<T> c,
                                 int sweep, int64_t begin, int64_t end) {
  const Part<share> part(s, begin, end);
  wait_for_previous();
  if (!part.there) return;
  const LaneLayout<share> at = part.place();
  T* to = s.w.contact + part.row(s, at) * kContactScalars;
  const auto gather = [&](const auto& rows) {
    PairsOf<T, share, std::decay_t<decltype(rows)>>(s, c.in, at, rows).gather(to);
  };
  if (sweep < 0) {
    gather(sweep_rows(s, at.scene, begin, end, MovingRows<T>{s.w.x, s.w.moved}));
  } else {
    gather(tape_rows_of(s, at.scene, sweep, begin, end));
  }
}

template <int share, class T>
__global__ void limit_contact(const __grid_constant__ StepView<T> s, const __grid_constant__ ContactView<T> c,
                              int sweep, int64_t begin, int64_t end) {
  const Part<share> part(s, begin, end);
  wait_for_previous();
  if (!part.there) return;
  const LaneLayout<share> at = part.place();
  const int64_t row = part.row(s, at);
  const SweepRows<T> rows = sweep_rows(s, at.scene, begin, end, MovingRows<T>{s.w.x, s.w.moved});
  PairsOf<T, share, SweepRows<T>> pairs(s, c.in, at, rows);
  const Vec3<T> from = load_row(s.w.x, row), d = load_row(s.w.moved, row) - from;
  const int exponent = pairs.limit(pairs.trust_region(), from, d);
  if (pairs.vertex < 0 || at.lane != 0) return;
  c.truncations[((s.base + at.scene) * s.sweeps + sweep) * c.in.num_vertices + pairs.vertex] =
      static_cast<uint8_t>(exponent);
  if (exponent > 0) store_row(s.w.moved, row, from + contact::limit_of<T>(exponent) * d);
}

template <class T>
__device__ __forceinline__ void add_row(T* rows, int64_t row, const Vec3<T>& a) {
  diffvbd::add_to(rows + kRow * row, a);
}

template <int share, class T>
__global__ void prepare_contact(const __grid_constant__ StepView<T> s, const __grid_constant__ ContactView<T> c,
                                int64_t begin, int64_t end) {
  const Part<share> part(s, begin, end);
  wait_for_previous();
  if (!part.there) return;
  const LaneLayout<share> at = part.place();
  const SweepRows<T> rows = settled_rows(s, at.scene, begin, end);
  const PairsOf<T, share, SweepRows<T>> pairs(s, c.in, at, rows);
  if (!__any_sync(kWholeWarp, pairs.touches())) return;
  T now[3];
  take_scattered(c, pairs, now);
  if (pairs.touches() && at.lane == 0) add_row(s.w.x_bar, part.row(s, at), diffvbd::vector_at(now));
}

template <int share, class T>
__global__ void __launch_bounds__(kContactThreads, 3)
    reverse_contact(const __grid_constant__ StepView<T> s, const __grid_constant__ ContactView<T> c, int roles,
                    int64_t begin, int64_t end) {
  const Part<share> part(s, begin, end, roles);
  wait_for_previous();
  if (!part.there) return;
  scatter_pairs(s, c, part.place(), part.role, begin, end);
}

// Sum over the threads of a vertex, which may leave their loops at different times.
template <int share, class T, class... R>
__device__ __forceinline__ void sum_share(R&... values) {
  __syncwarp();
  change_numbers<T>(
      [](auto& all) {
#pragma unroll
        for (int offset = share / 2; offset > 0; offset /= 2) add_from(all, offset);
      },
      values...);
}

template <class T>
__global__ void collect_contact(const __grid_constant__ StepView<T> s, const __grid_constant__ ContactInputs<T> in,
                                const __grid_constant__ ContactAdjoints<T> slots, T* collider_bar) {
  const int64_t i = own_item(), item = i / kCornerShare;
  const int64_t local = item / in.corners, corner = item - local * in.corners, scene = s.base + local;
  const bool there = local < s.scenes;
  Vec3<T> now = zero3<T>(), prev = zero3<T>();
  if (there) {
    contact::gather_pairs(in, slots, scene, static_cast<int>(corner), static_cast<int>(i % kCornerShare), kCornerShare,
                          now, prev);
  }
  sum_share<kCornerShare, T>(now, prev);
  if (!there || i % kCornerShare != 0) return;
  if (corner < in.num_vertices) {
    add_row(s.w.x_bar, local * s.positions + s.w.position[corner], now);
  } else {
    T* to = collider_bar + 3 * (scene * (in.corners - in.num_vertices) + corner - in.num_vertices);
    to[0] = now.x, to[1] = now.y, to[2] = now.z;
  }
  diffvbd::add_to(slots.prev + 3 * (scene * in.corners + corner), prev);
}

template <class T>
__global__ void store_contact(const __grid_constant__ StepView<T> s, const __grid_constant__ ContactInputs<T> in,
                              const __grid_constant__ StepAdjoints<T> out, const T* prev) {
  const int64_t i = own_item();
  const int64_t local = i / in.corners, corner = i - local * in.corners, scene = s.base + local;
  if (local >= s.scenes) return;
  const Vec3<T> own = diffvbd::vector_at(prev + 3 * (scene * in.corners + corner));
  if (corner >= in.num_vertices) {
    T* to = out.collider_prev + 3 * (scene * (in.corners - in.num_vertices) + corner - in.num_vertices);
    to[0] = own.x, to[1] = own.y, to[2] = own.z;
    return;
  }
  diffvbd::add_to(out.x_prev + 3 * (scene * in.num_vertices + corner), own);
}

constexpr int kSumThreads = 1024;

// Sum of a scalar of the slots of each scene's pairs, a block each, in an order fixed by the number of pairs. each:
// slots of a pair; stride: scalars between slots.
template <class T>
__global__ void __launch_bounds__(kSumThreads) sum_by_scene(const __grid_constant__ ContactInputs<T> in, int64_t base,
                                                            const T* slots, int each, int stride, T* out) {
  __shared__ T part[kSumThreads];
  const int64_t scene = base + blockIdx.x;
  T sum = T(0);
  const auto first = [&](int64_t of) { return int64_t{in.listed.ptr[of * in.corners]} / 4 * each; };
  for (int64_t i = first(scene) + threadIdx.x; i < first(scene + 1); i += kSumThreads) sum += slots[i * stride];
  part[threadIdx.x] = sum;
  reduce_block<kSumThreads>(part, [](T& own, const T& other) { own += other; });
  if (threadIdx.x == 0) out[scene] = part[0];
}

template <class T>
cudaError_t launch_sum(int64_t scenes, cudaStream_t stream, const ContactInputs<T>& in, int64_t base, const T* slots,
                       int each, int stride, T* out) {
  if (scenes > 0) {
    sum_by_scene<T><<<static_cast<unsigned>(scenes), kSumThreads, 0, stream>>>(in, base, slots, each, stride, out);
  }
  return cudaGetLastError();
}

template <class T>
__global__ void sum_lag_slots(const int32_t* entries, const T* slots, int64_t items, T* lag) {
  const int64_t i = own_item();
  if (i >= items) return;
  const int64_t pair = i / contact::kLagScalars, scalar = i - pair * contact::kLagScalars;
  T sum = T(0);
  for (int k = 0; k < 4 && 4 * pair < *entries; ++k) sum += slots[(4 * pair + k) * contact::kLagScalars + scalar];
  lag[i] = sum;
}

template <class... P, class... A>
cudaError_t launch_pass(void (*kernel)(P...), int64_t items, cudaStream_t stream, bool dependent, A... arguments) {
  if (items == 0) return cudaSuccess;
  void* pointers[] = {&arguments...};
  const unsigned blocks = blocks_for(items, kContactThreads);
  return launch(reinterpret_cast<const void*>(kernel), blocks, dim3(kContactThreads), pointers, 0, stream, dependent);
}
template <class... P, class... A>
cudaError_t launch_contact(void (*kernel)(P...), int64_t items, cudaStream_t stream, A... arguments) {
  return launch_pass(kernel, items, stream, false, arguments...);
}

// Clears the rows [from, to) that belong to the threads of the block. Neighbouring threads write neighbouring scalars.
// All threads must call it.
template <class T>
__device__ __forceinline__ void clear_rows(T* rows, int scalars, int64_t from, int64_t to) {
  const int64_t begin = static_cast<int64_t>(blockIdx.x) * blockDim.x, end = begin + blockDim.x;
  const int64_t last = (end < to ? end : to) * scalars;
  for (int64_t i = (begin < from ? from : begin) * scalars + threadIdx.x; i < last; i += blockDim.x) rows[i] = T(0);
}

// Listed pair with the inputs of its lagged quantities.
template <class T>
struct LagPair {
  const int32_t* record;
  contact::PairConstants<T> constants;
  T kappa;
  contact::Corners<T> corners;
  __device__ __forceinline__ LagPair(const ContactInputs<T>& in, const T* x, int64_t pair)
      : record(in.listed.pairs + contact::kPairRow * pair),
        constants(in.constants + contact::kConstants * pair),
        kappa(in.kappa.data[record[5] * in.kappa.scene]) {
    const UserRows<T> rows{x + static_cast<int64_t>(record[5]) * 3 * in.num_vertices};
    corners = contact::Source<T, UserRows<T>>{in, record[5], rows}.corners(record);
  }
};

// Three scalars of a pair in addition to those of its corners.
template <class T>
struct OwnScalars {
  T of[3];
};
template <class T>
struct SceneSums {
  T* out[3];
};
template <class T>
__device__ __forceinline__ void store_slots(const Vec3<T> (&corners)[4], const OwnScalars<T>& own, T* to) {
  for (int k = 0; k < 4; ++k) {
    to[4 * k] = corners[k].x, to[4 * k + 1] = corners[k].y, to[4 * k + 2] = corners[k].z;
    if (k < 3) to[4 * k + 3] = own.of[k];
  }
}

template <class T>
__global__ void lag_forward(const __grid_constant__ ContactInputs<T> in, const T* x, int64_t scenes, int64_t pairs,
                            T* values) {
  const int64_t pair = own_item();
  const int64_t count = in.listed.ptr[scenes * in.corners] / 4;
  clear_rows(values, contact::kLagScalars, count, pairs);
  if (pair >= count) return;
  T* to = values + contact::kLagScalars * pair;
  const LagPair<T> at(in, x, pair);
  contact::store_lag(contact::lag_state(at.record[4], at.corners, at.constants, at.kappa), to);
}

template <class T>
__global__ void find_loads(contact::PairList listed, int64_t corners, const int32_t* body, const T* lag, int64_t scenes,
                           int64_t pairs, T* force, int64_t* bearer) {
  const int64_t pair = own_item();
  if (pair >= pairs) return;
  const bool some = pair < listed.ptr[scenes * corners] / 4;
  const auto load = some ? contact::load_of(listed, corners, body, lag, pair) : contact::Load<T>{pair, T(0)};
  force[pair] = load.force, bearer[pair] = load.bearer;
}

template <class T>
__global__ void lag_reverse(const __grid_constant__ ContactInputs<T> in, const T* x, int64_t scenes, int64_t pairs,
                            const T* bar, T* slots) {
  const int64_t pair = own_item();
  if (pair >= pairs || 4 * pair >= in.listed.ptr[scenes * in.corners]) return;
  const LagPair<T> at(in, x, pair);
  contact::PairAdjoint<T> out;
  contact::reverse_lag(at.record[4], at.corners, at.constants, at.kappa, bar + contact::kLagScalars * pair, out);
  store_slots(out.x, {out.kappa}, slots + kLagSlots * pair);
}

// Sum for each corner point over the corners of its pairs [B, N, 3], a warp each.
template <class T>
__global__ void lag_collect(const __grid_constant__ ContactInputs<T> in, int64_t scenes, const T* slots, T* out) {
  const int64_t i = own_item(), row = i / kSlice;
  if (row >= scenes * in.corners) return;
  const auto lane = static_cast<int>(i % kSlice);
  Vec3<T> sum = zero3<T>();
  for (int e = in.listed.ptr[row] + lane; e < in.listed.ptr[row + 1]; e += kSlice) {
    sum += diffvbd::vector_at(slots + int64_t{4} * in.listed.entry[e]);
  }
  sum_share<kSlice, T>(sum);
  if (lane != 0) return;
  T* to = out + 3 * row;
  to[0] = sum.x, to[1] = sum.y, to[2] = sum.z;
}

// Sums of slots over corner points, and of three scalars of pairs by scene, of which some may be null.
template <class T>
cudaError_t sum_slots(const ContactInputs<T>& in, int64_t scenes, const T* slots, T* points, const SceneSums<T>& of,
                      cudaStream_t stream) {
  if (auto error = launch_contact(lag_collect<T>, scenes * in.corners * kSlice, stream, in, scenes, slots, points)) {
    return error;
  }
  for (int i = 0; i < 3; ++i) {
    if (!of.out[i]) continue;
    if (auto error = launch_sum(scenes, stream, in, int64_t{0}, slots + 4 * i + 3, 1, kLagSlots, of.out[i])) {
      return error;
    }
  }
  return cudaSuccess;
}

}  // namespace

template <class T>
template <class... P, class... A>
cudaError_t ContactPasses<T>::over(void (*kernel)(P...), int64_t begin, int64_t end, int warps, bool dependent,
                                   A... arguments) const {
  return launch_pass(kernel, s.scenes * (end - begin) * warps * kSlice, stream, dependent, s, c, arguments..., begin,
                     end);
}
template <class T>
cudaError_t ContactPasses<T>::assemble(int sweep, int64_t begin, int64_t end, bool dependent) const {
  return over(assemble_contact<kGapFraction, T>, begin, end, kGapFraction, dependent, sweep);
}
template <class T>
cudaError_t ContactPasses<T>::limit(int sweep, int64_t begin, int64_t end, bool dependent) const {
  return over(limit_contact<kGapFraction, T>, begin, end, kGapFraction, dependent, sweep);
}
template <class T>
cudaError_t ContactPasses<T>::prepare(int64_t begin, int64_t end, bool dependent) const {
  return over(prepare_contact<kGapFraction, T>, begin, end, kGapFraction, dependent);
}
template <class T>
cudaError_t ContactPasses<T>::reverse(bool few, int64_t begin, int64_t end, bool dependent) const {
  if (few) return over(reverse_contact<kWide, T>, begin, end, kWide * kRoles, dependent, kRoles);
  return over(reverse_contact<kGapFraction, T>, begin, end, kGapFraction, dependent, 1);
}
template <class T>
cudaError_t ContactPasses<T>::collect(const StepAdjoints<T>& out) const {
  return launch_contact(collect_contact<T>, s.scenes * c.in.corners * kCornerShare, stream, s, c.in, c.slots,
                        out.collider);
}
template <class T>
cudaError_t ContactPasses<T>::store(const StepAdjoints<T>& out) const {
  const T *prev = c.slots.prev, *slots = c.slots.kappa;
  if (auto error = launch_contact(store_contact<T>, s.scenes * c.in.corners, stream, s, c.in, out, prev)) return error;
  return launch_sum(s.scenes, stream, c.in, s.base, slots, 4, 1, out.kappa);
}

template <class T>
cudaError_t sum_lag(const ContactInputs<T>& in, int64_t scenes, const ContactAdjoints<T>& slots, int64_t pairs, T* lag,
                    cudaStream_t stream) {
  if (pairs == 0) return cudaSuccess;
  const int64_t items = pairs * contact::kLagScalars;
  const int32_t* entries = in.lagged.ptr + scenes * in.corners;
  const T* from = slots.lag;
  return launch_contact(sum_lag_slots<T>, items, stream, entries, from, items, lag);
}

template <class T>
cudaError_t pair_lag(const ContactInputs<T>& in, const T* x, int64_t scenes, int64_t pairs, T* values,
                     cudaStream_t stream) {
  return launch_contact(lag_forward<T>, pairs, stream, in, x, scenes, pairs, values);
}

template <class T>
cudaError_t pair_loads(const contact::PairList& listed, int64_t corners, const int32_t* body, const T* lag,
                       int64_t scenes, int64_t pairs, T* force, int64_t* bearer, cudaStream_t stream) {
  return launch_contact(find_loads<T>, pairs, stream, listed, corners, body, lag, scenes, pairs, force, bearer);
}

template <class T>
cudaError_t pair_lag_backward(const ContactInputs<T>& in, const T* x, int64_t scenes, int64_t pairs, const T* bar,
                              T* slots, T* points, T* kappa, cudaStream_t stream) {
  if (auto error = launch_contact(lag_reverse<T>, pairs, stream, in, x, scenes, pairs, bar, slots)) return error;
  return sum_slots(in, scenes, slots, points, {kappa}, stream);
}

}  // namespace diffvbd::cuda
