// What bodies take of the motions of a rigid correction: kernel by kernel for scenes of any size, or all of it in one
// launch for small ones.
#include <algorithm>

#include "cluster.cuh"
#include "contact_rigid_tries.cuh"
#include "small_scenes.h"

namespace diffvbd::cuda {
namespace {

constexpr int64_t kLargeBody = 32;  // vertices from which a block adds up a body, and not a warp

template <class T>
__global__ void __launch_bounds__(kOne)
    begin_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ Tried<T> t) {
  const int64_t i = own_item();
  if (i < in.scene.scenes) t.done[i] = 0, t.touches[i] = t.nears[i] = 0;
  if (i < in.scene.scenes * in.bodies()) begin_body(in, t, i);
}

template <class T>
__global__ void __launch_bounds__(kOne)
    way_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ Tried<T> t) {
  const int64_t row = own_item();
  if (row < in.scene.scenes * in.scene.vertices) find_way(in, t, row);
}

template <class T>
__global__ void __launch_bounds__(kOne)
    join_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ Tried<T> t, int64_t listed) {
  const int64_t item = own_item();
  const bool repels = item < listed;
  const int64_t pair = repels ? item : item - listed;
  if (pair < (repels ? in.first_listed(in.scene.scenes) : in.first_lagged(in.scene.scenes))) {
    join_pair(in, t, pair, repels);
  }
}

template <class T>
__global__ void __launch_bounds__(kOne)
    displace_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ Tried<T> t, T* x) {
  const int64_t row = own_item();
  if (row < in.scene.scenes * in.scene.vertices) displace(in, t, row, x);
}

template <class T>
__global__ void __launch_bounds__(kOne) try_kernel(const __grid_constant__ RigidInputs<T> in,
                                                   const __grid_constant__ Tried<T> t, int64_t listed, bool moved) {
  const int64_t item = own_item(), rows = in.scene.scenes * in.scene.vertices, pair = item - rows;
  if (item < rows) {
    try_vertex(in, t, item, moved);
  } else if (pair < listed) {
    if (pair >= in.first_listed(in.scene.scenes)) return;
    const int64_t scene = in.gate.listed.pairs[kPairRow * pair + 5];
    if (pair - in.first_listed(scene) >= t.nears[scene]) return;
    try_pair_of(in, t, t.near[pair], true, t.press[t.near[pair]], moved);
  } else if (pair - listed < in.first_lagged(in.scene.scenes)) {
    try_pair_of(in, t, pair - listed, false, t.press[pair], moved);
  }
}

// Of all bodies: a block or a warp for each.
template <class T, bool large>
__global__ void __launch_bounds__(kThreads)
    potential_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ Tried<T> t, int64_t listed,
                     double* out) {
  __shared__ double part[kWarps][kMostSums];
  const int64_t unit = large ? blockIdx.x : int64_t{kWarps} * blockIdx.x + threadIdx.x / 32;
  if (unit >= in.scene.scenes * in.bodies()) return;
  const auto body = static_cast<int32_t>(unit % in.bodies());
  if (!in.free[body] || t.decided[unit]) return;
  double value = 0;
  if constexpr (large) {
    value = potential_of(in, t, BlockTeam{part}, unit / in.bodies(), body, listed);
  } else {
    value = potential_of(in, t, Tile<32>(), unit / in.bodies(), body, listed);
  }
  if (threadIdx.x % (large ? kThreads : 32) == 0) out[unit] = value;
}

// A block for each scene.
template <class T>
__global__ void __launch_bounds__(kOne)
    decide_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ Tried<T> t, int attempt) {
  __shared__ Ballot ballot;
  if (t.done[blockIdx.x]) return;
  const bool done = decide(in, t, blockIdx.x, attempt, ballot);
  __syncthreads();  // everyone has asked whether it is done
  if (done && threadIdx.x == 0) t.done[blockIdx.x] = 1;
}

template <class T>
__global__ void __launch_bounds__(kOne) end_kernel(const __grid_constant__ RigidInputs<T> in, const double* motion,
                                                   const __grid_constant__ RigidOutcome<T> out) {
  end_scene(in, motion, out, blockIdx.x);
}

// A block of those that share a scene.
struct BlockOfScene {
  BlockTeam block;
  Cluster cluster;
  __device__ int32_t first() const { return static_cast<int32_t>(kThreads * cluster.rank + threadIdx.x); }
  template <class F>
  __device__ void each(int32_t count, const F& f) const {
    for (int32_t i = first(); i < count; i += kThreads * cluster.size) f(i);
  }
};

// All tries of a small scene: a cluster.
template <class T>
__global__ void __launch_bounds__(kThreads)
    scene_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ Tried<T> t, int64_t listed,
                 const __grid_constant__ RigidOutcome<T> out, T* x) {
  // potentials: parts of those of few bodies, whose last bits depend on the number of blocks; decisions allow for that
  __shared__ double part[kWarps][kMostSums], potentials[kMostBlocks][kWarps];
  __shared__ Answers answers;
  __shared__ Ballot ballot;
  Cluster cluster = Cluster::all();
  const int64_t scene = blockIdx.x / cluster.size, first = scene * in.scene.vertices, unit = scene * in.bodies();
  const auto vertices = static_cast<int32_t>(in.scene.vertices);
  bool moves = false;
  const double* motions = t.motion + kUnknowns * unit;
  BlockTeam{part}.each(kUnknowns * in.bodies(), [&](int32_t i) { moves = moves || motions[i] != 0; });
  if (!__syncthreads_or(moves)) {  // a captured step makes all of its corrections, most of which move nothing
    const int32_t scalars = 3 * vertices;
    BlockOfScene{{part}, cluster}.each(scalars, [&](int32_t i) { x[3 * first + i] = in.scene.x[3 * first + i]; });
    if (cluster.rank > 0) return;
    BlockTeam{part}.each(in.bodies(), [&](int32_t k) { t.share[unit + k] = 1; });
    __syncthreads();
    return end_scene(in, t.motion, out, scene);
  }
  const int64_t repelling = in.first_listed(scene), rubbing = in.first_lagged(scene);
  const auto repels = static_cast<int32_t>(in.first_listed(scene + 1) - repelling);
  const auto rubs = static_cast<int32_t>(in.first_lagged(scene + 1) - rubbing);
  if (cluster.leaves(in.scene.vertices + repels + rubs)) return;
  const BlockOfScene team{{part}, cluster};
  const auto warp = static_cast<int32_t>(threadIdx.x / 32);
  const bool few = in.bodies() <= kWarps, leads = cluster.rank == 0;
  int turn = 0;
  team.each(in.bodies(), [&](int32_t k) { begin_body(in, t, unit + k); });
  if (leads && threadIdx.x == 0) t.touches[scene] = t.nears[scene] = 0;
  cluster.meet();
  team.each(vertices, [&](int32_t v) { find_way(in, t, first + v); });
  cluster.meet();
  team.each(repels + rubs,
            [&](int32_t i) { join_pair(in, t, i < repels ? repelling + i : rubbing + i - repels, i < repels); });
  cluster.meet();
  const int32_t near = t.nears[scene];
  for (int attempt = -1; attempt < kTrials; ++attempt) {  // -1: where they are
    const bool moved = 0 <= attempt;
    double* const to = (moved ? t.after : t.before) + unit;
    if (moved) {
      team.each(vertices, [&](int32_t v) { displace(in, t, first + v, static_cast<T*>(nullptr)); });
      cluster.meet();
    }
    team.each(vertices, [&](int32_t v) { try_vertex(in, t, first + v, moved); });
    team.each(near + rubs, [&](int32_t i) {
      const int64_t pair = i < near ? t.near[repelling + i] : rubbing + i - near;
      try_pair_of(in, t, pair, i < near, t.press[i < near ? pair : listed + pair], moved);
    });
    cluster.meet();
    if (few) {
      double sums[kWarps];
      own_potentials(in, t, scene, team.first(), kThreads * cluster.size, listed, sums);
      team.block.template reduce<kWarps>(sums);
      double* const all = cluster.size == 1 ? to : Cluster::of(potentials[cluster.rank], 0);
#pragma unroll
      for (int k = 0; k < kWarps; ++k) {
        if (threadIdx.x == k && k < in.bodies()) all[k] = sums[k];
      }
    } else {
      for (int32_t k = kWarps * cluster.rank + warp; k < in.bodies(); k += kWarps * cluster.size) {
        if (!in.free[k] || t.decided[unit + k]) continue;
        const double value = potential_of(in, t, Tile<32>(), scene, k, listed);
        if (threadIdx.x % 32 == 0) to[k] = value;
      }
    }
    cluster.meet();
    if (few && cluster.size > 1 && leads) {
      team.block.each(in.bodies(), [&](int32_t k) {
        to[k] = 0;
        for (int b = 0; b < cluster.size; ++b) to[k] += potentials[b][k];
      });
      __syncthreads();
    }
    if (moved && any_of_cluster(cluster, answers, turn, leads && decide(in, t, scene, attempt, ballot))) break;
  }
  team.each(vertices, [&](int32_t v) { displace(in, t, first + v, x); });
  if (leads) end_scene(in, t.motion, out, scene);  // which changes no share of what moves
}

}  // namespace

template <class T>
int64_t rigid_move_bytes(const RigidInputs<T>& in, const PairRoom& room) {
  const int64_t scenes = in.scene.scenes, units = scenes * in.bodies();
  return 9 * aligned(units * sizeof(double)) + aligned(scenes * in.scene.vertices * sizeof(double)) +
         aligned(room.rows() * sizeof(double)) + 2 * aligned(units * sizeof(int32_t)) +
         aligned(room.listed * 2 * sizeof(int32_t)) + aligned(room.listed * sizeof(int32_t)) +
         2 * aligned(scenes * sizeof(int32_t)) + 2 * aligned(units * sizeof(T)) + 4 * aligned(units) + aligned(scenes) +
         aligned(scenes * in.scene.vertices * sizeof(Motion<T>));
}

template <class T>
cudaError_t rigid_move(const RigidInputs<T>& in, const PairRoom& room, const double* center, const double* motion,
                       T* move, const RigidOutcome<T>& out, T* x, void* workspace, cudaStream_t stream) {
  const int64_t scenes = in.scene.scenes, units = scenes * in.bodies(), rows = scenes * in.scene.vertices;
  if (rows == 0 || units == 0) return cudaSuccess;
  auto* next = static_cast<uint8_t*>(workspace);
  const auto take = [&](int64_t bytes) {
    uint8_t* here = next;
    next += aligned(bytes);
    return here;
  };
  const auto numbers = [&](int64_t count) { return reinterpret_cast<double*>(take(count * sizeof(double))); };
  const auto counts = [&](int64_t count) { return reinterpret_cast<Count*>(take(count * sizeof(Count))); };
  const auto whole = [&](int64_t count) { return reinterpret_cast<int32_t*>(take(count * sizeof(int32_t))); };
  Tried<T> t{};
  t.center = center, t.motion = motion, t.share = out.fraction, t.move = move;
  t.low = numbers(units), t.next = numbers(units), t.way = numbers(units), t.size = numbers(units);
  t.before = numbers(units), t.after = numbers(units);
  t.largest = counts(units), t.rise = counts(units), t.whole = counts(units);
  t.value = numbers(rows), t.press = numbers(room.rows());
  t.lead = whole(units), t.together = whole(units), t.touching = whole(2 * room.listed), t.touches = whole(scenes);
  t.near = whole(room.listed), t.nears = whole(scenes);
  t.state.fraction = reinterpret_cast<T*>(take(units * sizeof(T)));
  t.state.now = reinterpret_cast<T*>(take(units * sizeof(T)));
  t.state.blocked = take(units), t.state.stamp = take(units);
  t.decided = take(units), t.stopped = take(units), t.done = take(scenes);
  t.motions = reinterpret_cast<Motion<T>*>(take(rows * sizeof(Motion<T>)));
  t.state.motion = t.motions;
  if (has_block_each(in.scene.vertices, scenes, room.rows())) {
    return launch_clusters(scene_kernel<T>, scenes, room.rows(), kThreads, stream, in, t, room.listed, out, x);
  }
  begin_kernel<T><<<blocks_for(std::max(units, scenes)), kOne, 0, stream>>>(in, t);
  if (room.rows() > 0) {
    way_kernel<T><<<blocks_for(rows), kOne, 0, stream>>>(in, t);
    join_kernel<T><<<blocks_for(room.rows()), kOne, 0, stream>>>(in, t, room.listed);
  }
  const auto look = [&](bool moved, double* to) {
    try_kernel<T><<<blocks_for(rows + room.rows()), kOne, 0, stream>>>(in, t, room.listed, moved);
    if (in.scene.vertices >= kLargeBody * in.bodies()) {
      potential_kernel<T, true><<<static_cast<unsigned>(units), kThreads, 0, stream>>>(in, t, room.listed, to);
    } else {
      const auto blocks = static_cast<unsigned>((units + kWarps - 1) / kWarps);
      potential_kernel<T, false><<<blocks, kThreads, 0, stream>>>(in, t, room.listed, to);
    }
  };
  look(false, t.before);
  for (int attempt = 0; attempt < kTrials; ++attempt) {
    displace_kernel<T><<<blocks_for(rows), kOne, 0, stream>>>(in, t, nullptr);
    look(true, t.after);
    decide_kernel<T><<<static_cast<unsigned>(scenes), kOne, 0, stream>>>(in, t, attempt);
  }
  displace_kernel<T><<<blocks_for(rows), kOne, 0, stream>>>(in, t, x);
  end_kernel<T><<<static_cast<unsigned>(scenes), kOne, 0, stream>>>(in, motion, out);
  return cudaGetLastError();
}

#define DIFFVBD_INSTANTIATE(T)                                                                                 \
  template int64_t rigid_move_bytes<T>(const RigidInputs<T>&, const PairRoom&);                                \
  template cudaError_t rigid_move<T>(const RigidInputs<T>&, const PairRoom&, const double*, const double*, T*, \
                                     const RigidOutcome<T>&, T*, void*, cudaStream_t);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd::cuda
