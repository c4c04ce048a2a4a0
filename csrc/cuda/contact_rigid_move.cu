#include <algorithm>

#include "../contact/rigid_tries.h"
#include "contact_rigid.cuh"
#include "ordered.cuh"

namespace diffvbd::cuda {
namespace {

constexpr int64_t kItemsOfBlock = 1024;  // of the potential of a scene, that one block adds up
constexpr int64_t kMostBlocks = 128;     // that add up one scene
constexpr int64_t kSmallScene = 4096;    // vertices up to which a block does all the work on a scene, and
constexpr int64_t kFewPairs = 32768;     // pairs that each has room for, unless there are
constexpr int64_t kManyScenes = 64;      // scenes enough to fill the device

// What the tries of all scenes have in common.
template <class T>
struct Tried {
  const double *center, *motion;
  double *share, *low, *next;   // [B, bodies]
  double *before, *after;       // [B, blocks]  parts of the potential
  int32_t *touching, *touches;  // [listed, 2] bodies that press each other, scene after scene; [B] how many pairs
  AdvanceState<T> state;
  uint8_t* done;  // [B]
  T* move;
  int64_t blocks;
};

template <class T>
__global__ void __launch_bounds__(kOne)
    begin_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ Tried<T> t) {
  const int64_t i = own_item();
  if (i < in.scene.scenes) t.done[i] = 0, t.touches[i] = 0;
  if (i >= in.scene.scenes * in.bodies()) return;
  t.share[i] = 1;
  t.state.share[i] = T(0), t.state.now[i] = T(1);
  t.state.blocked[i] = t.state.stamp[i] = 0;
}

// Their order does not matter.
template <class T>
__global__ void __launch_bounds__(kOne)
    touching_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ Tried<T> t) {
  const int64_t pair = own_item();
  PairPress a;
  if (pair >= in.first_listed(in.scene.scenes) || !barrier_press(in, pair, CornerPoints<T>{in, false}, a)) return;
  if (a.body[0] < 0 || a.body[1] < 0) return;
  const int64_t scene = in.gate.listed.pairs[kPairRow * pair + 5];
  int32_t* to = t.touching + 2 * (in.first_listed(scene) + atomicAdd(t.touches + scene, 1));
  to[0] = a.body[0], to[1] = a.body[1];
}

template <class T>
__device__ void displace(const RigidInputs<T>& in, const Tried<T>& t, int64_t row, T* x) {
  const int64_t scene = row / in.scene.vertices;
  const auto v = static_cast<int32_t>(row % in.scene.vertices);
  const int64_t body = scene * in.bodies() + in.gate.body[v];
  const Vector r = Body<T>::at(in.scene.x + 3 * row) - vector_of(t.center + 3 * body);
  rigid::put(t.move + 3 * row, displaced(t.motion + kUnknowns * body, t.share[body], r));
  if (!x) return;
  for (int c = 0; c < 3; ++c) x[3 * row + c] = in.scene.x[3 * row + c] + t.move[3 * row + c];
}

template <class T>
__global__ void __launch_bounds__(kOne)
    displace_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ Tried<T> t, T* x) {
  const int64_t row = own_item();
  if (row < in.scene.scenes * in.scene.vertices) displace(in, t, row, x);
}

// Marks the body of a vertex that its room or an energy does not let pass, and those of a pair that does not.
template <class T>
__device__ void test_vertex(const RigidInputs<T>& in, const Tried<T>& t, int64_t row) {
  const int64_t scene = row / in.scene.vertices;
  const auto v = static_cast<int32_t>(row % in.scene.vertices);
  const int32_t body = in.gate.body[v];
  if (!in.free[body]) return;
  stay(in.gate, t.state, row, 0);
  if (!admitted(in, Body<T>{in.scene, scene, body}, v)) mark(t.state.blocked + scene * in.bodies() + body);
}
template <class T>
__device__ void test_pair(const RigidInputs<T>& in, const Tried<T>& t, int64_t pair) {
  if (is_between(in, pair)) try_pair(in.gate, t.state, pair, 0);
}

template <class T>
__global__ void __launch_bounds__(kOne)
    test_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ Tried<T> t) {
  const int64_t item = own_item(), rows = in.scene.scenes * in.scene.vertices, pair = item - rows;
  if (item < rows) {
    if (!t.done[item / in.scene.vertices]) test_vertex(in, t, item);
  } else if (pair < in.first_listed(in.scene.scenes) && !t.done[in.gate.listed.pairs[kPairRow * pair + 5]]) {
    test_pair(in, t, pair);
  }
}

// What the items first, first + step, ... of a scene have of its potential.
template <class T>
__device__ double potential_of(const RigidInputs<T>& in, const BlockTeam& team, int64_t scene, bool moved,
                               int64_t first, int64_t step) {
  const CornerPoints<T> at{in, moved};
  const int64_t vertices = in.scene.vertices, listed = in.first_listed(scene), lagged = in.first_lagged(scene);
  const int64_t repelling = in.first_listed(scene + 1) - listed;
  const int64_t items = vertices + repelling + in.first_lagged(scene + 1) - lagged;
  const auto own = static_cast<int32_t>((items + step - 1 - first) / step);
  double sum[1];
  team.template sum<1>(own, sum, [&](int32_t i, double* to) {
    const int64_t item = first + step * i;
    if (item < vertices) {
      const auto v = static_cast<int32_t>(item);
      const int32_t body = in.gate.body[v];
      if (in.free[body]) to[0] += vertex_value(in, Body<T>{in.scene, scene, body}, v, moved);
      return;
    }
    PairPress a;
    const int64_t pair = item - vertices;
    const bool acts = pair < repelling ? barrier_press(in, listed + pair, at, a)
                                       : lagged_press(in, lagged + pair - repelling, at, Slid{}, a, -1);
    if (acts) to[0] += a.value;
  });
  return sum[0];
}

// A block of the potential of a scene.
template <class T>
__global__ void __launch_bounds__(kThreads)
    potential_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ Tried<T> t, bool moved,
                     double* out) {
  __shared__ double part[kWarps][kMostSums];
  const int64_t scene = blockIdx.y;
  if (t.done[scene]) return;
  const double sum = potential_of(in, BlockTeam{part}, scene, moved, blockIdx.x, gridDim.x);
  if (threadIdx.x == 0) out[scene * gridDim.x + blockIdx.x] = sum;
}

// Whether a scene may go as it has tried, by the block that works on it; if not, what each body tries next.
template <class T>
__device__ bool decide(const RigidInputs<T>& in, const Tried<T>& t, int64_t scene, int attempt, double before,
                       double after) {
  const int64_t n = in.bodies(), first = scene * n;
  const auto each = [&](int64_t count, const auto& f) {
    for (int64_t i = threadIdx.x; i < count; i += blockDim.x) f(i);
  };
  bool stopped = false;
  each(n, [&](int64_t k) { stopped = stopped || t.state.blocked[first + k]; });
  const bool fits = !__syncthreads_or(stopped);
  if (is_safe(before, after, fits)) return true;
  const bool last = attempt + 1 == kTries;
  each(n, [&](int64_t k) {
    t.low[first + k] = last ? 0.0 : shortened(t.state.blocked[first + k], fits, attempt);
    t.state.blocked[first + k] = 0;
  });
  const int32_t* touching = t.touching + 2 * in.first_listed(scene);
  for (int spread = 0; spread < kSpreads && !last; ++spread) {
    __syncthreads();
    each(n, [&](int64_t k) { t.next[first + k] = t.low[first + k]; });
    __syncthreads();
    each(t.touches[scene], [&](int64_t i) {
      const int32_t a = touching[2 * i], b = touching[2 * i + 1];
      const double both = fmin(t.low[first + a], t.low[first + b]);
      // not negative: their bits are in their order
      for (const int32_t k : {a, b}) {
        lower(reinterpret_cast<unsigned long long*>(t.next + first + k),
              static_cast<unsigned long long>(__double_as_longlong(both)));
      }
    });
    __syncthreads();
    each(n, [&](int64_t k) { t.low[first + k] = t.next[first + k]; });
  }
  __syncthreads();
  each(n, [&](int64_t k) { t.share[first + k] *= t.low[first + k]; });
  return false;
}

// A block for each scene.
template <class T>
__global__ void __launch_bounds__(kOne)
    decide_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ Tried<T> t, int attempt) {
  const int64_t scene = blockIdx.x;
  if (t.done[scene]) return;
  double before = 0, after = 0;
  for (int64_t i = 0; i < t.blocks; ++i) {
    before += t.before[scene * t.blocks + i];
    after += t.after[scene * t.blocks + i];
  }
  const bool done = decide(in, t, scene, attempt, before, after);
  __syncthreads();  // everyone has asked whether it is done
  if (done && threadIdx.x == 0) t.done[scene] = 1;
}

// All tries of a small scene: a block.
template <class T>
__global__ void __launch_bounds__(kThreads)
    scene_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ Tried<T> t, T* x) {
  __shared__ double part[kWarps][kMostSums];
  const BlockTeam team{part};
  const int64_t scene = blockIdx.x, first = scene * in.scene.vertices, begin = in.first_listed(scene);
  const auto vertices = static_cast<int32_t>(in.scene.vertices);
  const auto pairs = static_cast<int32_t>(in.first_listed(scene + 1) - begin);
  const double before = potential_of(in, team, scene, false, 0, 1);
  for (int attempt = 0; attempt < kTries; ++attempt) {
    team.each(vertices, [&](int32_t v) { displace(in, t, first + v, static_cast<T*>(nullptr)); });
    team.meet();
    team.each(vertices, [&](int32_t v) { test_vertex(in, t, first + v); });
    team.each(pairs, [&](int32_t i) { test_pair(in, t, begin + i); });
    const double after = potential_of(in, team, scene, true, 0, 1);
    if (decide(in, t, scene, attempt, before, after)) break;
    team.meet();
  }
  team.each(vertices, [&](int32_t v) { displace(in, t, first + v, x); });
}

template <class T>
int64_t potential_blocks(const RigidInputs<T>& in, const PairRoom& room) {
  const int64_t items = in.scene.vertices + room.rows() / std::max<int64_t>(1, in.scene.scenes);
  return std::clamp<int64_t>((items + kItemsOfBlock - 1) / kItemsOfBlock, 1, kMostBlocks);
}

}  // namespace

template <class T>
int64_t rigid_move_bytes(const RigidInputs<T>& in, const PairRoom& room) {
  const int64_t units = in.scene.scenes * in.bodies(), parts = in.scene.scenes * potential_blocks(in, room);
  return aligned(room.listed * 2 * sizeof(int32_t)) + aligned(in.scene.scenes * sizeof(int32_t)) +
         2 * aligned(units * sizeof(double)) + 2 * aligned(parts * sizeof(double)) + 2 * aligned(units * sizeof(T)) +
         2 * aligned(units) + aligned(in.scene.scenes);
}

template <class T>
cudaError_t rigid_move(const RigidInputs<T>& in, const PairRoom& room, const double* center, const double* motion,
                       T* move, double* share, T* x, void* workspace, cudaStream_t stream) {
  const int64_t scenes = in.scene.scenes, units = scenes * in.bodies(), rows = scenes * in.scene.vertices;
  if (rows == 0 || units == 0) return cudaSuccess;
  auto* next = static_cast<uint8_t*>(workspace);
  const auto take = [&](int64_t bytes) {
    uint8_t* here = next;
    next += aligned(bytes);
    return here;
  };
  const auto numbers = [&](int64_t count) { return reinterpret_cast<double*>(take(count * sizeof(double))); };
  Tried<T> t{};
  t.center = center, t.motion = motion, t.share = share, t.move = move;
  t.touching = reinterpret_cast<int32_t*>(take(room.listed * 2 * sizeof(int32_t)));
  t.touches = reinterpret_cast<int32_t*>(take(scenes * sizeof(int32_t)));
  t.blocks = potential_blocks(in, room);
  t.low = numbers(units), t.next = numbers(units);
  t.before = numbers(scenes * t.blocks), t.after = numbers(scenes * t.blocks);
  t.state.share = reinterpret_cast<T*>(take(units * sizeof(T)));
  t.state.now = reinterpret_cast<T*>(take(units * sizeof(T)));
  t.state.blocked = take(units), t.state.stamp = take(units), t.done = take(scenes);
  begin_kernel<T><<<blocks_for(std::max(units, scenes)), kOne, 0, stream>>>(in, t);
  if (room.listed > 0) touching_kernel<T><<<blocks_for(room.listed), kOne, 0, stream>>>(in, t);
  const bool few = room.rows() <= kFewPairs * scenes || kManyScenes <= scenes;
  if (in.scene.vertices <= kSmallScene && few) {
    scene_kernel<T><<<static_cast<unsigned>(scenes), kThreads, 0, stream>>>(in, t, x);
    return cudaGetLastError();
  }
  const dim3 sums(static_cast<unsigned>(t.blocks), static_cast<unsigned>(scenes));
  potential_kernel<T><<<sums, kThreads, 0, stream>>>(in, t, false, t.before);
  for (int attempt = 0; attempt < kTries; ++attempt) {
    displace_kernel<T><<<blocks_for(rows), kOne, 0, stream>>>(in, t, nullptr);
    test_kernel<T><<<blocks_for(rows + room.listed), kOne, 0, stream>>>(in, t);
    potential_kernel<T><<<sums, kThreads, 0, stream>>>(in, t, true, t.after);
    decide_kernel<T><<<static_cast<unsigned>(scenes), kOne, 0, stream>>>(in, t, attempt);
  }
  displace_kernel<T><<<blocks_for(rows), kOne, 0, stream>>>(in, t, x);
  return cudaGetLastError();
}

#define DIFFVBD_INSTANTIATE(T)                                                                                 \
  template int64_t rigid_move_bytes<T>(const RigidInputs<T>&, const PairRoom&);                                \
  template cudaError_t rigid_move<T>(const RigidInputs<T>&, const PairRoom&, const double*, const double*, T*, \
                                     double*, T*, void*, cudaStream_t);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd::cuda
