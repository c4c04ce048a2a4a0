// Kernels of contact around the updates of a color: several threads for each of its vertices, for each corner point, or
// one for each pair.
#pragma once

#include "contact_sweep.cuh"
#include "follow.cuh"

namespace diffvbd::cuda {
namespace {

constexpr int kContactThreads = kWarpsPerBlock * kSlice;
// Threads for a vertex: of a color, of a color with few vertices, and for a corner point.
constexpr int kGapFraction = 8, kWide = 32, kCornerShare = 8;

// Which vertices of the blocks [begin, end) a warp has, where it is one of `roles` for them.
template <int share>
struct Part {
  int64_t scene;
  int block, part, role;
  bool there;
  template <class T>
  __device__ __forceinline__ Part(const StepView<T>& s, int64_t begin, int64_t end, int roles = 1) {
    int64_t i = (static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x) / kSlice;
    const int64_t parts = (end - begin) * share;
    role = roles > 1 ? static_cast<int>(i % roles) : kAllPairs;
    i /= roles;
    scene = i / parts, i -= scene * parts;
    block = static_cast<int>(begin + i / share), part = static_cast<int>(i % share);
    there = scene < s.scenes;
  }
  __device__ __forceinline__ Place<share> place() const { return {scene, block, part}; }
  template <class T>
  __device__ __forceinline__ int64_t row(const StepView<T>& s, const Place<share>& at) const {
    return scene * s.positions + static_cast<int64_t>(block) * kSlice + at.v;
  }
};

// sweep: in the reverse, in which positions of the color are those of the tape; else negative.
template <int share, class T>
__global__ void assemble_contact(const __grid_constant__ StepView<T> s, const __grid_constant__ ContactView<T> c,
                                 int sweep, int64_t begin, int64_t end) {
  const Part<share> part(s, begin, end);
  wait_for_previous();
  if (!part.there) return;
  const Place<share> at = part.place();
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
  const Place<share> at = part.place();
  const int64_t row = part.row(s, at);
  const SweepRows<T> rows = sweep_rows(s, at.scene, begin, end, MovingRows<T>{s.w.x, s.w.moved});
  PairsOf<T, share, SweepRows<T>> pairs(s, c.in, at, rows);
  const Vec3<T> from = load_row(s.w.x, row), d = load_row(s.w.moved, row) - from;
  const int exponent = pairs.limit(pairs.room(), from, d);
  if (pairs.vertex < 0 || at.lane != 0) return;
  c.cut[((s.base + at.scene) * s.sweeps + sweep) * c.in.num_vertices + pairs.vertex] = static_cast<uint8_t>(exponent);
  if (exponent > 0) store_row(s.w.moved, row, from + contact::limit_of<T>(exponent) * d);
}

template <class T>
__device__ __forceinline__ void add_row(T* rows, int64_t row, const Vec3<T>& a) {
  add_to(rows + kRow * row, a);
}

template <int share, class T>
__global__ void prepare_contact(const __grid_constant__ StepView<T> s, const __grid_constant__ ContactView<T> c,
                                int64_t begin, int64_t end) {
  const Part<share> part(s, begin, end);
  wait_for_previous();
  if (!part.there) return;
  const Place<share> at = part.place();
  const SweepRows<T> rows = settled_rows(s, at.scene, begin, end);
  const PairsOf<T, share, SweepRows<T>> pairs(s, c.in, at, rows);
  if (!__any_sync(kWholeWarp, pairs.touches())) return;
  T now[3];
  take_sent(c, pairs, now);
  if (pairs.touches() && at.lane == 0) add_row(s.w.x_bar, part.row(s, at), vector_at(now));
}

template <int share, class T>
__global__ void __launch_bounds__(kContactThreads, 3)
    reverse_contact(const __grid_constant__ StepView<T> s, const __grid_constant__ ContactView<T> c, int roles,
                    int64_t begin, int64_t end) {
  const Part<share> part(s, begin, end, roles);
  wait_for_previous();
  if (!part.there) return;
  send_pairs(s, c, part.place(), part.role, begin, end);
}

// Over the threads of a share, which may come out of loops of their own.
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
  const int64_t i = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x, item = i / kCornerShare;
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
  add_to(slots.prev + 3 * (scene * in.corners + corner), prev);
}

template <class T>
__global__ void store_contact(const __grid_constant__ StepView<T> s, const __grid_constant__ ContactInputs<T> in,
                              const __grid_constant__ StepAdjoints<T> out, const T* prev) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  const int64_t local = i / in.corners, corner = i - local * in.corners, scene = s.base + local;
  if (local >= s.scenes) return;
  const Vec3<T> own = vector_at(prev + 3 * (scene * in.corners + corner));
  if (corner >= in.num_vertices) {
    T* to = out.collider_prev + 3 * (scene * (in.corners - in.num_vertices) + corner - in.num_vertices);
    to[0] = own.x, to[1] = own.y, to[2] = own.z;
    return;
  }
  add_to(out.x_prev + 3 * (scene * in.num_vertices + corner), own);
}

constexpr int kSumThreads = 1024;

// Adds up a scalar of the slots of each scene's pairs, one block a scene, in an order fixed by the number of pairs.
// each: slots of a pair; stride: scalars from one slot to the next.
template <class T>
__global__ void __launch_bounds__(kSumThreads) sum_by_scene(const __grid_constant__ ContactInputs<T> in, int64_t base,
                                                            const T* slots, int each, int stride, T* out) {
  __shared__ T part[kSumThreads];
  const int64_t scene = base + blockIdx.x;
  T sum = T(0);
  const auto first = [&](int64_t of) { return int64_t{in.listed.ptr[of * in.corners]} / 4 * each; };
  for (int64_t i = first(scene) + threadIdx.x; i < first(scene + 1); i += kSumThreads) sum += slots[i * stride];
  part[threadIdx.x] = sum;
  for (int half = kSumThreads / 2; half > 0; half /= 2) {
    __syncthreads();
    if (threadIdx.x < half) part[threadIdx.x] += part[threadIdx.x + half];
  }
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

}  // namespace

template <class T>
template <class... P, class... A>
cudaError_t ContactPasses<T>::over(void (*kernel)(P...), int64_t begin, int64_t end, int warps, bool follows,
                                   A... arguments) const {
  return launch_pass(kernel, s.scenes * (end - begin) * warps * kSlice, stream, follows, s, c, arguments..., begin,
                     end);
}
template <class T>
cudaError_t ContactPasses<T>::assemble(int sweep, int64_t begin, int64_t end, bool follows) const {
  return over(assemble_contact<kGapFraction, T>, begin, end, kGapFraction, follows, sweep);
}
template <class T>
cudaError_t ContactPasses<T>::limit(int sweep, int64_t begin, int64_t end, bool follows) const {
  return over(limit_contact<kGapFraction, T>, begin, end, kGapFraction, follows, sweep);
}
template <class T>
cudaError_t ContactPasses<T>::prepare(int64_t begin, int64_t end, bool follows) const {
  return over(prepare_contact<kGapFraction, T>, begin, end, kGapFraction, follows);
}
template <class T>
cudaError_t ContactPasses<T>::reverse(bool few, int64_t begin, int64_t end, bool follows) const {
  if (few) return over(reverse_contact<kWide, T>, begin, end, kWide * kRoles, follows, kRoles);
  return over(reverse_contact<kGapFraction, T>, begin, end, kGapFraction, follows, 1);
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

}  // namespace diffvbd::cuda

#define DIFFVBD_INSTANTIATE_CONTACT(T)                                                                     \
  template struct diffvbd::cuda::ContactPasses<T>;                                                         \
  template cudaError_t diffvbd::cuda::sum_lag<T>(const diffvbd::contact::ContactInputs<T>&, int64_t,       \
                                                 const diffvbd::contact::ContactAdjoints<T>&, int64_t, T*, \
                                                 cudaStream_t);
