#include "contact_rigid.cuh"

namespace diffvbd::cuda {
namespace {

constexpr unsigned kAll = 0xffffffffu;

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
  constexpr int kOwn = kUnknowns + rigid::kSix;
  double total[kOwn + 1];  // and the sum of m r^2
  team.template sum<kOwn + 1>(free ? body.size() : 0, total, [&](int32_t i, double* out) {
    const int32_t v = body.vertex(i);
    Vector g;
    Sym3<double> H;
    vertex_press(in, body, v, g, H);
    const Vector arm = body.position(v) - c;
    rigid::add_vertex(arm, g, H, out, out + kUnknowns);
    out[kOwn] += body.mass(v) * dot(arm, arm);
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
          } else if (lane < kOwn) {
            own += borne(a, together) * a.block(side, i, j, c);
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
  const MatrixPart to(matrix + in.matrix_size() * scene, n, together, k, k);
  if (i == j) sum += free ? kLeastInertia * (i < 3 ? total[kOwn] : mass) : 1;
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

template <class T>
__global__ void __launch_bounds__(kOne) keep_finite_kernel(const __grid_constant__ RigidInputs<T> in, double* motion) {
  const int64_t row = own_item();
  if (row < in.scene.scenes * in.bodies()) keep_finite(motion + kUnknowns * row);
}

}  // namespace

template <class T>
int64_t rigid_system_bytes(const RigidInputs<T>&, const PairRoom& room) {
  return aligned(room.rows() * 2 * sizeof(int32_t)) + aligned(room.rows() * kPressDoubles * sizeof(double));
}

template <class T>
cudaError_t rigid_system(const RigidInputs<T>& in, const PairRoom& room, double* center, double* motion, double* factor,
                         void* workspace, cudaStream_t stream) {
  const int64_t bodies = in.scene.scenes * in.bodies();
  if (bodies == 0) return cudaSuccess;
  auto* sides = static_cast<int32_t*>(workspace);
  auto* press =
      reinterpret_cast<double*>(static_cast<uint8_t*>(workspace) + aligned(room.rows() * 2 * sizeof(int32_t)));
  if (room.rows() > 0) press_kernel<T><<<blocks_for(room.rows()), kOne, 0, stream>>>(in, room, sides, press);
  const auto blocks = static_cast<unsigned>(bodies);
  body_kernel<T><<<blocks, kThreads, 0, stream>>>(in, room, sides, press, center, motion, factor);
  if (in.together() && in.bodies() > 1) {
    const size_t cells = 36 * in.bodies() * sizeof(double);
    between_kernel<T><<<blocks, 32, cells, stream>>>(in, room, sides, press, center, factor);
  }
  if (auto error = cholesky(in.systems(), in.system_size(), factor, stream)) return error;
  if (auto error = cholesky_solve(in.systems(), in.system_size(), factor, motion, stream)) return error;
  keep_finite_kernel<T><<<blocks_for(bodies), kOne, 0, stream>>>(in, motion);
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
