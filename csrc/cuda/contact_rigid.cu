// The rigid correction where many bodies are solved for together: most work on a scene is shared by several blocks.
#include <algorithm>
#include <vector>

#include "../contact/rigid_slip.h"
#include "contact_rigid.cuh"

namespace diffvbd::cuda {
namespace {

constexpr unsigned kAll = 0xffffffffu;
constexpr int kAsked = 12;               // iterations after which the host asks whether all is done,
constexpr int kCapturedIterations = 32;  // which it cannot while a graph is captured: that has so many

// Calls f(row, side), with all lanes of a warp, for the sides that a body has of pairs which act; warps share its
// vertices, and each meets them in ascending order.
template <class T, class F>
__device__ void each_row(const RigidInputs<T>& in, const PairRoom& room, const int32_t* bodies, const Body<T>& body,
                         int warp, int warps, const F& f) {
  for (int which = 0; which < (in.lag ? 2 : 1); ++which) {
    const PairList& list = which == 0 ? in.gate.listed : in.lagged;
    const int64_t before = which == 0 ? 0 : room.listed;
    for (int32_t i = warp; i < body.size(); i += warps) {
      const int64_t corner = body.scene * in.gate.corners + body.vertex(i);
      for (int32_t first = list.ptr[corner]; first < list.ptr[corner + 1]; first += 32) {
        const int32_t own = first + static_cast<int32_t>(threadIdx.x % 32);
        const int32_t entry = own < list.ptr[corner + 1] ? list.entry[own] : 3;
        const int side = side_of(list, bodies + 2 * before, entry, body.body);
        unsigned found = __ballot_sync(kAll, 0 <= side);
        while (found != 0) {
          const int lane = __ffs(static_cast<int>(found)) - 1;
          found &= found - 1;
          f(before + __shfl_sync(kAll, entry >> 2, lane), __shfl_sync(kAll, side, lane));
        }
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
                const double* slid, const uint8_t* state, double* center, double* gradient, double* matrix) {
  __shared__ double part[kWarps][kMostSums];
  const int32_t n = in.bodies(), k = static_cast<int32_t>(blockIdx.x % n);
  const int64_t scene = blockIdx.x / n, row = blockIdx.x;
  if (is_done(state, scene)) return;
  const Body<T> body{in.scene, scene, k};
  const BlockTeam team{part};
  const Whole whole = whole_of(body, team);
  const bool free = in.free[k] && 0 < whole.mass;
  const Vector c = whole.center;
  constexpr int kOwn = kUnknowns + rigid::kSix;
  double total[kOwn + 1];  // and the sum of m r^2
  team.template sum<kOwn + 1>(free ? body.size() : 0, total, [&](int32_t i, double* out) {
    const int32_t v = body.vertex(i);
    Vector g;
    Sym3<double> H;
    vertex_press(in, body, v, g, H);
    const Vector arm = body.position(v) - c;
    add_floor_friction(in, body, v, slid ? moved_by(slid + kUnknowns * row, arm) : Vector{}, g, H);
    rigid::add_vertex(arm, g, H, out, out + kUnknowns);
    out[kOwn] += body.mass(v) * dot(arm, arm);
  });
  // each lane has one number of the pairs' part
  const int lane = threadIdx.x % 32, warp = threadIdx.x / 32;
  int i = 0, j = 0;
  if (kUnknowns <= lane && lane < kMostSums - 1) unpack(lane - kUnknowns, i, j);
  double own = 0;
  if (free) {
    each_row(in, room, sides, body, warp, kWarps, [&](int64_t at, int side) {
      const PairPress a = load_press(press + kPressDoubles * at, sides + 2 * at);
      if (lane < kUnknowns) {
        own += a.gradient(side, lane, c);
      } else if (lane < kOwn) {
        own += a.block(side, i, j, c);
      }
    });
  }
  __syncthreads();
  if (lane < kOwn) part[warp][lane] = own;
  __syncthreads();
  if (threadIdx.x >= kOwn) return;
  double sum = 0;
#pragma unroll
  for (int e = 0; e < kOwn; ++e) {
    if (e == lane) sum = total[e];
  }
  for (int w = 0; w < kWarps; ++w) sum += part[w][lane];
  if (lane == 0) center[3 * row] = c.x, center[3 * row + 1] = c.y, center[3 * row + 2] = c.z;
  if (lane < kUnknowns) {
    gradient[kUnknowns * row + lane] = sum;
    return;
  }
  const MatrixPart to(matrix + in.matrix_size() * scene, n, true, k, k);
  if (i == j) sum += free ? kLeastInertia * (i < 3 ? total[kOwn] : whole.mass) : 1;
  to(i, j) = to(j, i) = sum;
}

// A warp for each body of each scene: the parts of the matrix between it and those after it.
template <class T>
__global__ void __launch_bounds__(32)
    between_kernel(const __grid_constant__ RigidInputs<T> in, PairRoom room, const int32_t* sides, const double* press,
                   const uint8_t* state, const double* center, double* matrix) {
  extern __shared__ double cells[];  // [bodies, 36]
  const int32_t n = in.bodies(), k = static_cast<int32_t>(blockIdx.x % n);
  const int64_t scene = blockIdx.x / n;
  if (is_done(state, scene)) return;
  for (int32_t e = threadIdx.x; e < 36 * n; e += 32) cells[e] = 0;
  __syncwarp();
  const Vector c = vector_of(center + 3 * (scene * n + k));
  each_row(in, room, sides, Body<T>{in.scene, scene, k}, 0, 1, [&](int64_t at, int side) {
    const int32_t other = sides[2 * at + 1 - side];
    if (other <= k) return;
    const PairPress a = load_press(press + kPressDoubles * at, sides + 2 * at);
    const Vector d = vector_of(center + 3 * (scene * n + other));
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

// y += A x for each of the systems.
template <class T>
__global__ void __launch_bounds__(kOne) product_kernel(const __grid_constant__ RigidInputs<T> in, const uint8_t* state,
                                                       const double* matrix, const double* x, double* y) {
  const int64_t row = own_item(), size = in.system_size();
  if (row >= in.systems() * size || is_done(state, row / size)) return;
  const double *a = matrix + size * row, *own = x + row / size * size;
  double sum = 0;
  for (int64_t j = 0; j < size; ++j) sum += a[j] * own[j];
  y[row] += sum;
}

// Of a system, half of which is what a step lowers its potential by.
__device__ __forceinline__ double energy_of(const BlockTeam& team, const double* factor, int64_t size, const double* x,
                                            const double* more) {
  double total[1];
  team.template sum<1>(static_cast<int32_t>(size), total, [&](int32_t j, double* out) {
    double sum = 0;
    for (int64_t i = j; i < size; ++i) sum += factor[size * i + j] * (more ? x[i] + more[i] : x[i]);
    out[0] += sum * sum;
  });
  return total[0];
}

// A block for each scene: adds a share of a step of Newton's method to motions.
template <class T>
__global__ void __launch_bounds__(kThreads)
    step_kernel(const __grid_constant__ RigidInputs<T> in, const double* center, const double* factor,
                const double* step, uint8_t* state, double* motion) {
  const uint8_t was = state[blockIdx.x];
  if (was == kDone) return;
  __shared__ double part[kWarps][kMostSums];
  const BlockTeam team{part};
  const int64_t size = in.system_size(), scene = blockIdx.x;
  const double *own = factor + size * size * blockIdx.x, *to = step + size * blockIdx.x;
  const double fall = energy_of(team, own, size, to, nullptr);
  const double whole = energy_of(team, own, size, to, motion + size * blockIdx.x);
  const bool settled = fall <= kSettled * kSettled * whole;
  if (was == kSettledAt || settled) {
    for (int64_t i = threadIdx.x; i < size; i += kThreads) motion[size * blockIdx.x + i] += to[i];
    if (threadIdx.x == 0) state[blockIdx.x] = was == kSettledAt ? kDone : kSettledAt;
    return;
  }
  const Slid slid = of_scene({center, motion}, scene, in.bodies());
  const CornerPoints<T> at{in, false};
  const int64_t lagged = in.first_lagged(scene);
  const auto rubbing = static_cast<int32_t>(in.first_lagged(scene + 1) - lagged);
  const auto planes = static_cast<int32_t>(in.planes * in.scene.vertices);
  const double share = slip_share(fall, [&](double tried) {
    double sum[1];
    team.template sum<1>(planes + rubbing, sum, [&](int32_t i, double* out) {
      if (i < planes) {
        const int32_t v = i / in.planes, b = in.gate.body[v];
        const Body<T> body{in.scene, scene, b};
        if (!in.free[b] || !bears(in, body, v, i % in.planes)) return;
        const Vector arm = body.position(v) - vector_of(slid.center + 3 * b);
        const int64_t first = int64_t{kUnknowns} * b;
        out[0] += slip_line(in, body, v, i % in.planes, arm, slid.motion + first, to + first).excess(tried);
        return;
      }
      const int64_t pair = lagged + i - planes;
      PairPress a;
      if (lagged_press(in, pair, at, slid, a, -1)) out[0] += slip_line(in, pair, a, slid.center, to).excess(tried);
    });
    return sum[0];
  });
  for (int64_t i = threadIdx.x; i < size; i += kThreads) motion[size * blockIdx.x + i] += share * to[i];
}

template <class T>
__global__ void __launch_bounds__(kOne)
    keep_finite_kernel(const __grid_constant__ RigidInputs<T> in, const uint8_t* state, double* motion) {
  const int64_t row = own_item();
  if (row >= in.scene.scenes * in.bodies() || is_done(state, row / in.bodies())) return;
  keep_finite(motion + kUnknowns * row);
}

}  // namespace

template <class T>
int64_t rigid_system_bytes(const RigidInputs<T>& in, const PairRoom& room) {
  return aligned(room.rows() * 2 * sizeof(int32_t)) + aligned(room.rows() * kPressDoubles * sizeof(double)) +
         aligned(in.scene.scenes * in.bodies() * kUnknowns * sizeof(double)) + aligned(in.systems());
}

template <class T>
cudaError_t rigid_system(const RigidInputs<T>& in, const PairRoom& room, double* center, double* motion, double* factor,
                         void* workspace, cudaStream_t stream) {
  const int64_t bodies = in.scene.scenes * in.bodies(), unknowns = bodies * kUnknowns;
  if (bodies == 0) return cudaSuccess;
  auto* next = static_cast<uint8_t*>(workspace);
  const auto take = [&](int64_t bytes) {
    uint8_t* here = next;
    next += aligned(bytes);
    return here;
  };
  auto* sides = reinterpret_cast<int32_t*>(take(room.rows() * 2 * sizeof(int32_t)));
  auto* press = reinterpret_cast<double*>(take(room.rows() * kPressDoubles * sizeof(double)));
  auto* step = reinterpret_cast<double*>(take(unknowns * sizeof(double)));
  uint8_t* state = take(in.systems());
  const bool rubs = in.rubs();
  if (in.system_size() <= kUnknowns * kFew) {
    if (room.rows() > 0)
      press_kernel<T><<<blocks_for(room.rows()), kOne, 0, stream>>>(in, room, Slid{}, nullptr, sides, press);
    return solve_few<T>(in, room, sides, press, center, motion, factor, stream);
  }
  if (rubs) {
    if (auto error = cudaMemsetAsync(motion, 0, unknowns * sizeof(double), stream)) return error;
    if (auto error = cudaMemsetAsync(state, kOnItsWay, in.systems(), stream)) return error;
  } else {
    step = motion, state = nullptr;
  }
  cudaStreamCaptureStatus capture = cudaStreamCaptureStatusNone;
  if (auto error = cudaStreamIsCapturing(stream, &capture)) return error;
  const bool asks = capture == cudaStreamCaptureStatusNone;
  const int most = !rubs ? 1 : asks ? kSlipIterations : kCapturedIterations;
  for (int iteration = 0; iteration < most; ++iteration) {
    if (asks && iteration > 0 && iteration % kAsked == 0) {
      std::vector<uint8_t> states(in.systems());
      const auto way = cudaMemcpyDeviceToHost;
      if (auto error = cudaMemcpyAsync(states.data(), state, states.size(), way, stream)) return error;
      if (auto error = cudaStreamSynchronize(stream)) return error;
      if (std::all_of(states.begin(), states.end(), [](uint8_t s) { return s == kDone; })) break;
    }
    const Slid slid = iteration > 0 ? Slid{center, motion} : Slid{};
    if (room.rows() > 0)
      press_kernel<T><<<blocks_for(room.rows()), kOne, 0, stream>>>(in, room, slid, state, sides, press);
    const auto blocks = static_cast<unsigned>(bodies);
    body_kernel<T><<<blocks, kThreads, 0, stream>>>(in, room, sides, press, slid.motion, state, center, step, factor);
    const size_t cells = 36 * in.bodies() * sizeof(double);
    between_kernel<T><<<blocks, 32, cells, stream>>>(in, room, sides, press, state, center, factor);
    if (iteration > 0) product_kernel<T><<<blocks_for(unknowns), kOne, 0, stream>>>(in, state, factor, motion, step);
    if (auto error = cholesky(in.systems(), in.system_size(), factor, stream, state)) return error;
    if (auto error = cholesky_solve(in.systems(), in.system_size(), factor, step, stream, state)) return error;
    keep_finite_kernel<T><<<blocks_for(bodies), kOne, 0, stream>>>(in, state, step);
    if (rubs) {
      const auto systems = static_cast<unsigned>(in.systems());
      step_kernel<T><<<systems, kThreads, 0, stream>>>(in, center, factor, step, state, motion);
    }
  }
  return cudaGetLastError();
}

#define DIFFVBD_INSTANTIATE(T)                                                                                   \
  template int64_t rigid_system_bytes<T>(const RigidInputs<T>&, const PairRoom&);                                \
  template cudaError_t rigid_system<T>(const RigidInputs<T>&, const PairRoom&, double*, double*, double*, void*, \
                                       cudaStream_t);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd::cuda
