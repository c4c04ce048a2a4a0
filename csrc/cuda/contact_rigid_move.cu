// Trials of a rigid correction (contact/rigid_tries.h): which part of their motion bodies take. Kernel by kernel for
// scenes of any size, or in one launch for small ones.
#include <algorithm>

#include "../contact/rigid_tries.h"
#include "atomics.cuh"
#include "cluster.cuh"
#include "common.cuh"
#include "contact_rigid.cuh"

namespace diffvbd::cuda {
namespace {

constexpr int kLanes = 8;  // threads that share the pairs of a vertex

constexpr double kParts = 0x1p40;  // of the largest number of a sum in whole numbers, which has up to 2^20 of them

using Count = unsigned long long;

// What the tries of all scenes have in common.
template <class T>
struct Tried {
  const double *center, *motion;
  double *share, *low, *next, *way, *size;  // [B, bodies]
  double *before, *after;                   // [B, bodies] potentials
  double *value, *press;                    // [B, V], [rows] what vertices and pairs have of them
  Count *largest, *rise, *whole;            // [B, bodies] of bodies that decide together, by their first
  int32_t *lead, *together;                 // [B, bodies] who they are, as sets and by their first
  int32_t *touching, *touches;  // [listed, 2] bodies that press each other, scene after scene; [B] how many pairs
  int32_t *near, *nears;        // [listed] pairs that may press, scene after scene, in any order; [B] how many
  AdvanceState<T> state;
  Motion<T>* motions;                 // [B, V], those of `state`
  uint8_t *decided, *stopped, *done;  // [B, bodies] twice, [B]
  T* move;
};

template <class T>
__device__ void begin_body(const RigidInputs<T>& in, const Tried<T>& t, int64_t unit) {
  t.share[unit] = 1;
  t.way[unit] = t.size[unit] = 0;
  t.lead[unit] = static_cast<int32_t>(unit % in.bodies());
  t.decided[unit] = 0;
  t.state.share[unit] = T(0), t.state.now[unit] = T(1);
  t.state.blocked[unit] = t.state.stamp[unit] = 0;
}

// Numbers that are not negative have bits in their order.
__device__ Count bits_of(double value) { return static_cast<Count>(__double_as_longlong(value)); }

__device__ void raise_to(double* place, double value) { raise(reinterpret_cast<Count*>(place), bits_of(value)); }

// A vertex of a body.
template <class T>
struct Vertex {
  int64_t row, scene, unit;
  int32_t v, body;
  __device__ Vertex(const RigidInputs<T>& in, int64_t of) : row(of), scene(of / in.scene.vertices) {
    v = static_cast<int32_t>(row % in.scene.vertices);
    body = in.gate.body[v];
    unit = scene * in.bodies() + body;
  }
};

// How far bodies may go.
template <class T>
__device__ void find_way(const RigidInputs<T>& in, const Tried<T>& t, int64_t row) {
  const Vertex<T> at(in, row);
  const Body<T> body{in.scene, at.scene, at.body};
  const Farthest own = farthest_of(in, body, at.v, t.center + 3 * at.unit, t.motion + kUnknowns * at.unit);
  raise_to(t.way + at.unit, own.way), raise_to(t.size + at.unit, own.size);
}

// Which pairs may press, and who decides together: their order does not matter.
template <class T>
__device__ void join_pair(const RigidInputs<T>& in, const Tried<T>& t, int64_t pair, bool repels) {
  const int32_t* record = (repels ? in.gate.listed.pairs : in.lagged.pairs) + kPairRow * pair;
  const int64_t scene = record[5], first = scene * in.bodies();
  if (repels) {
    t.press[pair] = 0;
    if (!may_press(in, pair, t.way + first, t.size + first)) return;
    if (owner_of(in, record) >= 0)
      t.near[in.first_listed(scene) + atomicAdd(t.nears + scene, 1)] = static_cast<int32_t>(pair);
  } else if (!Lag<T>(in.lag + kLagScalars * pair).active()) {
    return;
  }
  const int32_t a = moving_body(in, record[0]), b = moving_body(in, record[sides(record[4])]);
  if (0 <= a && 0 <= b) unite(t.lead + first, a, b);
}

template <class T>
__device__ void displace(const RigidInputs<T>& in, const Tried<T>& t, int64_t row, T* x) {
  const Vertex<T> at(in, row);
  if (!x && t.decided[at.unit]) return;
  const Vector r = Body<T>::at(in.scene.x + 3 * row) - vector_of(t.center + 3 * at.unit);
  rigid::put(t.move + 3 * row, displaced(t.motion + kUnknowns * at.unit, t.share[at.unit], r));
  if (!x) {
    t.motions[row] = motion_of(in.gate, t.state, at.scene, at.v);
    return;
  }
  for (int c = 0; c < 3; ++c) x[3 * row + c] = in.scene.x[3 * row + c] + t.move[3 * row + c];
}

// What a vertex has of the potential of its body; of one that has moved also marks the body if its room or an energy
// does not let it pass.
template <class T>
__device__ void try_vertex(const RigidInputs<T>& in, const Tried<T>& t, int64_t row, bool moved) {
  const Vertex<T> at(in, row);
  if (!in.free[at.body] || t.decided[at.unit]) return;
  const Body<T> body{in.scene, at.scene, at.body};
  t.value[row] = vertex_value(in, body, at.v, moved);
  if (!moved) return;
  stay(in.gate, t.state, at.scene, at.v, 0);
  if (!admitted(in, body, at.v)) mark(t.state.blocked + at.unit);
}

// And a pair, of those that it moves with: a near one, or a lagged one. Where nothing has moved, also notes who presses
// whom.
template <class T>
__device__ void try_pair_of(const RigidInputs<T>& in, const Tried<T>& t, int64_t pair, bool repels, double& value,
                            bool moved) {
  const int32_t* record = (repels ? in.gate.listed.pairs : in.lagged.pairs) + kPairRow * pair;
  const int32_t owner = owner_of(in, record);
  if (owner < 0 || t.decided[record[5] * int64_t{in.bodies()} + owner]) return;
  const CornerPoints<T> at{in, moved};
  PairPress a;
  const bool acts = repels ? barrier_press(in, pair, at, a) : lagged_press(in, pair, at, Slid{}, a, -1);
  value = acts ? a.value : 0;
  if (moved && repels) try_pair(in.gate, t.state, pair, 0);
  if (moved || !repels || !acts || a.body[0] < 0 || a.body[1] < 0) return;
  const int64_t scene = record[5];
  int32_t* to = t.touching + 2 * (in.first_listed(scene) + atomicAdd(t.touches + scene, 1));
  to[0] = a.body[0], to[1] = a.body[1];
}

// The potential of a body, with that of the pairs that count for it.
template <class T, class Team>
__device__ double potential_of(const RigidInputs<T>& in, const Tried<T>& t, const Team& team, int64_t scene,
                               int32_t which, int64_t listed) {
  const Body<T> body{in.scene, scene, which};
  double sum[1];
  team.template sum<1>(kLanes * body.size(), sum, [&](int32_t i, double* to) {
    const int32_t v = body.vertex(i / kLanes), lane = i % kLanes;
    if (lane == 0) to[0] += t.value[body.row(v)];
    const auto add = [&](const PairList& list, const double* press) {
      const int64_t corner = scene * in.gate.corners + v;
      for (int32_t e = list.ptr[corner] + lane; e < list.ptr[corner + 1]; e += kLanes) {
        const int64_t pair = list.entry[e] >> 2;
        const int place = list.entry[e] & 3;
        const double value = place == 3 ? 0.0 : press[pair];
        if (value == 0) continue;  // as of most
        const int32_t* record = list.pairs + kPairRow * pair;
        if (place == 0 || (place == sides(record[4]) && moving_body(in, record[0]) < 0)) to[0] += value;
      }
    };
    if (listed > 0) add(in.gate.listed, t.press);
    if (in.lag) add(in.lagged, t.press + listed);
  });
  return sum[0];
}

// Those of up to kWarps bodies of a scene at once: what a thread has of each, of the items first, first + stride, ...
// of its vertices, listed and lagged pairs. listed: of all scenes.
template <class T>
__device__ void own_potentials(const RigidInputs<T>& in, const Tried<T>& t, int64_t scene, int32_t first,
                               int32_t stride, int64_t listed, double (&out)[kWarps]) {
  const int64_t repelling = in.first_listed(scene), rubbing = in.first_lagged(scene);
  const auto vertices = static_cast<int32_t>(in.scene.vertices);
  const auto repels = static_cast<int32_t>(in.first_listed(scene + 1) - repelling);
  const auto rubs = static_cast<int32_t>(in.first_lagged(scene + 1) - rubbing);
#pragma unroll
  for (int k = 0; k < kWarps; ++k) out[k] = 0;
  const auto add = [&](int32_t body, const double* value) {
    if (body < 0 || body >= in.bodies() || !in.free[body] || t.decided[scene * in.bodies() + body]) return;
#pragma unroll
    for (int k = 0; k < kWarps; ++k) out[k] += body == k ? *value : 0;
  };
  for (int32_t v = first; v < vertices; v += stride) add(in.gate.body[v], t.value + scene * vertices + v);
  for (int32_t i = first; i < repels; i += stride) {
    const int64_t pair = repelling + i;
    if (t.press[pair] != 0) add(owner_of(in, in.gate.listed.pairs + kPairRow * pair), t.press + pair);  // few
  }
  for (int32_t i = first; i < rubs; i += stride) {
    const int64_t pair = rubbing + i;
    add(owner_of(in, in.lagged.pairs + kPairRow * pair), t.press + listed + pair);
  }
}

// What the bodies of a scene decide by.
struct Votes {
  double *before, *after, *low, *next;
  Count *largest, *rise, *whole;  // of bodies that decide together, by their first
  int32_t* lead;                  // which that is; -1: decided, or nothing to decide
  uint8_t *blocked, *stopped;
};
// Where there are few, in shared memory: one question follows another, and each waits for what was answered.
constexpr int kHeld = 64;
struct Ballot {
  double before[kHeld], after[kHeld], low[kHeld], next[kHeld];
  Count largest[kHeld], rise[kHeld], whole[kHeld];
  int32_t lead[kHeld];
  uint8_t blocked[kHeld], stopped[kHeld];
  __device__ Votes votes() { return {before, after, low, next, largest, rise, whole, lead, blocked, stopped}; }
};

// Whether bodies may go as they have tried, by the block that works on their scene; if not, what each tries next.
// Returns whether all have decided. Sums are of whole numbers, which do not depend on their order.
template <class T>
__device__ bool decide(const RigidInputs<T>& in, const Tried<T>& t, int64_t scene, int attempt, Ballot& ballot) {
  const int64_t n = in.bodies(), first = scene * n;
  const bool held = n <= kHeld;
  const Votes own =
      held ? ballot.votes()
           : Votes{t.before + first, t.after + first, t.low + first,      t.next + first,          t.largest + first,
                   t.rise + first,   t.whole + first, t.together + first, t.state.blocked + first, t.stopped + first};
  const auto each = [&](int64_t count, const auto& f) {
    for (int64_t i = threadIdx.x; i < count; i += blockDim.x) f(i);
  };
  const auto each_open = [&](const auto& f) {  // f(its number, that of the first of those it decides with)
    each(n, [&](int64_t k) {
      if (own.lead[k] >= 0) f(k, own.lead[k]);
    });
  };
  each(n, [&](int64_t k) {
    const bool open = in.free[k] && !t.decided[first + k];
    own.lead[k] = open ? root_of(t.lead + first, static_cast<int32_t>(k)) : -1;
    own.largest[k] = own.rise[k] = own.whole[k] = own.stopped[k] = 0;
    if (!held || !open) return;
    own.before[k] = t.before[first + k], own.after[k] = t.after[first + k];
    own.blocked[k] = t.state.blocked[first + k];
  });
  __syncthreads();
  each_open([&](int64_t k, int64_t of) {
    const double size = fmax(fabs(own.before[k]), fabs(own.after[k]));
    atomicMax(own.largest + of, bits_of(isfinite(own.before[k]) && isfinite(own.after[k]) ? size : CUDART_INF));
    if (own.blocked[k]) mark(own.stopped + of);
  });
  __syncthreads();
  each_open([&](int64_t k, int64_t of) {
    const double parts = kParts / __longlong_as_double(static_cast<long long>(own.largest[of]));
    if (!(0 < parts && parts < CUDART_INF)) return;
    atomicAdd(own.rise + of, static_cast<Count>(__double2ll_rn(parts * (own.after[k] - own.before[k]))));
    atomicAdd(own.whole + of, static_cast<Count>(__double2ll_rn(parts * own.before[k])));
  });
  __syncthreads();
  bool open = false;
  const bool last = attempt + 1 == kTries;
  each_open([&](int64_t k, int64_t of) {
    const bool fits = !own.stopped[of], finite = own.largest[of] < bits_of(CUDART_INF);
    const auto before = static_cast<long long>(own.whole[of]), rise = static_cast<long long>(own.rise[of]);
    if (finite && is_safe(static_cast<double>(before), static_cast<double>(before + rise), fits)) {
      t.decided[first + k] = 1;
      own.lead[k] = -1;
    } else {
      own.low[k] = last ? 0.0 : shortened(own.blocked[k], fits, attempt);
      t.state.blocked[first + k] = 0;
      open = true;
    }
  });
  if (!__syncthreads_or(open)) return true;
  const int32_t* touching = t.touching + 2 * in.first_listed(scene);
  const int32_t touches = last ? 0 : t.touches[scene];
  for (int spread = 0; spread < kSpreads && touches > 0; ++spread) {
    each_open([&](int64_t k, int64_t) { own.next[k] = own.low[k]; });
    __syncthreads();
    each(touches, [&](int64_t i) {
      const int32_t a = touching[2 * i], b = touching[2 * i + 1];
      if (own.lead[a] < 0) return;  // both have decided
      const Count both = bits_of(fmin(own.low[a], own.low[b]));
      for (const int32_t k : {a, b}) atomicMin(reinterpret_cast<Count*>(own.next + k), both);
    });
    __syncthreads();
    each_open([&](int64_t k, int64_t) { own.low[k] = own.next[k]; });
    __syncthreads();
  }
  each_open([&](int64_t k, int64_t) { t.share[first + k] *= own.low[k]; });
  return false;
}

// What came of the tries of a scene, by a block.
template <class T>
__device__ void end_scene(const RigidInputs<T>& in, const double* motion, const RigidOutcome<T>& out, int64_t scene) {
  const int64_t first = in.bodies() * scene, last = first + in.bodies();
  bool some = false;
  for (int64_t unit = first + threadIdx.x; unit < last; unit += blockDim.x) {
    some = end_tries(in, motion, unit, out) || some;
  }
  if (__syncthreads_or(some)) return;
  for (int64_t unit = first + threadIdx.x; unit < last; unit += blockDim.x) out.held[unit] = false;
}

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
  for (int attempt = -1; attempt < kTries; ++attempt) {  // -1: where they are
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
  t.center = center, t.motion = motion, t.share = out.share, t.move = move;
  t.low = numbers(units), t.next = numbers(units), t.way = numbers(units), t.size = numbers(units);
  t.before = numbers(units), t.after = numbers(units);
  t.largest = counts(units), t.rise = counts(units), t.whole = counts(units);
  t.value = numbers(rows), t.press = numbers(room.rows());
  t.lead = whole(units), t.together = whole(units), t.touching = whole(2 * room.listed), t.touches = whole(scenes);
  t.near = whole(room.listed), t.nears = whole(scenes);
  t.state.share = reinterpret_cast<T*>(take(units * sizeof(T)));
  t.state.now = reinterpret_cast<T*>(take(units * sizeof(T)));
  t.state.blocked = take(units), t.state.stamp = take(units);
  t.decided = take(units), t.stopped = take(units), t.done = take(scenes);
  t.motions = reinterpret_cast<Motion<T>*>(take(rows * sizeof(Motion<T>)));
  t.state.motion = t.motions;
  if (has_block_each(in.scene.vertices, scenes, room.rows())) {
    return launch_clusters(scene_kernel<T>, scenes, room.rows(), kThreads, stream, in, t, room.listed, out, x);
  }
  begin_kernel<T><<<blocks_for(std::max(units, scenes), kOne), kOne, 0, stream>>>(in, t);
  if (room.rows() > 0) {
    way_kernel<T><<<blocks_for(rows, kOne), kOne, 0, stream>>>(in, t);
    join_kernel<T><<<blocks_for(room.rows(), kOne), kOne, 0, stream>>>(in, t, room.listed);
  }
  const auto look = [&](bool moved, double* to) {
    try_kernel<T><<<blocks_for(rows + room.rows(), kOne), kOne, 0, stream>>>(in, t, room.listed, moved);
    if (in.scene.vertices >= kLargeBody * in.bodies()) {
      potential_kernel<T, true><<<static_cast<unsigned>(units), kThreads, 0, stream>>>(in, t, room.listed, to);
    } else {
      const auto blocks = static_cast<unsigned>((units + kWarps - 1) / kWarps);
      potential_kernel<T, false><<<blocks, kThreads, 0, stream>>>(in, t, room.listed, to);
    }
  };
  look(false, t.before);
  for (int attempt = 0; attempt < kTries; ++attempt) {
    displace_kernel<T><<<blocks_for(rows, kOne), kOne, 0, stream>>>(in, t, nullptr);
    look(true, t.after);
    decide_kernel<T><<<static_cast<unsigned>(scenes), kOne, 0, stream>>>(in, t, attempt);
  }
  displace_kernel<T><<<blocks_for(rows, kOne), kOne, 0, stream>>>(in, t, x);
  end_kernel<T><<<static_cast<unsigned>(scenes), kOne, 0, stream>>>(in, motion, out);
  return cudaGetLastError();
}

DIFFVBD_INSTANTIATE(rigid_move_bytes)
DIFFVBD_INSTANTIATE(rigid_move)

}  // namespace diffvbd::cuda
