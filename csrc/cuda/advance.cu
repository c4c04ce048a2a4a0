#include <cooperative_groups.h>

#include <algorithm>

#include "advance.h"

namespace diffvbd::cuda {
namespace {

using namespace contact;

constexpr int kThreads = 256;
constexpr int64_t kManyPairs = 1 << 19;  // worth more than one block a multiprocessor: more blocks wait longer
constexpr int kFlags = kMoves * (2 * kRounds + 1);  // one for each question that the whole grid is asked

// Out of line: whoever asks gets the same bits.
template <class T>
__device__ __noinline__ bool passes(const AdvanceInputs<T>& in, const AdvanceState<T>& s, int64_t pair, int round) {
  return try_pair(in, s, pair, round);
}

template <class T>
__device__ __noinline__ Plane<T> plane_of(const AdvanceInputs<T>& in, const AdvanceState<T>& s, int64_t pair) {
  return Plane<T>(in, s, pair);
}

// The pairs that rounds of a move look at: those that may matter, in any order, and their planes.
template <class T>
struct Looked {
  int32_t* pair;
  Plane<T>* plane;
  unsigned* counts;  // [kMoves]
};

// One cooperative launch for all moves and rounds: most are over after the first round, and only the device knows. What
// is quick is asked of all pairs first, and then a block asks what is slow of those that are left, so that no warp
// waits for a few of its threads. flags [kFlags], the counts of `all` and stuck [1] are zero.
template <class T>
__global__ void __launch_bounds__(kThreads, 2)
    advance_kernel(const __grid_constant__ AdvanceInputs<T> in, AdvanceState<T> s, unsigned* flags, Looked<T> all,
                   unsigned long long* stuck) {
  __shared__ int32_t slow[2 * kThreads];
  __shared__ int slows;
  const auto grid = cooperative_groups::this_grid();
  const auto each = [](int64_t n, const auto& f) {
    for (int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x; i < n;
         i += static_cast<int64_t>(gridDim.x) * kThreads) {
      f(i);
    }
  };
  // Whether any thread says yes, once all have come here.
  const auto any = [&](bool own) {
    if (own) *flags = 1;
    grid.sync();
    return *static_cast<volatile unsigned*>(flags++) != 0;
  };
  const int64_t rows = in.scenes * in.vertices, units = in.units();
  const int64_t pairs = in.listed.ptr[in.scenes * in.corners] / 4;
  for (int move = 0; move < kMoves; ++move) {
    s.first = move == 0;
    each(in.scenes, [&](int64_t i) { s.failed[i] = 0; });
    each(units, [&](int64_t i) { begin_move(s, i); });
    grid.sync();
    each(pairs, [&](int64_t i) {
      const int32_t* record = in.listed.pairs + kPairRow * i;
      if ((s.first || is_open(in, s, record)) && !stays_far_at_any_share(in, s, i))
        all.pair[atomicAdd(all.counts + move, 1)] = static_cast<int32_t>(i);
    });
    grid.sync();
    const int64_t looked = *static_cast<volatile unsigned*>(all.counts + move);
    each(looked, [&](int64_t i) { all.plane[i] = plane_of(in, s, all.pair[i]); });
    // Calls f(pair) for those that do not pass: a thread's own planes, and then what a block has kept.
    const auto each_failing = [&](int round, const auto& f) {
      const auto flush = [&] {
        for (int k = static_cast<int>(threadIdx.x); k < slows; k += kThreads) {
          if (!passes(in, s, slow[k], round)) f(slow[k]);
        }
        __syncthreads();
        if (threadIdx.x == 0) slows = 0;
        __syncthreads();
      };
      if (threadIdx.x == 0) slows = 0;
      __syncthreads();
      for (int64_t first = static_cast<int64_t>(blockIdx.x) * kThreads; first < looked;
           first += static_cast<int64_t>(gridDim.x) * kThreads) {
        const int64_t i = first + threadIdx.x;
        if (i < looked && !passes_by(in, s, all.plane[i], all.pair[i], round)) slow[atomicAdd(&slows, 1)] = all.pair[i];
        __syncthreads();
        const bool full = slows > kThreads;  // else there is room for those of one more turn
        __syncthreads();
        if (full) flush();
      }
      flush();
    };
    bool clean = false;  // everything passes as it wants to: only the first round looks at all pairs
    for (int round = 0; round < kRounds; ++round) {
      const bool last = round + 1 == kRounds;
      bool found = false, less = false;
      const auto note = [&](int64_t scene, bool passed) {
        if (!passed && last) mark(s.failed + scene);
        found = found || !passed;
      };
      each_failing(last ? 0 : round, [&](int64_t pair) { note(in.listed.pairs[kPairRow * pair + 5], false); });
      each(rows, [&](int64_t i) { note(i / in.vertices, stay(in, s, i, last ? 0 : round)); });
      const bool passed = !any(found);
      clean = round == 0 && passed;
      if (passed || last) break;
      each(units, [&](int64_t i) { less = retreat(s, i, round) || less; });
      if (!any(less)) break;
    }
    each(units, [&](int64_t i) { give_up(in, s, i); });
    if (s.first && !clean) {
      grid.sync();
      each_failing(0, [&](int64_t) { atomicAdd(stuck, 1ULL); });
      grid.sync();
    }
    bool open = false;
    each(units, [&](int64_t i) {
      end_move(s, i);
      open = open || s.share[i] < T(1);
    });
    if (!any(open)) break;
  }
}

template <class T>
__global__ void __launch_bounds__(kThreads)
    narrow_kernel(const __grid_constant__ NarrowInputs<T> in, int64_t pairs, T* constants) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (i < pairs) narrow_pair(in, i, constants + kConstants * i);
}

// Bytes of each part of the workspace, rounded up to what any type needs.
constexpr int64_t aligned(int64_t bytes) { return (bytes + 15) / 16 * 16; }

}  // namespace

template <class T>
int64_t advance_workspace_bytes(const AdvanceInputs<T>& in, int64_t capacity) {
  const int64_t units = in.units();
  return aligned((kFlags + kMoves) * sizeof(unsigned)) + aligned(units * sizeof(T)) + 2 * aligned(units) +
         aligned(in.scenes) + aligned(capacity * sizeof(int32_t)) + aligned(capacity * sizeof(Plane<T>));
}

template <class T>
cudaError_t advance(const AdvanceInputs<T>& in, int64_t capacity, T* share, int64_t* stuck, void* workspace,
                    int multiprocessors, cudaStream_t stream) {
  if (auto error = cudaMemsetAsync(stuck, 0, sizeof(*stuck), stream)) return error;
  const int64_t rows = in.scenes * in.vertices;
  if (rows == 0) return cudaSuccess;
  auto* at = static_cast<uint8_t*>(workspace);
  const auto take = [&](int64_t bytes) {
    uint8_t* here = at;
    at += aligned(bytes);
    return here;
  };
  auto* flags = reinterpret_cast<unsigned*>(take((kFlags + kMoves) * sizeof(unsigned)));
  const int64_t units = in.units();
  auto* now = reinterpret_cast<T*>(take(units * sizeof(T)));
  uint8_t *blocked = take(units), *stamp = take(units), *failed = take(in.scenes);
  Looked<T> all{reinterpret_cast<int32_t*>(take(capacity * sizeof(int32_t))),
                reinterpret_cast<Plane<T>*>(take(capacity * sizeof(Plane<T>))), flags + kFlags};
  if (auto error = cudaMemsetAsync(flags, 0, (kFlags + kMoves) * sizeof(unsigned), stream)) return error;
  AdvanceInputs<T> inputs = in;
  AdvanceState<T> state{share, now, blocked, stamp, failed, true};
  auto* found = reinterpret_cast<unsigned long long*>(stuck);
  const void* kernel = reinterpret_cast<const void*>(advance_kernel<T>);
  int resident = 0;
  if (auto error = cudaOccupancyMaxActiveBlocksPerMultiprocessor(&resident, kernel, kThreads, 0)) return error;
  const int64_t wanted = (std::max(rows, capacity) + kThreads - 1) / kThreads;
  const int64_t each = capacity < kManyPairs ? 1 : resident;
  const auto blocks = static_cast<unsigned>(std::min<int64_t>(wanted, each * multiprocessors));
  void* arguments[] = {&inputs, &state, &flags, &all, &found};
  return cudaLaunchCooperativeKernel(kernel, dim3(blocks), dim3(kThreads), arguments, 0, stream);
}

template <class T>
cudaError_t narrow(const NarrowInputs<T>& in, int64_t pairs, T* constants, cudaStream_t stream) {
  if (pairs == 0) return cudaSuccess;
  const auto blocks = static_cast<unsigned>((pairs + kThreads - 1) / kThreads);
  narrow_kernel<T><<<blocks, kThreads, 0, stream>>>(in, pairs, constants);
  return cudaGetLastError();
}

#define DIFFVBD_INSTANTIATE(T)                                                       \
  template cudaError_t narrow<T>(const NarrowInputs<T>&, int64_t, T*, cudaStream_t); \
  template int64_t advance_workspace_bytes<T>(const AdvanceInputs<T>&, int64_t);     \
  template cudaError_t advance<T>(const AdvanceInputs<T>&, int64_t, T*, int64_t*, void*, int, cudaStream_t);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd::cuda
