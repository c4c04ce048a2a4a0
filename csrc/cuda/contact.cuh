// Kernels of contact: several threads for each vertex of a color, kShare for each corner point, or one for each pair.
#pragma once

#include "contact_near.cuh"
#include "contact_rows.cuh"
#include "follow.cuh"

namespace diffvbd::cuda {
namespace {

using contact::ContactAdjoints;
using contact::ContactInputs;

constexpr int kShare = 8;
// Threads for a vertex where its color has few, which do not fill the device: its pairs are waited for one by one.
constexpr int kWide = 32;
constexpr int64_t kFewVertices = 2048;  // of a color, in all scenes

template <int share, class T>
__device__ __forceinline__ void sum_share(T& a) {
#pragma unroll
  for (int offset = share / 2; offset > 0; offset /= 2) a += __shfl_xor_sync(kWholeWarp, a, offset);
}
template <int share, class T>
__device__ __forceinline__ void sum_share(Vec3<T>& a) {
  sum_share<share>(a.x), sum_share<share>(a.y), sum_share<share>(a.z);
}

// Which of `share` threads of which vertex of the blocks [begin, end) a thread is.
template <int share, class T>
struct Member {
  int lane, vertex = -1;  // -1: a phantom, or beyond the end
  int64_t local = 0, scene = 0, position = 0;
  bool touches = false;
  int64_t first, last;  // positions of the blocks
  __device__ __forceinline__ Member(const StepView<T>& s, const ContactInputs<T>& in, int64_t begin, int64_t end)
      : first(begin * kSlice), last(end * kSlice) {
    const int64_t i = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x, item = i / share;
    const int64_t size = (end - begin) * kSlice;
    lane = static_cast<int>(i % share);
    local = item / size;
    if (local >= s.scenes) return;
    position = begin * kSlice + (item - local * size);
    scene = s.base + local;
    vertex = __ldg(s.plan.order + position);
    if (vertex < 0) return;
    const int64_t row = scene * in.corners + vertex;
    touches = __ldg(in.listed.ptr + row) < __ldg(in.listed.ptr + row + 1) || in.planes > 0 ||
              (in.lag && __ldg(in.lagged.ptr + row) < __ldg(in.lagged.ptr + row + 1));
  }
  __device__ __forceinline__ contact::PairList::Entries listed(const ContactInputs<T>& in) const {
    return vertex < 0 ? contact::PairList::Entries{nullptr, 0} : in.listed.of(scene * in.corners + vertex);
  }
  __device__ __forceinline__ contact::PairList::Entries lagged(const ContactInputs<T>& in) const {
    return vertex < 0 ? contact::PairList::Entries{nullptr, 0} : in.lags_of(scene, vertex);
  }
  __device__ __forceinline__ int64_t row(const StepView<T>& s) const { return local * s.positions + position; }
  __device__ __forceinline__ SweepRows<T> rows(const StepView<T>& s) const {
    return {s.w.x + local * s.positions * kRow, s.w.position, first, last};
  }
};

template <class T>
__global__ void load_contact(const __grid_constant__ StepView<T> s, const __grid_constant__ ContactInputs<T> in) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i >= s.scenes * s.positions) return;
  const int64_t local = i / s.positions, position = i - local * s.positions;
  const int own = __ldg(s.plan.order + position);
  for (int k = 0; k < kContactScalars; ++k) s.w.contact[i * kContactScalars + k] = T(0);
  if (own < 0) return;
  if (local == 0) s.w.position[own] = static_cast<int32_t>(position);
}

template <int share, class T>
__global__ void assemble_contact(const __grid_constant__ StepView<T> s, const __grid_constant__ ContactInputs<T> in,
                                 int64_t begin, int64_t end) {
  __shared__ T slots[kContactThreads / kSlice][kSlice][kContactScalars];
  const Member<share, T> at(s, in, begin, end);
  wait_for_previous();
  if (s.w.before && at.vertex >= 0 && at.lane == 0) store_row(s.w.before, at.row(s), load_row(s.w.x, at.row(s)));
  if (!__any_sync(kWholeWarp, at.touches)) return;
  const SweepRows<T> rows = at.rows(s);
  const contact::Source<T, SweepRows<T>> source{in, at.scene, rows};
  const T h = s.parameters.time_step;
  BlockSums<share, T> sums{slots[threadIdx.x / kSlice]};
  Vec3<T> g = zero3<T>();
  Sym3<T> H = diagonal(T(0));
  // A warp of one vertex adds up in its threads first.
  const auto add = [&](const Found& found, const auto& f) {
    const int vertex = found.of(at.vertex);
    if constexpr (share == kSlice) {
      if (found.there()) f(vertex, g, H);
    } else {
      Vec3<T> g_of = zero3<T>();
      Sym3<T> H_of = diagonal(T(0));
      if (found.there()) f(vertex, g_of, H_of);
      sums.add(g_of, H_of, found.thread);
    }
  };
  each_near<share>(
      at.listed(in), at.lane, [&](int entry) { return contact::is_near(source, entry); },
      [&](const Found& found) {
        add(found, [&](int v, Vec3<T>& g_of, Sym3<T>& H_of) {
          contact::add_barrier_of(source, found.entry, v, h, g_of, H_of);
        });
      });
  if (in.lag) {
    each_near<share>(
        at.lagged(in), at.lane, [](int) { return true; },
        [&](const Found& found) {
          add(found,
              [&](int v, Vec3<T>& g_of, Sym3<T>& H_of) { contact::add_lag_of(source, found.entry, v, h, g_of, H_of); });
        });
  }
  if (at.touches) contact::add_floor_lags(source, at.vertex, at.lane, share, h, g, H);
  if (share == kSlice || in.planes > 0) sums.add(g, H, threadIdx.x % kSlice);
  if (at.touches) sums.store(s.w.contact + at.row(s) * kContactScalars);
}

// The threads of a warp look at the pairs of its vertices; the least that any of them lets pass is the limit.
template <int share, class T>
__global__ void limit_contact(const __grid_constant__ StepView<T> s, const __grid_constant__ ContactInputs<T> in,
                              uint8_t* cut, int sweep, int64_t begin, int64_t end) {
  __shared__ int exponents[kContactThreads / share];  // of the vertices of the block
  const Member<share, T> at(s, in, begin, end);
  wait_for_previous();
  const bool there = at.vertex >= 0;
  const RowsBefore<T> rows{at.rows(s), s.w.before + at.local * s.positions * kRow};
  const contact::Source<T, RowsBefore<T>> source{in, at.scene, rows};
  int exponent = 0, &limit = exponents[threadIdx.x / share];
  Vec3<T> from = zero3<T>(), d = zero3<T>();
  T length = T(0), guard = T(0);
  if (there) {
    from = load_row(s.w.before, at.row(s)), d = load_row(s.w.x, at.row(s)) - from;
    exponent = contact::limit_by_room(source, at.vertex, from, d);
    length = contact::length_of(d), guard = contact::guard_of(source, at.vertex);
  }
  if (at.lane == 0) limit = exponent;
  __syncwarp();
  const int least = exponent;
  each_near<share>(
      at.listed(in), at.lane, [&](int entry) { return contact::may_limit(source, entry, length, guard, least); },
      [&](const Found& found) {
        const Vec3<T> d_of = found.of(d);
        const T length_of = found.of(length), guard_of = found.of(guard);
        const int before = found.of(exponent), place = found.of(static_cast<int>(threadIdx.x)) / share;
        if (found.there()) {
          atomicMax(exponents + place, contact::limit_by_pair(source, found.entry, d_of, length_of, guard_of, before));
        }
        __syncwarp();
        exponent = limit;
      });
  if (!there || at.lane != 0) return;
  cut[(at.scene * s.sweeps + sweep) * in.num_vertices + at.vertex] = static_cast<uint8_t>(exponent);
  if (exponent > 0) store_row(s.w.x, at.row(s), from + contact::limit_of<T>(exponent) * d);
}

template <class T>
__device__ __forceinline__ void add_row(T* rows, int64_t row, const Vec3<T>& a) {
  contact::add_at(rows + kRow * row, a);
}

template <int share, class T>
__global__ void prepare_contact(const __grid_constant__ StepView<T> s, const __grid_constant__ ContactInputs<T> in,
                                const __grid_constant__ ContactAdjoints<T> slots, int sweep, int rows_of_tape,
                                int64_t begin, int64_t end) {
  const Member<share, T> at(s, in, begin, end);
  wait_for_previous();
  if (at.vertex >= 0 && at.lane == 0) {
    const int64_t active = s.plan.num_active;
    const int rank = __ldg(s.plan.block_rank + at.position / kSlice) + static_cast<int>(at.position % kSlice);
    const T* from = s.tape + (at.local * s.sweeps + sweep) * rows_of_tape * active + rank;
    store_row(s.w.x, at.row(s), Vec3<T>{from[0], from[active], from[2 * active]});
  }
  if (!__any_sync(kWholeWarp, at.touches)) return;
  Vec3<T> now = zero3<T>(), prev = zero3<T>();
  if (at.touches) contact::take_pairs(in, slots, at.scene, at.vertex, at.lane, share, now, prev);
  sum_share<share>(now), sum_share<share>(prev);
  if (!at.touches || at.lane != 0) return;
  add_row(s.w.x_bar, at.row(s), now);
  contact::add_at(slots.prev + 3 * (at.scene * in.corners + at.vertex), prev);
}

template <int share, class T>
__global__ void __launch_bounds__(kContactThreads, 3)
    reverse_contact(const __grid_constant__ StepView<T> s, const __grid_constant__ ContactInputs<T> in,
                    const __grid_constant__ ContactAdjoints<T> slots, int64_t begin, int64_t end) {
  const Member<share, T> at(s, in, begin, end);
  wait_for_previous();
  if (!__any_sync(kWholeWarp, at.touches)) return;
  const SweepRows<T> rows = at.rows(s);
  const contact::Source<T, SweepRows<T>> source{in, at.scene, rows};
  const T h = s.parameters.time_step;
  Vec3<T> own = zero3<T>(), p = zero3<T>(), d_raw = zero3<T>();
  if (at.touches) {
    const T* turn = s.w.turn + 6 * at.row(s);
    p = contact::vector_at(turn), d_raw = contact::vector_at(turn + 3);
  }
  // f(vertex, p, d_raw) of whose entry has been found
  const auto reverse = [&](const Found& found, const auto& f) {
    const int vertex = found.of(at.vertex);
    const Vec3<T> p_of = found.of(p), d_of = found.of(d_raw);
    if (found.there()) f(vertex, p_of, d_of);
  };
  each_near<share>(
      at.listed(in), at.lane, [&](int entry) { return contact::is_near(source, entry); },
      [&](const Found& found) {
        reverse(found, [&](int v, const Vec3<T>& p_of, const Vec3<T>& d_of) {
          contact::reverse_barrier_of(source, slots, found.entry, v, h, p_of, d_of);
        });
      });
  if (in.lag) {
    each_near<share>(
        at.lagged(in), at.lane, [](int) { return true; },
        [&](const Found& found) {
          reverse(found, [&](int v, const Vec3<T>& p_of, const Vec3<T>& d_of) {
            contact::reverse_lag_of(source, slots, found.entry, v, h, p_of, d_of);
          });
        });
  }
  if (in.planes == 0) return;
  if (at.touches) contact::reverse_floor_lags(source, slots, at.vertex, at.lane, share, h, p, d_raw, own);
  sum_share<share>(own);
  if (!at.touches || at.lane != 0) return;
  add_row(s.w.x_bar, at.row(s), own);
  contact::add_at(slots.prev + 3 * (at.scene * in.corners + at.vertex), -own);
}

template <class T>
__global__ void collect_contact(const __grid_constant__ StepView<T> s, const __grid_constant__ ContactInputs<T> in,
                                const __grid_constant__ ContactAdjoints<T> slots, T* collider_bar) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x, item = i / kShare;
  const int64_t local = item / in.corners, corner = item - local * in.corners, scene = s.base + local;
  const bool there = local < s.scenes;
  Vec3<T> now = zero3<T>(), prev = zero3<T>();
  if (there) {
    contact::take_pairs(in, slots, scene, static_cast<int>(corner), static_cast<int>(i % kShare), kShare, now, prev);
  }
  sum_share<kShare>(now), sum_share<kShare>(prev);
  if (!there || i % kShare != 0) return;
  if (corner < in.num_vertices) {
    add_row(s.w.x_bar, local * s.positions + s.w.position[corner], now);
  } else {
    T* to = collider_bar + 3 * (scene * (in.corners - in.num_vertices) + corner - in.num_vertices);
    to[0] = now.x, to[1] = now.y, to[2] = now.z;
  }
  contact::add_at(slots.prev + 3 * (scene * in.corners + corner), prev);
}

template <class T>
__global__ void store_contact(const __grid_constant__ StepView<T> s, const __grid_constant__ ContactInputs<T> in,
                              const __grid_constant__ StepAdjoints<T> out, const T* prev) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  const int64_t local = i / in.corners, corner = i - local * in.corners, scene = s.base + local;
  if (local >= s.scenes) return;
  const Vec3<T> own = contact::vector_at(prev + 3 * (scene * in.corners + corner));
  if (corner >= in.num_vertices) {
    T* to = out.collider_prev + 3 * (scene * (in.corners - in.num_vertices) + corner - in.num_vertices);
    to[0] = own.x, to[1] = own.y, to[2] = own.z;
    return;
  }
  contact::add_at(out.x_prev + 3 * (scene * in.num_vertices + corner), own);
}

constexpr int kSumThreads = 1024;

// One scalar of the slots of each scene's pairs, one block a scene, in an order fixed by the number of pairs.
template <class T>
__global__ void __launch_bounds__(kSumThreads)
    sum_by_scene(const __grid_constant__ ContactInputs<T> in, int64_t base, const T* slots, int stride, T* out) {
  __shared__ T part[kSumThreads];
  const int64_t scene = base + blockIdx.x;
  T sum = T(0);
  for (int64_t i = in.listed.ptr[scene * in.corners] + static_cast<int64_t>(threadIdx.x);
       i < in.listed.ptr[(scene + 1) * in.corners]; i += kSumThreads) {
    sum += slots[i * stride];
  }
  part[threadIdx.x] = sum;
  for (int half = kSumThreads / 2; half > 0; half /= 2) {
    __syncthreads();
    if (threadIdx.x < half) part[threadIdx.x] += part[threadIdx.x + half];
  }
  if (threadIdx.x == 0) out[scene] = part[0];
}

template <class T>
cudaError_t launch_sum(int64_t scenes, cudaStream_t stream, const ContactInputs<T>& in, int64_t base, const T* slots,
                       int stride, T* out) {
  if (scenes > 0) {
    sum_by_scene<T><<<static_cast<unsigned>(scenes), kSumThreads, 0, stream>>>(in, base, slots, stride, out);
  }
  return cudaGetLastError();
}

template <class T>
__global__ void sum_lag_slots(const int32_t* entries, const T* slots, int64_t items, T* lag) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (i >= items) return;
  const int64_t pair = i / contact::kLagScalars, scalar = i - pair * contact::kLagScalars;
  T sum = T(0);
  for (int k = 0; k < 4 && 4 * pair < *entries; ++k) sum += slots[(4 * pair + k) * contact::kLagScalars + scalar];
  lag[i] = sum;
}

template <class... P, class... A>
cudaError_t launch_pass(void (*kernel)(P...), int64_t items, cudaStream_t stream, bool follows, A... arguments) {
  if (items == 0) return cudaSuccess;
  void* pointers[] = {&arguments...};
  const unsigned blocks = static_cast<unsigned>((items + kContactThreads - 1) / kContactThreads);
  return launch(reinterpret_cast<const void*>(kernel), blocks, dim3(kContactThreads), pointers, 0, stream, follows);
}
template <class... P, class... A>
cudaError_t launch_contact(void (*kernel)(P...), int64_t items, cudaStream_t stream, A... arguments) {
  return launch_pass(kernel, items, stream, false, arguments...);
}

// For the vertices of the blocks [begin, end): with as many threads for each as the whole batch says, so that a scene
// has the same bits in any chunk of it.
template <class T, class... P, class... A>
cudaError_t launch_color(void (*kernel)(P...), void (*wide)(P...), const ContactPasses<T>& passes, int64_t begin,
                         int64_t end, A... arguments) {
  const int64_t vertices = (end - begin) * kSlice;
  const bool few = passes.scenes * vertices <= kFewVertices;
  return launch_pass(few ? wide : kernel, passes.s.scenes * vertices * (few ? kWide : kShare), passes.stream,
                     passes.follows, arguments...);
}

}  // namespace

template <class T>
cudaError_t ContactPasses<T>::load() const {
  return launch_contact(load_contact<T>, s.scenes * s.positions, stream, s, in);
}
template <class T>
cudaError_t ContactPasses<T>::assemble(int64_t begin, int64_t end) const {
  return launch_color<T>(assemble_contact<kShare, T>, assemble_contact<kWide, T>, *this, begin, end, s, in, begin, end);
}
template <class T>
cudaError_t ContactPasses<T>::limit(int sweep, int64_t begin, int64_t end) const {
  return launch_color<T>(limit_contact<kShare, T>, limit_contact<kWide, T>, *this, begin, end, s, in, cut, sweep, begin,
                         end);
}
template <class T>
cudaError_t ContactPasses<T>::prepare(int sweep, int64_t begin, int64_t end) const {
  return launch_color<T>(prepare_contact<kShare, T>, prepare_contact<kWide, T>, *this, begin, end, s, in, *out->contact,
                         sweep, tape_rows(s.tape_policy, true), begin, end);
}
template <class T>
cudaError_t ContactPasses<T>::reverse(int64_t begin, int64_t end) const {
  return launch_color<T>(reverse_contact<kShare, T>, reverse_contact<kWide, T>, *this, begin, end, s, in, *out->contact,
                         begin, end);
}
template <class T>
cudaError_t ContactPasses<T>::collect() const {
  return launch_contact(collect_contact<T>, s.scenes * in.corners * kShare, stream, s, in, *out->contact,
                        out->collider);
}
template <class T>
cudaError_t ContactPasses<T>::store() const {
  const T *prev = out->contact->prev, *slots = out->contact->kappa;
  if (auto error = launch_contact(store_contact<T>, s.scenes * in.corners, stream, s, in, *out, prev)) return error;
  return launch_sum(s.scenes, stream, in, s.base, slots, 1, out->kappa);
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

}  // namespace diffvbd::cuda

#define DIFFVBD_INSTANTIATE_CONTACT(T)                                                                     \
  template struct diffvbd::cuda::ContactPasses<T>;                                                         \
  template cudaError_t diffvbd::cuda::sum_lag<T>(const diffvbd::contact::ContactInputs<T>&, int64_t,       \
                                                 const diffvbd::contact::ContactAdjoints<T>&, int64_t, T*, \
                                                 cudaStream_t);
