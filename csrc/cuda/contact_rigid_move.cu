// Trials of a rigid correction (contact/rigid_tries.h): which part of their motion bodies take. Kernel by kernel for
// scenes of any size, or in one launch for small ones.
#include <algorithm>

#include "../subspace/contact_rigid.h"
#include "atomics.cuh"
#include "cluster.cuh"
#include "common.cuh"
#include "contact_rigid.cuh"

namespace diffvbd::cuda {
namespace {

constexpr int kLanes = 8;  // threads that share the pairs of a vertex

constexpr double kParts =
    0x1p40;  // fixed-point scale: the largest number of a sum is 2^40, and sums have up to 2^20 terms

using Count = unsigned long long;

// Memory of the trials of all scenes.
template <class T>
struct MoveTrial {
  const double *center, *motion;
  double *share, *low, *next, *displacement, *size;  // [B, bodies]
  double *before, *after;                            // [B, bodies] potentials
  double *vertex_energy, *pair_energy;               // [B, V], [rows] contributions to the potentials
  Count *largest, *increase, *total;                 // [B, bodies] of a set of bodies that decide jointly, at its root
  int32_t *lead, *together;                          // [B, bodies] sets, and their roots
  int32_t *contacts, *contact_count;                 // [listed, 2] bodies in contact, by scene; [B] number of pairs
  int32_t *near, *near_count;                        // [listed] pairs that may act, by scene, in any order; [B] number
  AdvanceState<T> state;
  Motion<T>* motions;                 // [B, V], those of `state`
  uint8_t *decided, *stopped, *done;  // [B, bodies] twice, [B]
  T* move;
};

template <class T>
__device__ void begin_body(const RigidInputs<T>& in, const MoveTrial<T>& t, int64_t unit) {
  t.share[unit] = 1;
  t.displacement[unit] = t.size[unit] = 0;
  t.lead[unit] = static_cast<int32_t>(unit % in.bodies());
  t.decided[unit] = 0;
  t.state.fraction[unit] = T(0), t.state.now[unit] = T(1);
  t.state.blocked[unit] = t.state.stamp[unit] = 0;
}

// Bits of a number >= 0: they have the order of the numbers.
__device__ Count bits_of(double value) { return static_cast<Count>(__double_as_longlong(value)); }

__device__ void raise_to(double* place, double value) { raise(reinterpret_cast<Count*>(place), bits_of(value)); }

// Vertex of a body.
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

// Bounds of the motion of bodies.
template <class T>
__device__ void find_displacement(const RigidInputs<T>& in, const MoveTrial<T>& t, int64_t row) {
  const Vertex<T> at(in, row);
  const Body<T> body{in.scene, at.scene, at.body};
  const Farthest own = farthest_of(in, body, at.v, t.center + 3 * at.unit, t.motion + kUnknowns * at.unit);
  raise_to(t.displacement + at.unit, own.displacement), raise_to(t.size + at.unit, own.size);
}

// Lists the pairs that may act, and unites bodies that decide jointly, in any order.
template <class T>
__device__ void join_pair(const RigidInputs<T>& in, const MoveTrial<T>& t, int64_t pair, bool repels) {
  const int32_t* record = (repels ? in.gate.listed.pairs : in.lagged.pairs) + kPairRow * pair;
  const int64_t scene = record[5], first = scene * in.bodies();
  if (repels) {
    t.pair_energy[pair] = 0;
    if (!may_touch(in, pair, t.displacement + first, t.size + first)) return;
    if (owner_of(in, record) >= 0)
      t.near[in.first_listed(scene) + atomicAdd(t.near_count + scene, 1)] = static_cast<int32_t>(pair);
  } else if (!Lag<T>(in.lag + kLagScalars * pair).active()) {
    return;
  }
  const int32_t a = moving_body(in, record[0]), b = moving_body(in, record[sides(record[4])]);
  if (0 <= a && 0 <= b) unite(t.lead + first, a, b);
}

template <class T>
__device__ void displace(const RigidInputs<T>& in, const MoveTrial<T>& t, int64_t row, T* x) {
  const Vertex<T> at(in, row);
  if (!x && t.decided[at.unit]) return;
  const Vector r = diffvbd::wide_at(in.scene.x + 3 * row) - vector_of(t.center + 3 * at.unit);
  diffvbd::put(t.move + 3 * row, displaced(t.motion + kUnknowns * at.unit, t.share[at.unit], r));
  if (!x) {
    t.motions[row] = motion_of(in.gate, t.state, at.scene, at.v);
    return;
  }
  for (int c = 0; c < 3; ++c) x[3 * row + c] = in.scene.x[3 * row + c] + t.move[3 * row + c];
}

// Contribution of a vertex to the potential of its body. After a motion it also marks the body where the deformation
// radius or an energy does not admit it.
template <class T>
__device__ void test_vertex(const RigidInputs<T>& in, const MoveTrial<T>& t, int64_t row, bool moved) {
  const Vertex<T> at(in, row);
  if (!in.free[at.body] || t.decided[at.unit]) return;
  const Body<T> body{in.scene, at.scene, at.body};
  t.vertex_energy[row] = vertex_value(in, body, at.v, moved);
  if (!moved) return;
  stay(in.gate, t.state, at.scene, at.v, 0);
  if (!admitted(in, body, at.v)) mark(t.state.blocked + at.unit);
}

// Contribution of a near or lagged pair. Before a motion it also records the two bodies in contact.
template <class T>
__device__ void test_pair_of(const RigidInputs<T>& in, const MoveTrial<T>& t, int64_t pair, bool repels, double& value,
                             bool moved) {
  const int32_t* record = (repels ? in.gate.listed.pairs : in.lagged.pairs) + kPairRow * pair;
  const int32_t owner = owner_of(in, record);
  if (owner < 0 || t.decided[record[5] * int64_t{in.bodies()} + owner]) return;
  const CornerPoints<T> at{in, moved};
  PairForce a;
  const bool acts = repels ? barrier_force(in, pair, at, a) : lagged_force(in, pair, at, BodyMotions{}, a, -1);
  value = acts ? a.value : 0;
  if (moved && repels) test_pair(in.gate, t.state, pair, 0);
  if (moved || !repels || !acts || a.body[0] < 0 || a.body[1] < 0) return;
  const int64_t scene = record[5];
  int32_t* to = t.contacts + 2 * (in.first_listed(scene) + atomicAdd(t.contact_count + scene, 1));
  to[0] = a.body[0], to[1] = a.body[1];
}

// Potential of a body with the pairs that it owns.
template <class T, class Team>
__device__ double potential_of(const RigidInputs<T>& in, const MoveTrial<T>& t, const Team& team, int64_t scene,
                               int32_t which, int64_t listed) {
  const Body<T> body{in.scene, scene, which};
  double sum[1];
  team.template sum<1>(kLanes * body.size(), sum, [&](int32_t i, double* to) {
    const int32_t v = body.vertex(i / kLanes), lane = i % kLanes;
    if (lane == 0) to[0] += t.vertex_energy[body.row(v)];
    const auto add = [&](const PairList& list, const double* press) {
      const int64_t corner = scene * in.gate.corners + v;
      for (int32_t e = list.ptr[corner] + lane; e < list.ptr[corner + 1]; e += kLanes) {
        const int64_t pair = list.entry[e] >> 2;
        const int place = list.entry[e] & 3;
        const double value = place == 3 ? 0.0 : press[pair];
        if (value == 0) continue;  // as most are
        const int32_t* record = list.pairs + kPairRow * pair;
        if (place == 0 || (place == sides(record[4]) && moving_body(in, record[0]) < 0)) to[0] += value;
      }
    };
    if (listed > 0) add(in.gate.listed, t.pair_energy);
    if (in.lag) add(in.lagged, t.pair_energy + listed);
  });
  return sum[0];
}

// Potentials of up to kWarps bodies at once: the part of a thread, from the items first, first + stride, ... of
// vertices, listed and lagged pairs. listed: of all scenes.
template <class T>
__device__ void own_potentials(const RigidInputs<T>& in, const MoveTrial<T>& t, int64_t scene, int32_t first,
                               int32_t stride, int64_t listed, double (&out)[kWarps]) {
  const int64_t listed_begin = in.first_listed(scene), lagged_begin = in.first_lagged(scene);
  const auto vertices = static_cast<int32_t>(in.scene.vertices);
  const auto listed_count = static_cast<int32_t>(in.first_listed(scene + 1) - listed_begin);
  const auto lagged_count = static_cast<int32_t>(in.first_lagged(scene + 1) - lagged_begin);
#pragma unroll
  for (int k = 0; k < kWarps; ++k) out[k] = 0;
  const auto add = [&](int32_t body, const double* value) {
    if (body < 0 || body >= in.bodies() || !in.free[body] || t.decided[scene * in.bodies() + body]) return;
#pragma unroll
    for (int k = 0; k < kWarps; ++k) out[k] += body == k ? *value : 0;
  };
  for (int32_t v = first; v < vertices; v += stride) add(in.gate.body[v], t.vertex_energy + scene * vertices + v);
  for (int32_t i = first; i < listed_count; i += stride) {
    const int64_t pair = listed_begin + i;
    if (t.pair_energy[pair] != 0)
      add(owner_of(in, in.gate.listed.pairs + kPairRow * pair), t.pair_energy + pair);  // few
  }
  for (int32_t i = first; i < lagged_count; i += stride) {
    const int64_t pair = lagged_begin + i;
    add(owner_of(in, in.lagged.pairs + kPairRow * pair), t.pair_energy + listed + pair);
  }
}

// Arrays of the decision of a scene.
struct Decision {
  double *before, *after, *low, *next;
  Count *largest, *increase, *total;  // of bodies that decide jointly, at their root
  int32_t* lead;                      // that root; -1: decided, or nothing to decide
  uint8_t *blocked, *stopped;
};
// The same in shared memory for few bodies: its steps are short and depend on one another.
constexpr int kMostShared = 64;
struct SharedDecision {
  double before[kMostShared], after[kMostShared], low[kMostShared], next[kMostShared];
  Count largest[kMostShared], increase[kMostShared], total[kMostShared];
  int32_t lead[kMostShared];
  uint8_t blocked[kMostShared], stopped[kMostShared];
  __device__ Decision view() { return {before, after, low, next, largest, increase, total, lead, blocked, stopped}; }
};

// Decision about a trial, by the block of the scene: bodies accept their motion or get a shorter one. Returns whether
// all bodies have decided. Sums are integers, so their order does not matter.
template <class T>
__device__ bool decide(const RigidInputs<T>& in, const MoveTrial<T>& t, int64_t scene, int attempt,
                       SharedDecision& shared) {
  const int64_t n = in.bodies(), first = scene * n;
  const bool is_shared = n <= kMostShared;
  const Decision own = is_shared
                           ? shared.view()
                           : Decision{t.before + first,        t.after + first,    t.low + first,   t.next + first,
                                      t.largest + first,       t.increase + first, t.total + first, t.together + first,
                                      t.state.blocked + first, t.stopped + first};
  const auto each = [&](int64_t count, const auto& f) {
    for (int64_t i = threadIdx.x; i < count; i += blockDim.x) f(i);
  };
  const auto each_pending = [&](const auto& f) {  // f(number, root)
    each(n, [&](int64_t k) {
      if (own.lead[k] >= 0) f(k, own.lead[k]);
    });
  };
  each(n, [&](int64_t k) {
    const bool open = in.free[k] && !t.decided[first + k];
    own.lead[k] = open ? root_of(t.lead + first, static_cast<int32_t>(k)) : -1;
    own.largest[k] = own.increase[k] = own.total[k] = own.stopped[k] = 0;
    if (!is_shared || !open) return;
    own.before[k] = t.before[first + k], own.after[k] = t.after[first + k];
    own.blocked[k] = t.state.blocked[first + k];
  });
  __syncthreads();
  each_pending([&](int64_t k, int64_t of) {
    const double size = fmax(fabs(own.before[k]), fabs(own.after[k]));
    atomicMax(own.largest + of, bits_of(isfinite(own.before[k]) && isfinite(own.after[k]) ? size : CUDART_INF));
    if (own.blocked[k]) mark(own.stopped + of);
  });
  __syncthreads();
  each_pending([&](int64_t k, int64_t of) {
    const double parts = kParts / __longlong_as_double(static_cast<long long>(own.largest[of]));
    if (!(0 < parts && parts < CUDART_INF)) return;
    atomicAdd(own.increase + of, static_cast<Count>(__double2ll_rn(parts * (own.after[k] - own.before[k]))));
    atomicAdd(own.total + of, static_cast<Count>(__double2ll_rn(parts * own.before[k])));
  });
  __syncthreads();
  bool open = false;
  const bool last = attempt + 1 == kTrials;
  each_pending([&](int64_t k, int64_t of) {
    const bool fits = !own.stopped[of], finite = own.largest[of] < bits_of(CUDART_INF);
    const auto before = static_cast<long long>(own.total[of]), rise = static_cast<long long>(own.increase[of]);
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
  const int32_t* contacts = t.contacts + 2 * in.first_listed(scene);
  const int32_t contacts_in_scene = last ? 0 : t.contact_count[scene];
  for (int spread = 0; spread < kSpreads && contacts_in_scene > 0; ++spread) {
    each_pending([&](int64_t k, int64_t) { own.next[k] = own.low[k]; });
    __syncthreads();
    each(contacts_in_scene, [&](int64_t i) {
      const int32_t a = contacts[2 * i], b = contacts[2 * i + 1];
      if (own.lead[a] < 0) return;  // both bodies have decided
      const Count both = bits_of(fmin(own.low[a], own.low[b]));
      for (const int32_t k : {a, b}) atomicMin(reinterpret_cast<Count*>(own.next + k), both);
    });
    __syncthreads();
    each_pending([&](int64_t k, int64_t) { own.low[k] = own.next[k]; });
    __syncthreads();
  }
  each_pending([&](int64_t k, int64_t) { t.share[first + k] *= own.low[k]; });
  return false;
}

// Outcome of the trials of a scene, by a block.
template <class T>
__device__ void end_scene(const RigidInputs<T>& in, const double* motion, const RigidOutcome<T>& out, int64_t scene) {
  const int64_t first = in.bodies() * scene, last = first + in.bodies();
  bool some = false;
  for (int64_t unit = first + threadIdx.x; unit < last; unit += blockDim.x) {
    some = finish_trials(in, motion, unit, out) || some;
  }
  if (__syncthreads_or(some)) return;
  for (int64_t unit = first + threadIdx.x; unit < last; unit += blockDim.x) out.blocked[unit] = false;
}

constexpr int64_t kLargeBody = 32;  // vertices from which a block sums a body rather than a warp

template <class T>
__global__ void __launch_bounds__(kOne)
    begin_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ MoveTrial<T> t) {
  const int64_t i = own_item();
  if (i < in.scene.scenes) t.done[i] = 0, t.contact_count[i] = t.near_count[i] = 0;
  if (i < in.scene.scenes * in.bodies()) begin_body(in, t, i);
}

template <class T>
__global__ void __launch_bounds__(kOne)
    displacement_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ MoveTrial<T> t) {
  const int64_t row = own_item();
  if (row < in.scene.scenes * in.scene.vertices) find_displacement(in, t, row);
}

template <class T>
__global__ void __launch_bounds__(kOne)
    join_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ MoveTrial<T> t, int64_t listed) {
  const int64_t item = own_item();
  const bool repels = item < listed;
  const int64_t pair = repels ? item : item - listed;
  if (pair < (repels ? in.first_listed(in.scene.scenes) : in.first_lagged(in.scene.scenes))) {
    join_pair(in, t, pair, repels);
  }
}

template <class T>
__global__ void __launch_bounds__(kOne)
    displace_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ MoveTrial<T> t, T* x) {
  const int64_t row = own_item();
  if (row < in.scene.scenes * in.scene.vertices) displace(in, t, row, x);
}

template <class T>
__global__ void __launch_bounds__(kOne)
    test_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ MoveTrial<T> t, int64_t listed,
                bool moved) {
  const int64_t item = own_item(), rows = in.scene.scenes * in.scene.vertices, pair = item - rows;
  if (item < rows) {
    test_vertex(in, t, item, moved);
  } else if (pair < listed) {
    if (pair >= in.first_listed(in.scene.scenes)) return;
    const int64_t scene = in.gate.listed.pairs[kPairRow * pair + 5];
    if (pair - in.first_listed(scene) >= t.near_count[scene]) return;
    test_pair_of(in, t, t.near[pair], true, t.pair_energy[t.near[pair]], moved);
  } else if (pair - listed < in.first_lagged(in.scene.scenes)) {
    test_pair_of(in, t, pair - listed, false, t.pair_energy[pair], moved);
  }
}

// Potentials of all bodies, a block or a warp each.
template <class T, bool large>
__global__ void __launch_bounds__(kThreads)
    potential_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ MoveTrial<T> t, int64_t listed,
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
    decide_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ MoveTrial<T> t, int attempt) {
  __shared__ SharedDecision shared;
  if (t.done[blockIdx.x]) return;
  const bool done = decide(in, t, blockIdx.x, attempt, shared);
  __syncthreads();  // all threads have read done
  if (done && threadIdx.x == 0) t.done[blockIdx.x] = 1;
}

template <class T>
__global__ void __launch_bounds__(kOne) end_kernel(const __grid_constant__ RigidInputs<T> in, const double* motion,
                                                   const __grid_constant__ RigidOutcome<T> out) {
  end_scene(in, motion, out, blockIdx.x);
}

// Block of a cluster that works on a scene.
struct BlockOfScene {
  BlockTeam block;
  Cluster cluster;
  __device__ int32_t first() const { return static_cast<int32_t>(kThreads * cluster.rank + threadIdx.x); }
  template <class F>
  __device__ void each(int32_t count, const F& f) const {
    for (int32_t i = first(); i < count; i += kThreads * cluster.size) f(i);
  }
};

// All trials of a small scene, by a cluster.
template <class T>
__global__ void __launch_bounds__(kThreads)
    scene_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ MoveTrial<T> t, int64_t listed,
                 const __grid_constant__ RigidOutcome<T> out, T* x) {
  // potentials: of few bodies, by block. Their last bits depend on the number of blocks; decisions tolerate that
  __shared__ double part[kWarps][kMostSums], potentials[kMostBlocks][kWarps];
  __shared__ Answers answers;
  __shared__ SharedDecision shared;
  Cluster cluster = Cluster::all();
  const int64_t scene = blockIdx.x / cluster.size, first = scene * in.scene.vertices, unit = scene * in.bodies();
  const auto vertices = static_cast<int32_t>(in.scene.vertices);
  bool moves = false;
  const double* motions = t.motion + kUnknowns * unit;
  BlockTeam{part}.each(kUnknowns * in.bodies(), [&](int32_t i) { moves = moves || motions[i] != 0; });
  if (!__syncthreads_or(moves)) {  // a captured step launches all corrections, and most move nothing
    const int32_t scalars = 3 * vertices;
    BlockOfScene{{part}, cluster}.each(scalars, [&](int32_t i) { x[3 * first + i] = in.scene.x[3 * first + i]; });
    if (cluster.rank > 0) return;
    BlockTeam{part}.each(in.bodies(), [&](int32_t k) { t.share[unit + k] = 1; });
    __syncthreads();
    return end_scene(in, t.motion, out, scene);
  }
  const int64_t listed_begin = in.first_listed(scene), lagged_begin = in.first_lagged(scene);
  const auto listed_count = static_cast<int32_t>(in.first_listed(scene + 1) - listed_begin);
  const auto lagged_count = static_cast<int32_t>(in.first_lagged(scene + 1) - lagged_begin);
  if (cluster.leaves(in.scene.vertices + listed_count + lagged_count)) return;
  const BlockOfScene team{{part}, cluster};
  const auto warp = static_cast<int32_t>(threadIdx.x / 32);
  const bool few = in.bodies() <= kWarps, leads = cluster.rank == 0;
  int turn = 0;
  team.each(in.bodies(), [&](int32_t k) { begin_body(in, t, unit + k); });
  if (leads && threadIdx.x == 0) t.contact_count[scene] = t.near_count[scene] = 0;
  cluster.meet();
  team.each(vertices, [&](int32_t v) { find_displacement(in, t, first + v); });
  cluster.meet();
  team.each(listed_count + lagged_count, [&](int32_t i) {
    join_pair(in, t, i < listed_count ? listed_begin + i : lagged_begin + i - listed_count, i < listed_count);
  });
  cluster.meet();
  const int32_t near = t.near_count[scene];
  for (int attempt = -1; attempt < kTrials; ++attempt) {  // -1: before any motion
    const bool moved = 0 <= attempt;
    double* const to = (moved ? t.after : t.before) + unit;
    if (moved) {
      team.each(vertices, [&](int32_t v) { displace(in, t, first + v, static_cast<T*>(nullptr)); });
      cluster.meet();
    }
    team.each(vertices, [&](int32_t v) { test_vertex(in, t, first + v, moved); });
    team.each(near + lagged_count, [&](int32_t i) {
      const int64_t pair = i < near ? t.near[listed_begin + i] : lagged_begin + i - near;
      test_pair_of(in, t, pair, i < near, t.pair_energy[i < near ? pair : listed + pair], moved);
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
    if (moved && any_of_cluster(cluster, answers, turn, leads && decide(in, t, scene, attempt, shared))) break;
  }
  team.each(vertices, [&](int32_t v) { displace(in, t, first + v, x); });
  if (leads) end_scene(in, t.motion, out, scene);  // does not change fractions of bodies that move
}

// Memory of the trials in the workspace.
template <class T>
MoveTrial<T> lay_out(const RigidInputs<T>& in, const PairCapacity& capacity, Parts<16>& take) {
  const int64_t scenes = in.scene.scenes, units = scenes * in.bodies(), rows = scenes * in.scene.vertices;
  MoveTrial<T> t{};
  take(t.low, units), take(t.next, units), take(t.displacement, units), take(t.size, units);
  take(t.before, units), take(t.after, units), take(t.largest, units), take(t.increase, units), take(t.total, units);
  take(t.vertex_energy, rows), take(t.pair_energy, capacity.rows());
  take(t.lead, units), take(t.together, units), take(t.contacts, 2 * capacity.listed), take(t.contact_count, scenes);
  take(t.near, capacity.listed), take(t.near_count, scenes), take(t.state.fraction, units), take(t.state.now, units);
  take(t.state.blocked, units), take(t.state.stamp, units), take(t.decided, units), take(t.stopped, units);
  take(t.done, scenes), take(t.motions, rows);
  t.state.motion = t.motions;
  return t;
}

}  // namespace

template <class T>
int64_t rigid_move_bytes(const RigidInputs<T>& in, const PairCapacity& capacity) {
  Parts<16> take(nullptr);
  lay_out(in, capacity, take);
  return static_cast<int64_t>(take.bytes);
}

template <class T>
cudaError_t rigid_move(const RigidInputs<T>& in, const PairCapacity& capacity, const double* center,
                       const double* motion, T* move, const RigidOutcome<T>& out, T* x, void* workspace,
                       cudaStream_t stream) {
  const int64_t scenes = in.scene.scenes, units = scenes * in.bodies(), rows = scenes * in.scene.vertices;
  if (rows == 0 || units == 0) return cudaSuccess;
  Parts<16> take(workspace);
  MoveTrial<T> t = lay_out(in, capacity, take);
  t.center = center, t.motion = motion, t.share = out.fraction, t.move = move;
  if (has_block_each(in.scene.vertices, scenes, capacity.rows())) {
    return launch_clusters(scene_kernel<T>, scenes, capacity.rows(), kThreads, stream, in, t, capacity.listed, out, x);
  }
  begin_kernel<T><<<blocks_for(std::max(units, scenes), kOne), kOne, 0, stream>>>(in, t);
  if (capacity.rows() > 0) {
    displacement_kernel<T><<<blocks_for(rows, kOne), kOne, 0, stream>>>(in, t);
    join_kernel<T><<<blocks_for(capacity.rows(), kOne), kOne, 0, stream>>>(in, t, capacity.listed);
  }
  const auto look = [&](bool moved, double* to) {
    test_kernel<T><<<blocks_for(rows + capacity.rows(), kOne), kOne, 0, stream>>>(in, t, capacity.listed, moved);
    if (in.scene.vertices >= kLargeBody * in.bodies()) {
      potential_kernel<T, true><<<static_cast<unsigned>(units), kThreads, 0, stream>>>(in, t, capacity.listed, to);
    } else {
      const auto blocks = static_cast<unsigned>((units + kWarps - 1) / kWarps);
      potential_kernel<T, false><<<blocks, kThreads, 0, stream>>>(in, t, capacity.listed, to);
    }
  };
  look(false, t.before);
  for (int attempt = 0; attempt < kTrials; ++attempt) {
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
