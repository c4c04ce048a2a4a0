// The tries of a rigid correction (contact/rigid_tries.h) on the device: what threads do for bodies, vertices, pairs
// and scenes.
#pragma once

#include "../subspace/contact_rigid.h"
#include "contact_rigid.cuh"
#include "ordered.cuh"
#include "union.cuh"

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
  t.state.fraction[unit] = T(0), t.state.now[unit] = T(1);
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
  raise_to(t.way + at.unit, own.displacement), raise_to(t.size + at.unit, own.size);
}

// Which pairs may press, and who decides together: their order does not matter.
template <class T>
__device__ void join_pair(const RigidInputs<T>& in, const Tried<T>& t, int64_t pair, bool repels) {
  const int32_t* record = (repels ? in.gate.listed.pairs : in.lagged.pairs) + kPairRow * pair;
  const int64_t scene = record[5], first = scene * in.bodies();
  if (repels) {
    t.press[pair] = 0;
    if (!may_touch(in, pair, t.way + first, t.size + first)) return;
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
  const Vector r = wide_at(in.scene.x + 3 * row) - vector_of(t.center + 3 * at.unit);
  put(t.move + 3 * row, displaced(t.motion + kUnknowns * at.unit, t.share[at.unit], r));
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
  PairForce a;
  const bool acts = repels ? barrier_force(in, pair, at, a) : lagged_force(in, pair, at, BodyMotions{}, a, -1);
  value = acts ? a.value : 0;
  if (moved && repels) test_pair(in.gate, t.state, pair, 0);
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
  const bool last = attempt + 1 == kTrials;
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
    some = finish_trials(in, motion, unit, out) || some;
  }
  if (__syncthreads_or(some)) return;
  for (int64_t unit = first + threadIdx.x; unit < last; unit += blockDim.x) out.blocked[unit] = false;
}

}  // namespace
}  // namespace diffvbd::cuda
