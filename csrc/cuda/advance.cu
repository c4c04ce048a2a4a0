#include <algorithm>

#include "advance.h"
#include "clear.h"
#include "cluster.cuh"
#include "small_scenes.h"

namespace diffvbd::cuda {
namespace {

using namespace contact;

constexpr int kThreads = 256, kWarp = 32;
constexpr int64_t kManyPairs = 1 << 19;  // worth more than one block a multiprocessor: more blocks wait longer
constexpr int kFlags = kMoves * (2 * kRounds + 1);  // one for each question that the whole grid is asked

// Out of line: whoever asks gets the same bits.
template <class T>
__device__ __noinline__ bool passes(const AdvanceInputs<T>& in, const AdvanceState<T>& s, int64_t pair, int round) {
  return test_pair(in, s, pair, round);
}
template <class T>
__device__ __noinline__ bool passes_quickly(const AdvanceInputs<T>& in, const AdvanceState<T>& s, PairPlane<T>& plane,
                                            int64_t pair, int round) {
  return passes_by(in, s, plane, pair, round, [&] { return PairPlane<T>(in, s, pair); });
}

struct Range {
  int64_t begin, end;
};

// The whole grid, on all scenes. flags [kFlags]: zero at first.
struct GridTeam {
  unsigned* flags;
  template <class F>
  __device__ void each(const Range& items, const F& f) const {
    for (int64_t i = items.begin + static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x; i < items.end;
         i += static_cast<int64_t>(gridDim.x) * kThreads) {
      f(i);
    }
  }
  __device__ void sync() const { cooperative_groups::this_grid().sync(); }
  // Whether any thread says yes, once all have come here.
  __device__ bool any(bool own) {
    if (own) *flags = 1;
    sync();
    return *static_cast<volatile unsigned*>(flags++) != 0;
  }
};
// A cluster, on a scene of its own.
struct SceneTeam {
  Cluster cluster;
  Answers& answers;
  int turn = 0;
  template <class F>
  __device__ void each(const Range& items, const F& f) const {
    for (int64_t i = items.begin + cluster.rank * kThreads + static_cast<int64_t>(threadIdx.x); i < items.end;
         i += cluster.size * kThreads) {
      f(i);
    }
  }
  __device__ void sync() const { cluster.meet(); }
  __device__ bool any(bool own) { return any_of_cluster(cluster, answers, turn, own); }
};

// All listed pairs, as the grid looks at them.
template <class T>
struct AllPairs {
  Range pairs;
  __device__ void begin_move(const GridTeam&, const AdvanceInputs<T>&, const AdvanceState<T>&) const {}
  // Calls f(pair) for those that do not pass.
  template <class F>
  __device__ void each_failing(const GridTeam& team, const AdvanceInputs<T>& in, const AdvanceState<T>& s, int round,
                               const F& f) const {
    team.each(pairs, [&](int64_t i) {
      if (!passes(in, s, i, round)) f(i);
    });
  }
};
// Those of a scene that may matter in a move, in any order, and their planes, as the blocks of its cluster look at
// them, each at its own: first at what is quick of all, and then at what is slow of those that are left, so that no
// warp waits for a few of its threads.
template <class T>
struct NearPairs {
  Cluster cluster;
  Range pairs;
  int32_t* near;        // as long as the list
  PairPlane<T>* plane;  // in the order of `near`
  int *count, *slows;   // of the block
  int32_t* slow;        // [2 kThreads]

  // Where the block has its i-th pair, and keeps the i-th of those that may matter. These lie side by side: each block
  // has some of every part of the list.
  __device__ int64_t place(int i) const {
    return pairs.begin + int64_t{i / kWarp * cluster.size + cluster.rank} * kWarp + i % kWarp;
  }
  __device__ void begin_move(const SceneTeam&, const AdvanceInputs<T>& in, const AdvanceState<T>& s) const {
    if (threadIdx.x == 0) *count = *slows = 0;
    __syncthreads();
    for (int k = static_cast<int>(threadIdx.x); place(k) < pairs.end; k += kThreads) {
      const int64_t i = place(k);
      const bool open = s.first || is_open(in, s, in.listed.pairs + kPairRow * i);
      if (open && !stays_far_at_any_fraction(in, s, i)) near[place(atomicAdd(count, 1))] = static_cast<int32_t>(i);
    }
    __syncthreads();
    for (int k = static_cast<int>(threadIdx.x); k < *count; k += kThreads) plane[place(k)].forget();
  }
  template <class F>
  __device__ void each_failing(const SceneTeam&, const AdvanceInputs<T>& in, const AdvanceState<T>& s, int round,
                               const F& f) const {
    for (int first = 0; first < *count; first += kThreads) {
      const int k = first + static_cast<int>(threadIdx.x);
      const int64_t i = place(k);
      if (k < *count && !passes_quickly(in, s, plane[i], near[i], round)) slow[atomicAdd(slows, 1)] = near[i];
      __syncthreads();
      const int kept = *slows;
      __syncthreads();
      if (kept <= kThreads && first + kThreads < *count) continue;  // there is room for those of one more turn
      for (int of = static_cast<int>(threadIdx.x); of < kept; of += kThreads) {
        if (!passes(in, s, slow[of], round)) f(slow[of]);
      }
      if (threadIdx.x == 0) *slows = 0;
      __syncthreads();
    }
  }
};

// All moves and rounds of some scenes: most are over after the first round, and only the device knows.
// motions: memory for all vertices.
template <class T, class Team, class Pairs>
__device__ void advance_scenes(Team team, const AdvanceInputs<T>& in, AdvanceState<T> s, Motion<T>* motions,
                               const Range& scenes, const Pairs& pairs, unsigned long long* stuck) {
  const int64_t of_scene = in.units() / in.scenes;
  const Range rows = {scenes.begin * in.vertices, scenes.end * in.vertices};
  const Range units = {scenes.begin * of_scene, scenes.end * of_scene};
  s.motion = motions;
  // works out the motions of what tries less in a round; in round 0 of all. Vertices by themselves do when they retreat
  const auto look = [&](int round) {
    team.each(rows, [&](int64_t i) {
      const int64_t scene = i / in.vertices;
      const auto v = static_cast<int32_t>(i - scene * in.vertices);
      if (round == 0 || s.stamp[in.unit(scene, v)] == round) motions[i] = motion_of(in, s, scene, v);
    });
    team.sync();
  };
  for (int move = 0; move < kMoves; ++move) {
    s.first = move == 0;
    team.each(scenes, [&](int64_t i) { s.failed[i] = 0; });
    team.each(units, [&](int64_t i) { begin_move(in, s, i); });
    team.sync();
    look(0);
    pairs.begin_move(team, in, s);
    bool clean = false;  // everything passes as it wants to: only the first round looks at all pairs
    for (int round = 0; round < kRounds; ++round) {
      const bool last = round + 1 == kRounds;
      bool found = false, less = false;
      const auto note = [&](int64_t scene) {
        if (last) mark(s.failed + scene);
        found = true;
      };
      if (round > 0 && in.whole) look(round);
      pairs.each_failing(team, in, s, last ? 0 : round, [&](int64_t i) { note(in.listed.pairs[kPairRow * i + 5]); });
      team.each(in.whole ? rows : Range{}, [&](int64_t i) {
        const int64_t scene = i / in.vertices;
        if (!stay(in, s, scene, static_cast<int32_t>(i - scene * in.vertices), last ? 0 : round)) note(scene);
      });
      const bool passed = !team.any(found);
      clean = round == 0 && passed;
      if (passed || last) break;
      team.each(units, [&](int64_t i) {
        if (!retreat(s, i, round)) return;
        less = true;
        if (!in.whole) motions[i] = motion_of(in, s, i / in.vertices, static_cast<int32_t>(i % in.vertices));
      });
      if (!team.any(less)) break;
    }
    team.each(units, [&](int64_t i) { give_up(in, s, i); });
    if (s.first && !clean) {
      team.sync();
      look(0);
      pairs.each_failing(team, in, s, 0, [&](int64_t) { atomicAdd(stuck, 1ULL); });
      team.sync();
    }
    bool open = false;
    team.each(units, [&](int64_t i) {
      end_move(s, i);
      open = open || s.fraction[i] < T(1);
    });
    if (!team.any(open)) break;
  }
}

// One cooperative launch. stuck [1]: zero at first.
template <class T>
__global__ void __launch_bounds__(kThreads)
    advance_kernel(const __grid_constant__ AdvanceInputs<T> in, AdvanceState<T> s, Motion<T>* motions, unsigned* flags,
                   unsigned long long* stuck) {
  const AllPairs<T> pairs{{0, in.listed.ptr[in.scenes * in.corners] / 4}};
  advance_scenes(GridTeam{flags}, in, s, motions, {0, in.scenes}, pairs, stuck);
}

// A cluster for each small scene. near, planes: memory for all listed pairs. stuck: with several scenes zero at first.
template <class T>
__global__ void __launch_bounds__(kThreads, 2)
    scene_kernel(const __grid_constant__ AdvanceInputs<T> in, AdvanceState<T> s, Motion<T>* motions, int32_t* near,
                 PairPlane<T>* planes, unsigned long long* stuck) {
  __shared__ int32_t slow[2 * kThreads];
  __shared__ int count, slows;
  __shared__ Answers answers;
  Cluster cluster = Cluster::all();
  const int64_t scene = blockIdx.x / cluster.size;
  if (in.scenes == 1 && blockIdx.x == 0 && threadIdx.x == 0) *stuck = 0;  // before the first meeting
  const auto first = [&](int64_t of) { return int64_t{in.listed.ptr[of * in.corners] / 4}; };
  const Range own = {first(scene), first(scene + 1)};
  if (cluster.leaves(in.vertices + own.end - own.begin)) return;
  const NearPairs<T> pairs{cluster, own, near, planes, &count, &slows, slow};
  advance_scenes(SceneTeam{cluster, answers}, in, s, motions, {scene, scene + 1}, pairs, stuck);
}

template <class T>
__global__ void __launch_bounds__(kThreads)
    narrow_kernel(const __grid_constant__ GapInputs<T> in, int64_t pairs, T* constants) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (i < pairs) refresh_gap(in, i, constants + kConstants * i);
}

// Bytes of each part of the workspace, rounded up to what any type needs.
constexpr int64_t aligned(int64_t bytes) { return (bytes + 15) / 16 * 16; }

}  // namespace

template <class T>
int64_t advance_workspace_bytes(const AdvanceInputs<T>& in, int64_t capacity) {
  const int64_t units = in.units();
  const int64_t bytes = aligned(units * sizeof(T)) + 2 * aligned(units) + aligned(in.scenes) +
                        aligned(in.scenes * in.vertices * sizeof(Motion<T>));
  if (!has_block_each(in.vertices, in.scenes, capacity)) return bytes + aligned(kFlags * sizeof(unsigned));
  return bytes + aligned(capacity * sizeof(int32_t)) + aligned(capacity * sizeof(PairPlane<T>));
}

template <class T>
cudaError_t advance(const AdvanceInputs<T>& in, int64_t capacity, T* share, int64_t* stuck, void* workspace,
                    int multiprocessors, cudaStream_t stream) {
  const int64_t rows = in.scenes * in.vertices;
  const bool clusters = has_block_each(in.vertices, in.scenes, capacity);
  std::vector<Span> zeros{{stuck, sizeof(*stuck)}};
  if (rows == 0) return clear(zeros, stream);
  auto* at = static_cast<uint8_t*>(workspace);
  const auto take = [&](int64_t bytes) {
    uint8_t* here = at;
    at += aligned(bytes);
    return here;
  };
  const int64_t units = in.units();
  auto* now = reinterpret_cast<T*>(take(units * sizeof(T)));
  uint8_t *blocked = take(units), *stamp = take(units), *failed = take(in.scenes);
  auto* motions = reinterpret_cast<Motion<T>*>(take(rows * sizeof(Motion<T>)));
  AdvanceState<T> state{share, now, blocked, stamp, failed, true};
  auto* found = reinterpret_cast<unsigned long long*>(stuck);
  if (clusters) {
    if (in.scenes > 1) {  // a single one clears it by itself
      if (auto error = clear(zeros, stream)) return error;
    }
    auto* near = reinterpret_cast<int32_t*>(take(capacity * sizeof(int32_t)));
    auto* planes = reinterpret_cast<PairPlane<T>*>(take(capacity * sizeof(PairPlane<T>)));
    return launch_clusters(scene_kernel<T>, in.scenes, capacity, kThreads, stream, in, state, motions, near, planes,
                           found);
  }
  auto* flags = reinterpret_cast<unsigned*>(take(kFlags * sizeof(unsigned)));
  zeros.push_back({flags, kFlags * sizeof(unsigned)});
  if (auto error = clear(zeros, stream)) return error;
  AdvanceInputs<T> inputs = in;
  const void* kernel = reinterpret_cast<const void*>(advance_kernel<T>);
  int resident = 0;
  if (auto error = cudaOccupancyMaxActiveBlocksPerMultiprocessor(&resident, kernel, kThreads, 0)) return error;
  const int64_t wanted = (std::max(rows, capacity) + kThreads - 1) / kThreads;
  const int64_t each = capacity < kManyPairs ? 1 : resident;
  const auto blocks = static_cast<unsigned>(std::min<int64_t>(wanted, each * multiprocessors));
  void* arguments[] = {&inputs, &state, &motions, &flags, &found};
  return cudaLaunchCooperativeKernel(kernel, dim3(blocks), dim3(kThreads), arguments, 0, stream);
}

template <class T>
cudaError_t refresh_gaps(const GapInputs<T>& in, int64_t pairs, T* constants, cudaStream_t stream) {
  if (pairs == 0) return cudaSuccess;
  const auto blocks = static_cast<unsigned>((pairs + kThreads - 1) / kThreads);
  narrow_kernel<T><<<blocks, kThreads, 0, stream>>>(in, pairs, constants);
  return cudaGetLastError();
}

#define DIFFVBD_INSTANTIATE(T)                                                       \
  template cudaError_t refresh_gaps<T>(const GapInputs<T>&, int64_t, T*, cudaStream_t); \
  template int64_t advance_workspace_bytes<T>(const AdvanceInputs<T>&, int64_t);     \
  template cudaError_t advance<T>(const AdvanceInputs<T>&, int64_t, T*, int64_t*, void*, int, cudaStream_t);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd::cuda
