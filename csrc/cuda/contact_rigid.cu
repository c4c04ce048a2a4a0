#include <algorithm>

#include "bodies.cuh"
#include "contact_rigid.h"
#include "ordered.cuh"

namespace diffvbd::cuda {
namespace {

using namespace contact;
using rigid::Body;

constexpr int kOne = 128;                // threads of a block where each has an item of its own
constexpr int64_t kItemsOfBlock = 2048;  // of the potential of a scene, that one block adds up
constexpr int64_t kMostBlocks = 64;      // that add up one scene
constexpr unsigned kAll = 0xffffffffu;

unsigned blocks_for(int64_t items) { return static_cast<unsigned>((items + kOne - 1) / kOne); }
__device__ __forceinline__ int64_t own_item() { return static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x; }
__device__ __forceinline__ Vector vector_of(const double* a) { return {a[0], a[1], a[2]}; }

// What the pairs of all scenes press: bodies [rows, 2], -1 where nothing moves, and the rest, unless null. The listed
// come first.
template <class T>
__global__ void __launch_bounds__(kOne)
    press_kernel(const __grid_constant__ RigidInputs<T> in, PairRoom room, int32_t* sides, double* press) {
  const int64_t row = own_item();
  if (row >= room.listed + room.lagged) return;
  const CornerPoints<T> at{in, false};
  PairPress a;
  a.body[0] = a.body[1] = -1;
  bool acts = false;
  if (row < room.listed) {
    acts = row < in.first_listed(in.scene.scenes) && barrier_press(in, row, at, a);
  } else {
    const int64_t pair = row - room.listed;
    acts = pair < in.first_lagged(in.scene.scenes) && lagged_press(in, pair, at, a);
  }
  sides[2 * row] = acts ? a.body[0] : -1;
  sides[2 * row + 1] = acts ? a.body[1] : -1;
  if (acts && press) store_press(a, press + kPressDoubles * row);
}

// Calls f(row), with all lanes of a warp, for the rows of a scene that `wanted`(row) names; in ascending order for each
// of the warps that share them.
template <class T, class Wanted, class F>
__device__ void each_row(const RigidInputs<T>& in, const PairRoom& room, int64_t scene, int warp, int warps,
                         const Wanted& wanted, const F& f) {
  const int64_t begins[] = {in.first_listed(scene), room.listed + in.first_lagged(scene)};
  const int64_t ends[] = {in.first_listed(scene + 1), room.listed + in.first_lagged(scene + 1)};
  for (int list = 0; list < 2; ++list) {
    for (int64_t first = begins[list] + 32 * warp; first < ends[list]; first += 32 * warps) {
      const int64_t own = first + threadIdx.x % 32;
      unsigned found = __ballot_sync(kAll, own < ends[list] && wanted(own));
      while (found != 0) {
        const int lane = __ffs(static_cast<int>(found)) - 1;
        found &= found - 1;
        f(first + lane);
      }
    }
  }
}

__device__ __forceinline__ void unpack(int packed, int& i, int& j) {
  i = 0;
  while (rigid::at6(i + 1, 0) <= packed) ++i;
  j = packed - rigid::at6(i, 0);
}

// A block for each body of each scene: center, gradient, and what it adds to the diagonal of the matrix.
template <class T>
__global__ void __launch_bounds__(kThreads)
    body_kernel(const __grid_constant__ RigidInputs<T> in, PairRoom room, const int32_t* sides, const double* press,
                double* center, double* gradient, double* matrix) {
  __shared__ double part[kWarps][kMostSums];
  const int32_t n = in.bodies(), k = static_cast<int32_t>(blockIdx.x % n);
  const int64_t scene = blockIdx.x / n, row = blockIdx.x;
  const Body<T> body{in.scene, scene, k};
  const BlockTeam team{part};
  double sums[4];
  team.template sum<4>(body.size(), sums, [&](int32_t i, double* out) {
    const int32_t v = body.vertex(i);
    const double m = body.mass(v);
    const Vector x = body.position(v);
    out[0] += m, out[1] += m * x.x, out[2] += m * x.y, out[3] += m * x.z;
  });
  const double mass = sums[0];
  const bool free = in.free[k] && 0 < mass, together = in.together();
  const Vector c = 0 < mass ? (1 / mass) * Vector{sums[1], sums[2], sums[3]} : Vector{};
  double total[kUnknowns + rigid::kSix];
  team.template sum<kUnknowns + rigid::kSix>(free ? body.size() : 0, total, [&](int32_t i, double* out) {
    const int32_t v = body.vertex(i);
    Vector g;
    Sym3<double> H;
    vertex_press(in, body, v, g, H);
    rigid::add_vertex(body.position(v) - c, g, H, out, out + kUnknowns);
  });
  // each lane has one number of the pairs' part
  const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
  int i = 0, j = 0;
  if (kUnknowns <= lane && lane < kMostSums - 1) unpack(lane - kUnknowns, i, j);
  double own = 0;
  if (free) {
    each_row(
        in, room, scene, warp, kWarps, [&](int64_t at) { return sides[2 * at] == k || sides[2 * at + 1] == k; },
        [&](int64_t at) {
          const PairPress a = load_press(press + kPressDoubles * at, sides + 2 * at);
          const int side = a.body[0] == k ? 0 : 1;
          if (lane < kUnknowns) {
            own += a.gradient(side, lane, c);
          } else if (lane < kUnknowns + rigid::kSix) {
            own += borne(a, together) * a.block(side, i, j, c);
          }
        });
  }
  __syncthreads();
  if (lane < kUnknowns + rigid::kSix) part[warp][lane] = own;
  __syncthreads();
  if (threadIdx.x >= kUnknowns + rigid::kSix) return;
  double sum = 0;
#pragma unroll
  for (int e = 0; e < kUnknowns + rigid::kSix; ++e) {
    if (e == lane) sum = total[e];
  }
  for (int w = 0; w < kWarps; ++w) sum += part[w][lane];
  if (lane == 0) center[3 * row] = c.x, center[3 * row + 1] = c.y, center[3 * row + 2] = c.z;
  if (lane < kUnknowns) {
    gradient[kUnknowns * row + lane] = sum;
    return;
  }
  const MatrixPart to(matrix + in.matrix_size() * scene, n, together, k, k);
  if (i == j) sum += free ? kLeastMass * mass : 1;
  to(i, j) = to(j, i) = sum;
}

// A warp for each body of each scene: the parts of the matrix between it and those after it.
template <class T>
__global__ void __launch_bounds__(32)
    between_kernel(const __grid_constant__ RigidInputs<T> in, PairRoom room, const int32_t* sides, const double* press,
                   const double* center, double* matrix) {
  extern __shared__ double cells[];  // [bodies, 36]
  const int32_t n = in.bodies(), k = static_cast<int32_t>(blockIdx.x % n);
  const int64_t scene = blockIdx.x / n;
  for (int32_t e = threadIdx.x; e < 36 * n; e += 32) cells[e] = 0;
  __syncwarp();
  each_row(
      in, room, scene, 0, 1,
      [&](int64_t at) {
        const int32_t one = sides[2 * at], two = sides[2 * at + 1];
        return one >= 0 && two >= 0 && min(one, two) == k;
      },
      [&](int64_t at) {
        const PairPress a = load_press(press + kPressDoubles * at, sides + 2 * at);
        const int side = a.body[0] == k ? 0 : 1;
        const int32_t other = a.body[1 - side];
        const Vector c = vector_of(center + 3 * (scene * n + k)), d = vector_of(center + 3 * (scene * n + other));
        for (int32_t e = threadIdx.x; e < 36; e += 32) {
          cells[36 * other + e] += dot(a.map(side, e / 6, c), a.stiffness * a.map(1 - side, e % 6, d));
        }
      });
  __syncwarp();
  for (int32_t other = k + 1; other < n; ++other) {
    const MatrixPart upper(matrix + in.matrix_size() * scene, n, true, k, other);
    const MatrixPart lower(matrix + in.matrix_size() * scene, n, true, other, k);
    for (int32_t e = threadIdx.x; e < 36; e += 32) {
      const double value = cells[36 * other + e];
      upper(e / 6, e % 6) = value, lower(e % 6, e / 6) = value;
    }
  }
}

// What the tries of all scenes have in common.
template <class T>
struct Tried {
  const double *center, *motion;
  double *share, *low, *next;  // [B, bodies]
  double *before, *after;      // [B, blocks]  parts of the potential
  const int32_t* sides;        // [listed, 2]
  AdvanceState<T> state;
  uint8_t* done;  // [B]
  T* move;
  int64_t blocks;
};

template <class T>
__global__ void __launch_bounds__(kOne)
    begin_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ Tried<T> t) {
  const int64_t i = own_item();
  if (i < in.scene.scenes) t.done[i] = 0;
  if (i >= in.scene.scenes * in.bodies()) return;
  t.share[i] = 1;
  t.state.share[i] = T(0), t.state.now[i] = T(1);
  t.state.blocked[i] = t.state.stamp[i] = 0;
}

template <class T>
__global__ void __launch_bounds__(kOne)
    displace_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ Tried<T> t, T* x) {
  const int64_t row = own_item();
  if (row >= in.scene.scenes * in.scene.vertices) return;
  const int64_t scene = row / in.scene.vertices;
  const auto v = static_cast<int32_t>(row % in.scene.vertices);
  const int64_t body = scene * in.bodies() + in.gate.body[v];
  const Vector r = Body<T>::at(in.scene.x + 3 * row) - vector_of(t.center + 3 * body);
  rigid::put(t.move + 3 * row, displaced(t.motion + kUnknowns * body, t.share[body], r));
  if (!x) return;
  for (int c = 0; c < 3; ++c) x[3 * row + c] = in.scene.x[3 * row + c] + t.move[3 * row + c];
}

// Marks the bodies that a pair, a room or an energy does not let pass.
template <class T>
__global__ void __launch_bounds__(kOne)
    test_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ Tried<T> t) {
  const int64_t item = own_item(), rows = in.scene.scenes * in.scene.vertices;
  if (item < rows) {
    const int64_t scene = item / in.scene.vertices;
    const auto v = static_cast<int32_t>(item % in.scene.vertices);
    const int32_t body = in.gate.body[v];
    if (t.done[scene] || !in.free[body]) return;
    stay(in.gate, t.state, item, 0);
    if (!admitted(in, Body<T>{in.scene, scene, body}, v)) mark(t.state.blocked + scene * in.bodies() + body);
    return;
  }
  const int64_t pair = item - rows;
  if (pair >= in.first_listed(in.scene.scenes) || t.done[in.gate.listed.pairs[kPairRow * pair + 5]]) return;
  if (is_between(in, pair)) try_pair(in.gate, t.state, pair, 0);
}

// A block of the potential of a scene.
template <class T>
__global__ void __launch_bounds__(kThreads)
    potential_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ Tried<T> t, bool moved,
                     double* out) {
  __shared__ double part[kWarps][kMostSums];
  const int64_t scene = blockIdx.y;
  if (t.done[scene]) return;
  const BlockTeam team{part};
  const CornerPoints<T> at{in, moved};
  const int64_t step = gridDim.x, vertices = in.scene.vertices, listed = in.first_listed(scene);
  const int64_t lagged = in.first_lagged(scene), repelling = in.first_listed(scene + 1) - listed;
  const int64_t items = vertices + repelling + in.first_lagged(scene + 1) - lagged;
  const auto own = static_cast<int32_t>((items + step - 1 - blockIdx.x) / step);
  double sum[1];
  team.template sum<1>(own, sum, [&](int32_t i, double* to) {
    const int64_t item = blockIdx.x + step * i;
    if (item < vertices) {
      const auto v = static_cast<int32_t>(item);
      const int32_t body = in.gate.body[v];
      if (in.free[body]) to[0] += vertex_value(in, Body<T>{in.scene, scene, body}, v, moved);
      return;
    }
    PairPress a;
    const int64_t pair = item - vertices;
    const bool acts =
        pair < repelling ? barrier_press(in, listed + pair, at, a) : lagged_press(in, lagged + pair - repelling, at, a);
    if (acts) to[0] += a.value;
  });
  if (threadIdx.x == 0) out[scene * step + blockIdx.x] = sum[0];
}

// A block for each scene: whether it may go as it has tried, and what each body tries next.
template <class T>
__global__ void __launch_bounds__(kOne)
    decide_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ Tried<T> t, int attempt) {
  const int64_t scene = blockIdx.x, n = in.bodies(), first = scene * n;
  if (t.done[scene]) return;
  const auto each = [&](int64_t count, const auto& f) {
    for (int64_t i = threadIdx.x; i < count; i += kOne) f(i);
  };
  bool stopped = false;
  each(n, [&](int64_t k) { stopped = stopped || t.state.blocked[first + k]; });
  const bool fits = !__syncthreads_or(stopped);
  double before = 0, after = 0;
  for (int64_t i = 0; i < t.blocks; ++i) {
    before += t.before[scene * t.blocks + i];
    after += t.after[scene * t.blocks + i];
  }
  if (is_safe(before, after, fits)) {
    __syncthreads();  // everyone has asked whether it is done
    if (threadIdx.x == 0) t.done[scene] = 1;
    return;
  }
  const bool last = attempt + 1 == kTries;
  each(n, [&](int64_t k) {
    t.low[first + k] = last ? 0.0 : shortened(t.state.blocked[first + k], fits, attempt);
    t.state.blocked[first + k] = 0;
  });
  const int64_t begin = in.first_listed(scene), pairs = in.first_listed(scene + 1) - begin;
  for (int spread = 0; spread < kSpreads && !last; ++spread) {
    __syncthreads();
    each(n, [&](int64_t k) { t.next[first + k] = t.low[first + k]; });
    __syncthreads();
    each(pairs, [&](int64_t i) {
      const int32_t a = t.sides[2 * (begin + i)], b = t.sides[2 * (begin + i) + 1];
      if (a < 0 || b < 0) return;
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
}

constexpr int64_t aligned(int64_t bytes) { return (bytes + 15) / 16 * 16; }

template <class T>
int64_t potential_blocks(const RigidInputs<T>& in, const PairRoom& room) {
  const int64_t items = in.scene.vertices + room.rows() / std::max<int64_t>(1, in.scene.scenes);
  return std::clamp<int64_t>((items + kItemsOfBlock - 1) / kItemsOfBlock, 1, kMostBlocks);
}

}  // namespace

template <class T>
int64_t rigid_system_bytes(const RigidInputs<T>&, const PairRoom& room) {
  return aligned(room.rows() * 2 * sizeof(int32_t)) + aligned(room.rows() * kPressDoubles * sizeof(double));
}

template <class T>
int64_t rigid_move_bytes(const RigidInputs<T>& in, const PairRoom& room) {
  const int64_t units = in.scene.scenes * in.bodies(), parts = in.scene.scenes * potential_blocks(in, room);
  return aligned(room.rows() * 2 * sizeof(int32_t)) + 2 * aligned(units * sizeof(double)) +
         2 * aligned(parts * sizeof(double)) + 2 * aligned(units * sizeof(T)) + 2 * aligned(units) +
         aligned(in.scene.scenes);
}

template <class T>
cudaError_t rigid_system(const RigidInputs<T>& in, const PairRoom& room, double* center, double* gradient,
                         double* matrix, void* workspace, cudaStream_t stream) {
  const int64_t bodies = in.scene.scenes * in.bodies();
  if (bodies == 0) return cudaSuccess;
  auto* sides = static_cast<int32_t*>(workspace);
  auto* press =
      reinterpret_cast<double*>(static_cast<uint8_t*>(workspace) + aligned(room.rows() * 2 * sizeof(int32_t)));
  if (room.rows() > 0) press_kernel<T><<<blocks_for(room.rows()), kOne, 0, stream>>>(in, room, sides, press);
  const auto blocks = static_cast<unsigned>(bodies);
  body_kernel<T><<<blocks, kThreads, 0, stream>>>(in, room, sides, press, center, gradient, matrix);
  if (in.together() && in.bodies() > 1) {
    const size_t cells = 36 * in.bodies() * sizeof(double);
    between_kernel<T><<<blocks, 32, cells, stream>>>(in, room, sides, press, center, matrix);
  }
  return cudaGetLastError();
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
  auto* sides = reinterpret_cast<int32_t*>(take(room.rows() * 2 * sizeof(int32_t)));
  Tried<T> t{};
  t.center = center, t.motion = motion, t.share = share, t.sides = sides, t.move = move;
  t.blocks = potential_blocks(in, room);
  t.low = numbers(units), t.next = numbers(units);
  t.before = numbers(scenes * t.blocks), t.after = numbers(scenes * t.blocks);
  t.state.share = reinterpret_cast<T*>(take(units * sizeof(T)));
  t.state.now = reinterpret_cast<T*>(take(units * sizeof(T)));
  t.state.blocked = take(units), t.state.stamp = take(units), t.done = take(scenes);
  if (room.rows() > 0) press_kernel<T><<<blocks_for(room.rows()), kOne, 0, stream>>>(in, room, sides, nullptr);
  begin_kernel<T><<<blocks_for(std::max(units, scenes)), kOne, 0, stream>>>(in, t);
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

#define DIFFVBD_INSTANTIATE(T)                                                                                   \
  template int64_t rigid_system_bytes<T>(const RigidInputs<T>&, const PairRoom&);                                \
  template int64_t rigid_move_bytes<T>(const RigidInputs<T>&, const PairRoom&);                                  \
  template cudaError_t rigid_system<T>(const RigidInputs<T>&, const PairRoom&, double*, double*, double*, void*, \
                                       cudaStream_t);                                                            \
  template cudaError_t rigid_move<T>(const RigidInputs<T>&, const PairRoom&, const double*, const double*, T*,   \
                                     double*, T*, void*, cudaStream_t);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd::cuda
