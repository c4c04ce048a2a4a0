// The tries of a rigid correction (contact/rigid_tries.h) on the device: what threads do for bodies, vertices, pairs
// and scenes.
#pragma once

#include "../contact/rigid_tries.h"
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
  int32_t* lead;                            // [B, bodies] who they are
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
  if (a < 0 || b < 0) return;
  unite(t.lead + first, a, b);
  PairPress press;
  if (!repels || !barrier_press(in, pair, CornerPoints<T>{in, false}, press)) return;
  int32_t* to = t.touching + 2 * (in.first_listed(scene) + atomicAdd(t.touches + scene, 1));
  to[0] = a, to[1] = b;
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

// And a pair, of those that it moves with: a near one, or a lagged one.
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

// Whether bodies may go as they have tried, by the block that works on their scene; if not, what each tries next.
// Returns whether all have decided. Sums are of whole numbers, which do not depend on their order.
template <class T>
__device__ bool decide(const RigidInputs<T>& in, const Tried<T>& t, int64_t scene, int attempt) {
  const int64_t n = in.bodies(), first = scene * n;
  const auto each = [&](int64_t count, const auto& f) {
    for (int64_t i = threadIdx.x; i < count; i += blockDim.x) f(i);
  };
  const auto each_open = [&](const auto& f) {  // f(its number, that of the first of those it decides with)
    each(n, [&](int64_t k) {
      if (in.free[k] && !t.decided[first + k]) f(first + k, first + root_of(t.lead + first, static_cast<int32_t>(k)));
    });
  };
  each(n, [&](int64_t k) { t.largest[first + k] = t.rise[first + k] = t.whole[first + k] = t.stopped[first + k] = 0; });
  __syncthreads();
  each_open([&](int64_t k, int64_t of) {
    const double own = fmax(fabs(t.before[k]), fabs(t.after[k]));
    raise(t.largest + of, bits_of(isfinite(t.before[k]) && isfinite(t.after[k]) ? own : CUDART_INF));
    if (t.state.blocked[k]) mark(t.stopped + of);
  });
  __syncthreads();
  each_open([&](int64_t k, int64_t of) {
    const double parts = kParts / __longlong_as_double(static_cast<long long>(t.largest[of]));
    if (!(0 < parts && parts < CUDART_INF)) return;
    atomicAdd(t.rise + of, static_cast<Count>(__double2ll_rn(parts * (t.after[k] - t.before[k]))));
    atomicAdd(t.whole + of, static_cast<Count>(__double2ll_rn(parts * t.before[k])));
  });
  __syncthreads();
  bool open = false;
  const bool last = attempt + 1 == kTries;
  each_open([&](int64_t k, int64_t of) {
    const bool fits = !t.stopped[of], finite = t.largest[of] < bits_of(CUDART_INF);
    const auto before = static_cast<long long>(t.whole[of]), rise = static_cast<long long>(t.rise[of]);
    if (finite && is_safe(static_cast<double>(before), static_cast<double>(before + rise), fits)) {
      t.decided[k] = 1;
    } else {
      t.low[k] = last ? 0.0 : shortened(t.state.blocked[k], fits, attempt);
      t.state.blocked[k] = 0;
      open = true;
    }
  });
  if (!__syncthreads_or(open)) return true;
  const int32_t* touching = t.touching + 2 * in.first_listed(scene);
  for (int spread = 0; spread < kSpreads && !last; ++spread) {
    each_open([&](int64_t k, int64_t) { t.next[k] = t.low[k]; });
    __syncthreads();
    each(t.touches[scene], [&](int64_t i) {
      const int64_t a = first + touching[2 * i], b = first + touching[2 * i + 1];
      if (t.decided[a]) return;  // both have
      const Count both = bits_of(fmin(t.low[a], t.low[b]));
      for (const int64_t k : {a, b}) lower(reinterpret_cast<Count*>(t.next + k), both);
    });
    __syncthreads();
    each_open([&](int64_t k, int64_t) { t.low[k] = t.next[k]; });
    __syncthreads();
  }
  each_open([&](int64_t k, int64_t) { t.share[k] *= t.low[k]; });
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

}  // namespace
}  // namespace diffvbd::cuda
