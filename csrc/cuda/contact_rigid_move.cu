#include <algorithm>

#include "../contact/rigid_tries.h"
#include "contact_rigid.cuh"
#include "ordered.cuh"
#include "small_scenes.h"
#include "union.cuh"

namespace diffvbd::cuda {
namespace {

constexpr int64_t kLargeBody = 32;  // vertices from which a block adds up a body, and not a warp
constexpr int kLanes = 8;           // threads that share the pairs of a vertex
constexpr double kParts = 0x1p40;   // of the largest number of a sum in whole numbers, which has up to 2^20 of them

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
  uint8_t *decided, *stopped, *done;  // [B, bodies] twice, [B]
  T* move;
};

template <class T>
__global__ void __launch_bounds__(kOne)
    begin_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ Tried<T> t) {
  const int64_t i = own_item();
  if (i < in.scene.scenes) t.done[i] = 0, t.touches[i] = t.nears[i] = 0;
  if (i >= in.scene.scenes * in.bodies()) return;
  t.share[i] = 1;
  t.way[i] = t.size[i] = 0;
  t.lead[i] = static_cast<int32_t>(i % in.bodies());
  t.decided[i] = 0;
  t.state.share[i] = T(0), t.state.now[i] = T(1);
  t.state.blocked[i] = t.state.stamp[i] = 0;
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
__global__ void __launch_bounds__(kOne)
    way_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ Tried<T> t) {
  const int64_t row = own_item();
  if (row >= in.scene.scenes * in.scene.vertices) return;
  const Vertex<T> at(in, row);
  const Body<T> body{in.scene, at.scene, at.body};
  const Farthest own = farthest_of(in, body, at.v, t.center + 3 * at.unit, t.motion + kUnknowns * at.unit);
  raise_to(t.way + at.unit, own.way), raise_to(t.size + at.unit, own.size);
}

// Which pairs may press, and who decides together: their order does not matter.
template <class T>
__global__ void __launch_bounds__(kOne)
    join_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ Tried<T> t, int64_t listed) {
  const int64_t item = own_item();
  const bool repels = item < listed;
  const int64_t pair = repels ? item : item - listed;
  if (pair >= (repels ? in.first_listed(in.scene.scenes) : in.first_lagged(in.scene.scenes))) return;
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
  if (!x) return;
  for (int c = 0; c < 3; ++c) x[3 * row + c] = in.scene.x[3 * row + c] + t.move[3 * row + c];
}

template <class T>
__global__ void __launch_bounds__(kOne)
    displace_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ Tried<T> t, T* x) {
  const int64_t row = own_item();
  if (row < in.scene.scenes * in.scene.vertices) displace(in, t, row, x);
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
  stay(in.gate, t.state, row, 0);
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

// A block for each scene.
template <class T>
__global__ void __launch_bounds__(kOne)
    decide_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ Tried<T> t, int attempt) {
  if (t.done[blockIdx.x]) return;
  const bool done = decide(in, t, blockIdx.x, attempt);
  __syncthreads();  // everyone has asked whether it is done
  if (done && threadIdx.x == 0) t.done[blockIdx.x] = 1;
}

// All tries of a small scene: a block.
template <class T>
__global__ void __launch_bounds__(kThreads)
    scene_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ Tried<T> t, int64_t listed, T* x) {
  __shared__ double part[kWarps][kMostSums];
  const BlockTeam team{part};
  const int64_t scene = blockIdx.x, first = scene * in.scene.vertices;
  const auto vertices = static_cast<int32_t>(in.scene.vertices);
  const bool few = in.bodies() < kWarps;
  bool moves = false;
  const double* motions = t.motion + kUnknowns * scene * in.bodies();
  team.each(kUnknowns * in.bodies(), [&](int32_t i) { moves = moves || motions[i] != 0; });
  if (!__syncthreads_or(moves)) {  // a captured step makes all of its corrections, most of which move nothing
    team.each(vertices, [&](int32_t v) { displace(in, t, first + v, x); });
    return;
  }
  for (int attempt = -1; attempt < kTries; ++attempt) {  // -1: where they are
    const bool moved = 0 <= attempt;
    if (moved) {
      team.each(vertices, [&](int32_t v) { displace(in, t, first + v, static_cast<T*>(nullptr)); });
      team.meet();
    }
    team.each(vertices, [&](int32_t v) { try_vertex(in, t, first + v, moved); });
    const int64_t repelling = in.first_listed(scene), rubbing = in.first_lagged(scene);
    const int32_t repel = t.nears[scene];
    team.each(repel + static_cast<int32_t>(in.first_lagged(scene + 1) - rubbing), [&](int32_t i) {
      const bool repels = i < repel;
      const int64_t pair = repels ? t.near[repelling + i] : rubbing + i - repel;
      try_pair_of(in, t, pair, repels, t.press[repels ? pair : listed + pair], moved);
    });
    team.meet();
    for (int32_t k = few ? 0 : static_cast<int32_t>(threadIdx.x / 32); k < in.bodies(); k += few ? 1 : kWarps) {
      const int64_t unit = scene * in.bodies() + k;
      if (!in.free[k] || t.decided[unit]) continue;
      const double value =
          few ? potential_of(in, t, team, scene, k, listed) : potential_of(in, t, Tile<32>(), scene, k, listed);
      if (threadIdx.x % (few ? kThreads : 32) == 0) (moved ? t.after : t.before)[unit] = value;
    }
    team.meet();
    if (moved && decide(in, t, scene, attempt)) break;
    team.meet();
  }
  team.each(vertices, [&](int32_t v) { displace(in, t, first + v, x); });
}

}  // namespace

template <class T>
int64_t rigid_move_bytes(const RigidInputs<T>& in, const PairRoom& room) {
  const int64_t scenes = in.scene.scenes, units = scenes * in.bodies();
  return 9 * aligned(units * sizeof(double)) + aligned(scenes * in.scene.vertices * sizeof(double)) +
         aligned(room.rows() * sizeof(double)) + aligned(units * sizeof(int32_t)) +
         aligned(room.listed * 2 * sizeof(int32_t)) + aligned(room.listed * sizeof(int32_t)) +
         2 * aligned(scenes * sizeof(int32_t)) + 2 * aligned(units * sizeof(T)) + 4 * aligned(units) + aligned(scenes);
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
  const auto counts = [&](int64_t count) { return reinterpret_cast<Count*>(take(count * sizeof(Count))); };
  const auto whole = [&](int64_t count) { return reinterpret_cast<int32_t*>(take(count * sizeof(int32_t))); };
  Tried<T> t{};
  t.center = center, t.motion = motion, t.share = share, t.move = move;
  t.low = numbers(units), t.next = numbers(units), t.way = numbers(units), t.size = numbers(units);
  t.before = numbers(units), t.after = numbers(units);
  t.largest = counts(units), t.rise = counts(units), t.whole = counts(units);
  t.value = numbers(rows), t.press = numbers(room.rows());
  t.lead = whole(units), t.touching = whole(2 * room.listed), t.touches = whole(scenes);
  t.near = whole(room.listed), t.nears = whole(scenes);
  t.state.share = reinterpret_cast<T*>(take(units * sizeof(T)));
  t.state.now = reinterpret_cast<T*>(take(units * sizeof(T)));
  t.state.blocked = take(units), t.state.stamp = take(units);
  t.decided = take(units), t.stopped = take(units), t.done = take(scenes);
  begin_kernel<T><<<blocks_for(std::max(units, scenes)), kOne, 0, stream>>>(in, t);
  if (room.rows() > 0) {
    way_kernel<T><<<blocks_for(rows), kOne, 0, stream>>>(in, t);
    join_kernel<T><<<blocks_for(room.rows()), kOne, 0, stream>>>(in, t, room.listed);
  }
  if (has_block_each(in.scene.vertices, scenes, room.rows())) {
    scene_kernel<T><<<static_cast<unsigned>(scenes), kThreads, 0, stream>>>(in, t, room.listed, x);
    return cudaGetLastError();
  }
  const auto look = [&](bool moved, double* out) {
    try_kernel<T><<<blocks_for(rows + room.rows()), kOne, 0, stream>>>(in, t, room.listed, moved);
    if (in.scene.vertices >= kLargeBody * in.bodies()) {
      potential_kernel<T, true><<<static_cast<unsigned>(units), kThreads, 0, stream>>>(in, t, room.listed, out);
    } else {
      const auto blocks = static_cast<unsigned>((units + kWarps - 1) / kWarps);
      potential_kernel<T, false><<<blocks, kThreads, 0, stream>>>(in, t, room.listed, out);
    }
  };
  look(false, t.before);
  for (int attempt = 0; attempt < kTries; ++attempt) {
    displace_kernel<T><<<blocks_for(rows), kOne, 0, stream>>>(in, t, nullptr);
    look(true, t.after);
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
