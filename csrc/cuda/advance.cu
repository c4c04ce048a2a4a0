#include <algorithm>

#include "arrays.h"
#include "cluster.cuh"
#include "common.cuh"
#include "contact.h"

namespace diffvbd::cuda {
namespace {

using namespace contact;

constexpr int kThreads = 256, kWarp = 32;
constexpr int64_t kManyPairs =
    1 << 19;  // from which on more than one block per multiprocessor pays: more blocks synchronize more slowly
constexpr int kFlags = kMoves * (2 * kRounds + 1);  // one for each grid-wide vote

// Out of line, so that all callers get the same bits.
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

// Team of the whole grid, for all scenes. flags [kFlags]: zero at first.
struct GridTeam {
  unsigned* flags;
  template <class F>
  __device__ void each(const Range& items, const F& f) const {
    for (int64_t i = items.begin + own_item(kThreads); i < items.end; i += static_cast<int64_t>(gridDim.x) * kThreads) {
      f(i);
    }
  }
  __device__ void sync() const { cooperative_groups::this_grid().sync(); }
  // Grid-wide vote; all threads must call it.
  __device__ bool any(bool own) {
    if (own) *flags = 1;
    sync();
    return *static_cast<volatile unsigned*>(flags++) != 0;
  }
};
// Team of a cluster, for one scene.
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

// All listed pairs, for the grid.
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
// Pairs of a scene that may matter in a move, in any order, with their planes. Each block of the cluster has its own
// pairs. It runs the cheap test on all of them first and the expensive test on the rest, so that no warp waits for a
// few of its threads.
template <class T>
struct NearPairs {
  Cluster cluster;
  Range pairs;
  int32_t* near;        // as long as the list
  PairPlane<T>* plane;  // in the order of `near`
  int *count, *slows;   // of the block
  int32_t* slow;        // [2 kThreads]

  // Index of the i-th pair of the block, and of the i-th pair that it keeps. Warps of pairs alternate between blocks.
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
      if (kept <= kThreads && first + kThreads < *count) continue;  // another round fits
      for (int of = static_cast<int>(threadIdx.x); of < kept; of += kThreads) {
        if (!passes(in, s, slow[of], round)) f(slow[of]);
      }
      if (threadIdx.x == 0) *slows = 0;
      __syncthreads();
    }
  }
};

// All moves and rounds of some scenes. Most scenes end after the first round, which only the device knows. motions:
// memory for all vertices. infeasible [B]: zero at first.
template <class T, class Team, class Pairs>
__device__ void advance_scenes(Team team, const AdvanceInputs<T>& in, AdvanceState<T> s, Motion<T>* motions,
                               const Range& scenes, const Pairs& pairs, unsigned long long* infeasible) {
  const Range rows = {scenes.begin * in.vertices, scenes.end * in.vertices};
  s.motion = motions;
  // Motions of the vertices whose fraction the last round has lowered; of all in round 0.
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
    team.each(rows, [&](int64_t i) { begin_move(s, i); });
    team.sync();
    look(0);
    pairs.begin_move(team, in, s);
    bool clean = false;  // all pairs pass at their full fractions; only the first round looks at all of them
    for (int round = 0; round < kRounds; ++round) {
      const bool last = round + 1 == kRounds;
      bool found = false, less = false;
      const auto note = [&](int64_t scene) {
        if (last) mark(s.failed + scene);
        found = true;
      };
      if (round > 0) look(round);
      pairs.each_failing(team, in, s, last ? 0 : round, [&](int64_t i) { note(in.listed.pairs[kPairRow * i + 5]); });
      const bool passed = !team.any(found);
      clean = round == 0 && passed;
      if (passed || last) break;
      team.each(rows, [&](int64_t i) { less = retreat(s, i, round) || less; });
      if (!team.any(less)) break;
    }
    team.each(rows, [&](int64_t i) { give_up(in, s, i); });
    if (s.first && !clean) {
      team.sync();
      look(0);
      pairs.each_failing(team, in, s, 0,
                         [&](int64_t i) { atomicAdd(infeasible + in.listed.pairs[kPairRow * i + 5], 1ULL); });
      team.sync();
    }
    bool open = false;
    team.each(rows, [&](int64_t i) {
      end_move(s, i);
      open = open || s.fraction[i] < T(1);
    });
    if (!team.any(open)) break;
  }
}

// One cooperative launch.
template <class T>
__global__ void __launch_bounds__(kThreads)
    advance_kernel(const __grid_constant__ AdvanceInputs<T> in, AdvanceState<T> s, Motion<T>* motions, unsigned* flags,
                   unsigned long long* infeasible) {
  const AllPairs<T> pairs{{0, in.listed.ptr[in.scenes * in.corners] / 4}};
  advance_scenes(GridTeam{flags}, in, s, motions, {0, in.scenes}, pairs, infeasible);
}

// A cluster for each small scene. near, planes: memory for all listed pairs.
template <class T>
__global__ void __launch_bounds__(kThreads, 2)
    scene_kernel(const __grid_constant__ AdvanceInputs<T> in, AdvanceState<T> s, Motion<T>* motions, int32_t* near,
                 PairPlane<T>* planes, unsigned long long* infeasible) {
  __shared__ int32_t slow[2 * kThreads];
  __shared__ int count, slows;
  __shared__ Answers answers;
  Cluster cluster = Cluster::all();
  const int64_t scene = blockIdx.x / cluster.size;
  const auto first = [&](int64_t of) { return int64_t{in.listed.ptr[of * in.corners] / 4}; };
  const Range own = {first(scene), first(scene + 1)};
  if (cluster.leaves(in.vertices + own.end - own.begin)) return;
  const NearPairs<T> pairs{cluster, own, near, planes, &count, &slows, slow};
  advance_scenes(SceneTeam{cluster, answers}, in, s, motions, {scene, scene + 1}, pairs, infeasible);
}

template <class Phase, class T>
__global__ void __launch_bounds__(kThreads) start_kernel(Phase phase, const __grid_constant__ StartStep<T> s) {
  const int64_t row = own_item(kThreads);
  if (row < s.items()) phase(s, row);
}

// Parts of the workspace; without memory, its size.
template <class T>
struct AdvanceWork {
  AdvanceState<T> state{};
  Motion<T>* motions;
  int32_t* near = nullptr;
  PairPlane<T>* planes = nullptr;
  unsigned* flags = nullptr;
  int64_t bytes;
  AdvanceWork(const AdvanceInputs<T>& in, int64_t capacity, bool clusters, void* workspace) {
    Parts<16> take(workspace);
    const int64_t units = in.units();
    take(state.now, units), take(state.blocked, units), take(state.stamp, units), take(state.failed, in.scenes);
    take(motions, in.scenes * in.vertices);
    if (clusters) take(near, capacity), take(planes, capacity);
    if (!clusters) take(flags, kFlags);
    bytes = static_cast<int64_t>(take.bytes);
  }
};

template <class T>
cudaError_t advance(const AdvanceInputs<T>& in, int64_t capacity, T* fraction, int64_t* infeasible, void* workspace,
                    int multiprocessors, cudaStream_t stream) {
  const int64_t rows = in.scenes * in.vertices;
  const bool clusters = has_block_each(in.vertices, in.scenes, capacity);
  if (rows == 0) return cudaSuccess;
  AdvanceWork<T> work(in, capacity, clusters, workspace);
  work.state.fraction = fraction, work.state.first = true;
  auto* found = reinterpret_cast<unsigned long long*>(infeasible);
  if (clusters) {
    return launch_clusters(scene_kernel<T>, in.scenes, capacity, kThreads, stream, in, work.state, work.motions,
                           work.near, work.planes, found);
  }
  if (auto error = clear({{work.flags, kFlags * sizeof(unsigned)}}, stream)) return error;
  AdvanceInputs<T> inputs = in;
  const void* kernel = reinterpret_cast<const void*>(advance_kernel<T>);
  int resident = 0;
  if (auto error = cudaOccupancyMaxActiveBlocksPerMultiprocessor(&resident, kernel, kThreads, 0)) return error;
  const int64_t wanted = blocks_for(std::max(rows, capacity), kThreads);
  const int64_t each = capacity < kManyPairs ? 1 : resident;
  const auto blocks = static_cast<unsigned>(std::min<int64_t>(wanted, each * multiprocessors));
  void* arguments[] = {&inputs, &work.state, &work.motions, &work.flags, &found};
  return cudaLaunchCooperativeKernel(kernel, dim3(blocks), dim3(kThreads), arguments, 0, stream);
}

}  // namespace

template <class T>
int64_t advance_workspace_bytes(const AdvanceInputs<T>& in, int64_t capacity) {
  return AdvanceWork<T>(in, capacity, has_block_each(in.vertices, in.scenes, capacity), nullptr).bytes;
}

template <class T>
cudaError_t start_substep(const StartStep<T>& s, int64_t capacity, void* workspace, int multiprocessors,
                          cudaStream_t stream) {
  const auto each = [&](const auto& phase) {
    if (s.items() > 0) start_kernel<<<blocks_for(s.items(), kThreads), kThreads, 0, stream>>>(phase, s);
  };
  each(ClearUnit{}), each(LimitStart{}), each(WantStart{});
  if (auto error = advance(s.in.gate, capacity, s.m.passed, s.out.infeasible, workspace, multiprocessors, stream)) {
    return error;
  }
  each(EndStart{});
  return cudaGetLastError();
}

DIFFVBD_INSTANTIATE(advance_workspace_bytes)
DIFFVBD_INSTANTIATE(start_substep)

}  // namespace diffvbd::cuda
