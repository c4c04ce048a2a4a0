// Coarse correction: gradient, restriction, solve, prolongation, step length, motion; and their transposes.
#include "../subspace/coarse.h"
#include "bodies.cuh"
#include "coarse.h"
#include "common.cuh"
#include "group.cuh"

namespace diffvbd::cuda {
namespace {

constexpr int kSumThreads = 128, kManySumThreads = 1024;  // of a function, and of a part of a body
constexpr int kShortRow = 128, kLongRow = 1024;  // average positions of a function: a warp sums fewer than the first,
                                                 // many threads more than the second
constexpr int kRowThreads = 128;
constexpr int kMostSmall = 8;  // functions of a body up to which eight threads solve for an unknown; otherwise a warp

template <class T>
struct View {
  StepView<T> s;
  coarse::Inputs<T> c;
  CoarseWork<T> w;

  __device__ T* tape(int64_t scene, int k) const {
    return c.tape + ((s.base + scene) * c.corrections + k) * c.tape_size();
  }
  __device__ T* lengths(int64_t scene, int k) const { return tape(scene, k) + int64_t{3} * c.plan.functions; }
  __device__ T* solved(int64_t scene, int k) const {
    return w.solved + (scene * c.corrections + k) * 3 * c.plan.functions;
  }
};

// Sums over the threads of a block in a fixed order; thread 0 has them.
template <int threads, int n>
__device__ __forceinline__ void block_sum(double (&value)[n]) {
  __shared__ double part[threads / 32][n];
  butterfly<n, 32>(kWholeWarp, value);
  if (threadIdx.x % 32 == 0) {
    for (int k = 0; k < n; ++k) part[threadIdx.x / 32][k] = value[k];
  }
  __syncthreads();
  for (int w = 1; threadIdx.x == 0 && w < threads / 32; ++w) {
    for (int k = 0; k < n; ++k) value[k] += part[w][k];
  }
}

// Restriction of `rows` [positions, 4], a block for each function of each scene. In the reverse times minus the step
// length of its body, and 0 where the body did not move.
template <class T, int threads, bool reverse>
__global__ void __launch_bounds__(threads)
    restrict_rows(const __grid_constant__ View<T> a, int k, const T* __restrict__ rows) {
  const coarse::Plan& p = a.c.plan;
  const int64_t scene = blockIdx.x / p.functions;
  const int f = static_cast<int>(blockIdx.x - scene * p.functions);
  double sum[3] = {0, 0, 0};
  const T* from = rows + scene * a.s.positions * kRow;
  for (int e = __ldg(p.row_ptr + f) + static_cast<int>(threadIdx.x); e < __ldg(p.row_ptr + f + 1); e += threads) {
    const Vec3<T> row = load_row(from, __ldg(p.row + e), true);
    const double weight = __ldg(a.c.row_weight + e);
    sum[0] += weight * row.x, sum[1] += weight * row.y, sum[2] += weight * row.z;
  }
  block_sum<threads>(sum);
  if (threadIdx.x != 0) return;
  T* to = a.w.restricted + (scene * p.functions + f) * 3;
  if (!reverse) {
    for (int i = 0; i < 3; ++i) to[i] = T(sum[i]);
    return;
  }
  const T length = a.lengths(scene, k)[p.function_body[f]];
  for (int i = 0; i < 3; ++i) to[i] = length > 0 ? -length * T(sum[i]) : T(0);
}

// A^-1 times the restricted rows, several threads for each unknown of each scene.
template <class T, int threads, bool reverse>
__global__ void __launch_bounds__(kRowThreads) solve_rows(const __grid_constant__ View<T> a, int k) {
  const coarse::Plan& p = a.c.plan;
  const int64_t unknowns = int64_t{3} * p.functions;
  const int64_t item = own_item(kRowThreads) / threads;
  const bool exists = item < a.s.scenes * unknowns;
  const int64_t scene = exists ? item / unknowns : 0, row = exists ? item - scene * unknowns : 0;
  const int body = __ldg(p.function_body + row / 3), first = 3 * __ldg(p.function_ptr + body);
  const int n = 3 * __ldg(p.function_ptr + body + 1) - first;
  const T* inverse =
      a.w.inverse ? a.w.inverse + 9 * scene * p.cells : a.c.factor.data + (a.s.base + scene) * a.c.factor.scene;
  inverse += int64_t{9} * __ldg(p.mass_ptr + body) + (row - first) * n;
  const T* from = a.w.restricted + scene * unknowns + first;
  double sum = 0;
  for (int j = threadIdx.x % threads; j < n; j += threads) sum += double(__ldg(inverse + j)) * double(from[j]);
#pragma unroll
  for (int d = threads / 2; d > 0; d /= 2) sum += __shfl_xor_sync(kWholeWarp, sum, d, threads);
  if (!exists || threadIdx.x % threads != 0) return;
  const bool still = reverse && !(a.lengths(scene, k)[body] > 0);  // which may be NaN
  (reverse ? a.solved(scene, k) : a.tape(scene, k))[row] = still ? T(0) : T(sum);
}

// Prolongation at a position of three numbers for each function.
template <class T>
__device__ __forceinline__ Vec3<T> prolonged(const coarse::Inputs<T>& c, int64_t position, const T* of) {
  Vec3<T> sum = zero3<T>();
  for (int e = __ldg(c.plan.position_ptr + position); e < __ldg(c.plan.position_ptr + position + 1); ++e) {
    const T* a = of + 3 * __ldg(c.plan.function + e);
    sum += __ldg(c.weight + e) * Vec3<T>{a[0], a[1], a[2]};
  }
  return sum;
}

// Displacement of a correction or of its transpose.
template <class T, bool reverse>
__global__ void __launch_bounds__(kRowThreads) prolong(const __grid_constant__ View<T> a, int k) {
  const int64_t i = own_item(kRowThreads);
  if (i >= a.s.scenes * a.s.positions) return;
  const int64_t scene = i / a.s.positions;
  const Vec3<T> displacement =
      prolonged(a.c, i - scene * a.s.positions, reverse ? a.solved(scene, k) : a.tape(scene, k));
  store_row(a.w.displacement, i, reverse ? displacement : -displacement);
}

// Hessian block of the energies of a vertex.
template <class T>
__global__ void __launch_bounds__(kRowThreads)
    vertex_block_rows(const __grid_constant__ View<T> a, const __grid_constant__ StepInputs<T> in) {
  const coarse::Plan& p = a.c.plan;
  const int64_t item = own_item(kRowThreads);
  if (item >= a.s.scenes * p.listed) return;
  const int64_t scene = item / p.listed;
  const int i = static_cast<int>(item - scene * p.listed), position = __ldg(p.list_position + i);
  const int body = __ldg(p.position_body + position);
  const coarse::Line<T, StepInputs<T>> line{
      in, a.c, a.s.data_start, a.s.base + scene, body, a.s.w.x + scene * a.s.positions * kRow, a.w.displacement};
  const Sym3<double> H = line.block(i - __ldg(p.list_ptr + body));
  double* to = a.w.vertex_blocks + (scene * a.s.positions + position) * 6;
  to[0] = H.xx, to[1] = H.xy, to[2] = H.xz, to[3] = H.yy, to[4] = H.yz, to[5] = H.zz;
}

// Change of the energy of tets along the displacement, a block for each part of each scene.
template <class T>
__global__ void __launch_bounds__(kSumThreads)
    line_of_parts(const __grid_constant__ View<T> a, const __grid_constant__ StepInputs<T> in) {
  const coarse::Plan& p = a.c.plan;
  const int64_t scene = blockIdx.x / p.parts, user = a.s.base + scene;
  const int part = static_cast<int>(blockIdx.x - scene * p.parts);
  const T *x = a.s.w.x + scene * a.s.positions * kRow, *displacement = a.w.displacement + scene * a.s.positions * kRow;
  double sum[coarse::kDegree] = {};
  const int end = a.s.has_tets ? __ldg(p.part_begin + part + 1) * kLanes : 0;
  for (int i = __ldg(p.part_begin + part) * kLanes + static_cast<int>(threadIdx.x); i < end; i += kSumThreads) {
    const int block = i / kLanes, lane = i % kLanes;
    Vec3<T> at[4], to[4];
#pragma unroll
    for (int corner = 0; corner < 4; ++corner) {
      const int row = __ldg(p.corner + (static_cast<int64_t>(block) * 4 + corner) * kLanes + lane) / kRow;
      at[corner] = load_row(x, row, true), to[corner] = load_row(displacement, row, true);
    }
    T rest[kRestScalars], material[kMaterialScalars], change[coarse::kDegree] = {};
    const T* scalars =
        a.c.rest.data + user * a.c.rest.scene + static_cast<int64_t>(block) * kRestScalars * kLanes + lane;
#pragma unroll
    for (int r = 0; r < kRestScalars; ++r) rest[r] = __ldg(scalars + r * kLanes);
    const int64_t tet = __ldg(p.tet + i);
#pragma unroll
    for (int m = 0; m < kMaterialScalars; ++m) {
      material[m] = __ldg(in.material[m].data + user * in.material[m].scene + tet * in.material[m].item);
    }
    TetLaw::line(at, to, rest, material, change);
#pragma unroll
    for (int d = 0; d < coarse::kDegree; ++d) sum[d] += change[d];
  }
  block_sum<kSumThreads>(sum);
  if (threadIdx.x != 0) return;
  for (int d = 0; d < coarse::kDegree; ++d) a.w.sums[(scene * p.parts + part) * coarse::kDegree + d] = sum[d];
}

// A block for each body of each scene.
template <class T>
__global__ void __launch_bounds__(kThreads)
    decide_lengths(const __grid_constant__ View<T> a, const __grid_constant__ StepInputs<T> in, int k) {
  __shared__ double part[kWarps][kMostSums];
  const coarse::Plan& p = a.c.plan;
  const int64_t scene = blockIdx.x / p.bodies;
  const int body = static_cast<int>(blockIdx.x - scene * p.bodies);
  int32_t* failures = a.w.failures + scene * p.bodies + body;
  const int failed = k == 0 ? 0 : *failures;
  double length = 0;
  if (failed < coarse::kFailures) {
    const coarse::Line<T, StepInputs<T>> line{in,
                                              a.c,
                                              a.s.data_start,
                                              a.s.base + scene,
                                              body,
                                              a.s.w.x + scene * a.s.positions * kRow,
                                              a.w.displacement + scene * a.s.positions * kRow};
    length = coarse::decide(line, a.tape(scene, k), a.w.restricted + scene * p.functions * 3,
                            a.w.sums + scene * p.parts * coarse::kDegree, BlockTeam{part});
  }
  if (threadIdx.x != 0) return;
  a.lengths(scene, k)[body] = T(length);
  *failures = failed + !(length > 0);
}

template <class T>
__global__ void __launch_bounds__(kRowThreads)
    move_bodies(const __grid_constant__ View<T> a, int k, unsigned* barrier) {
  const int64_t i = own_item(kRowThreads);
  if (i == 0) *barrier = 0;
  if (i >= a.s.scenes * a.s.positions) return;
  const int64_t scene = i / a.s.positions, position = i - scene * a.s.positions;
  const int body = __ldg(a.c.plan.position_body + position);
  if (body < 0) return;
  const T length = a.lengths(scene, k)[body];
  const Vec3<T> x = load_row(a.s.w.x, i, true);
  if (a.c.keeps_positions) {
    T* before = a.lengths(scene, k) + a.c.plan.bodies + 3 * position;
    before[0] = x.x, before[1] = x.y, before[2] = x.z;
  }
  // a rejected displacement may be NaN
  if (length > 0) store_row(a.s.w.x, i, x + length * load_row(a.w.displacement, i, true));
}

// Adjoint of every vertex that moves: its own and the rows of lower colors that the reversed sweeps left for it. They
// stay for its next turn.
template <class T>
__global__ void __launch_bounds__(kRowThreads)
    sum_adjoints(const __grid_constant__ StepView<T> s, T* __restrict__ total) {
  const int64_t active = int64_t{__ldg(s.plan.color_block + s.plan.colors)} * kSlice;
  const int64_t i = own_item(kRowThreads);
  if (i >= s.scenes * active) return;
  const int64_t scene = i / active, position = i - scene * active, row = scene * s.positions + position;
  LaneLayout<1> at(scene, static_cast<int>(position / kSlice), 0);
  at.v = static_cast<int>(position % kSlice);
  int color = 0;
  while (at.block >= __ldg(s.plan.color_block + color + 1)) ++color;
  const int below = __ldg(s.plan.block_edge + __ldg(s.plan.color_block + color)) * kSlice;
  Vec3<T> sum = load_row(s.w.x_bar, row, true);
  if (below > 0) sum += pull_rows<false>(s, at, span_of(s.plan.block_incoming, at.block), below);
  store_row(total, row, sum);
}

// Restores the positions from before the correction.
template <class T>
__global__ void __launch_bounds__(kRowThreads) move_back(const __grid_constant__ View<T> a, int k, unsigned* barrier) {
  const int64_t i = own_item(kRowThreads);
  if (i == 0) *barrier = 0;
  if (i >= a.s.scenes * a.s.positions) return;
  const int64_t scene = i / a.s.positions, position = i - scene * a.s.positions;
  const int body = __ldg(a.c.plan.position_body + position);
  const T length = body < 0 ? T(0) : a.lengths(scene, k)[body];
  Vec3<T> wanted = zero3<T>();  // a rejected displacement may be NaN
  if (length > 0) wanted = -prolonged(a.c, position, a.tape(scene, k));
  if (a.w.wanted) store_row(a.w.wanted, i, wanted);
  if (body < 0) return;
  if (a.c.keeps_positions) {
    const T* before = a.lengths(scene, k) + a.c.plan.bodies + 3 * position;
    store_row(a.s.w.x, i, Vec3<T>{before[0], before[1], before[2]});
  } else if (length > 0) {
    store_row(a.s.w.x, i, load_row(a.s.w.x, i, true) - length * wanted);
  }
}

// Minus the sum of q a' over the corrections, a warp for each row of the matrices of each scene.
template <class T>
__global__ void __launch_bounds__(kRowThreads) sum_products(const __grid_constant__ View<T> a) {
  const coarse::Plan& p = a.c.plan;
  const int64_t unknowns = int64_t{3} * p.functions;
  const int64_t item = own_item(kRowThreads) / 32;
  if (item >= a.s.scenes * unknowns) return;
  const int64_t scene = item / unknowns, row = item - scene * unknowns;
  const int body = __ldg(p.function_body + row / 3), first = 3 * __ldg(p.function_ptr + body);
  const int n = 3 * __ldg(p.function_ptr + body + 1) - first;
  T* to = a.c.matrix_bar + int64_t{9} * (p.cells * (a.s.base + scene) + __ldg(p.mass_ptr + body)) + (row - first) * n;
  for (int j = threadIdx.x % 32; j < n; j += 32) {
    T sum = T(0);
    for (int k = 0; k < a.c.corrections; ++k) {
      if (a.lengths(scene, k)[body] > 0) sum -= a.solved(scene, k)[row] * a.tape(scene, k)[first + j];
    }
    to[j] = sum;
  }
}

template <class Kernel, class... A>
cudaError_t launch(Kernel kernel, int64_t items, int threads, cudaStream_t stream, A... arguments) {
  if (items == 0) return cudaSuccess;
  kernel<<<static_cast<unsigned>((items + threads - 1) / threads), threads, 0, stream>>>(arguments...);
  return cudaGetLastError();
}

template <bool reverse, class T>
cudaError_t solve(const View<T>& a, int k, cudaStream_t stream) {
  const int64_t unknowns = a.s.scenes * 3 * a.c.plan.functions;
  if (a.c.plan.most <= kMostSmall) {
    return launch(solve_rows<T, 8, reverse>, unknowns * 8, kRowThreads, stream, a, k);
  }
  return launch(solve_rows<T, 32, reverse>, unknowns * 32, kRowThreads, stream, a, k);
}

// Restriction of `gradient`.
template <bool reverse, class T>
cudaError_t restricted(const View<T>& a, int k, cudaStream_t stream) {
  const coarse::Plan& p = a.c.plan;
  const int64_t functions = a.s.scenes * p.functions;
  const T* rows = a.w.gradient;
  if (p.entries >= int64_t{kLongRow} * p.functions) {
    constexpr int threads = kManySumThreads;
    return launch(restrict_rows<T, threads, reverse>, functions * threads, threads, stream, a, k, rows);
  }
  if (p.entries < int64_t{kShortRow} * p.functions) {
    return launch(restrict_rows<T, 32, reverse>, functions * 32, 32, stream, a, k, rows);
  }
  return launch(restrict_rows<T, kSumThreads, reverse>, functions * kSumThreads, kSumThreads, stream, a, k, rows);
}

}  // namespace

// Gradient of all colors at once, by the kernels of coarse_gradient.cuh.
template <class T>
cudaError_t Corrections<T>::gradients(int wanted) const {
  constexpr int64_t kManyVertices = 16000;  // up to which a warp takes one vertex
  const bool reverse = wanted != kForward;
  const int64_t active = host.color_block[host.plan.colors];
  const int least = !kOwnLaw && s.scenes * active * kSlice > kManyVertices ? kFewLanes : kManyLanes;
  int lanes = possible_lanes<T>(host, choice, least, reverse);
  if (lanes != kFewLanes && lanes != kSpillLanes) lanes = kManyLanes;
  const bool spills = lanes == kSpillLanes;
  const size_t of_warp = spills ? 0 : gradient_scalars(host.degree, lanes, reverse) * sizeof(T);
  int64_t warps = kWarpsPerBlock;
  if (of_warp > 0) warps = std::min<int64_t>(warps, choice.shared / of_warp);
  const size_t shared = of_warp * warps;
  GradientKernel<T> kernel = gradient_kernel_of<T, kForward>(in.energies, lanes);
  if (reverse) {
    kernel = gradient_kernel_of<T, kAllAdjoints>(in.energies, lanes);
    if constexpr (!kOwnLaw) {
      if (!(wanted & kRest)) kernel = gradient_kernel_of<T, kMaterial>(in.energies, lanes);
      if (!(wanted & kMaterial)) kernel = gradient_kernel_of<T, kState>(in.energies, lanes);
    }
  }
  if (shared > 48 * 1024) {
    const auto attribute = cudaFuncAttributeMaxDynamicSharedMemorySize;
    if (auto error = cudaFuncSetAttribute(kernel, attribute, static_cast<int>(choice.shared))) return error;
  }
  int64_t blocks = (s.scenes * active * threads_of(lanes) + warps - 1) / warps;
  if (blocks == 0) return cudaSuccess;
  if (spills) blocks = std::min<int64_t>(blocks, choice.multiprocessors);
  kernel<<<static_cast<unsigned>(blocks), static_cast<unsigned>(warps * kSlice), shared, stream>>>(s, w);
  return cudaGetLastError();
}

template <class T>
cudaError_t Corrections<T>::correct(int k) const {
  const View<T> a{s, *in.coarse, w};
  const coarse::Plan& p = a.c.plan;
  const int64_t positions = s.scenes * s.positions, parts = s.scenes * p.parts * kSumThreads;
  if (auto error = gradients(kForward)) return error;
  if (auto error = restricted<false>(a, k, stream)) return error;
  if (auto error = invert_with_vertex_blocks()) return error;
  if (auto error = solve<false>(a, k, stream)) return error;
  if (auto error = launch(prolong<T, false>, positions, kRowThreads, stream, a, k)) return error;
  if (auto error = launch(line_of_parts<T>, parts, kSumThreads, stream, a, in)) return error;
  if (auto error = launch(decide_lengths<T>, s.scenes * p.bodies * kThreads, kThreads, stream, a, in, k)) return error;
  return launch(move_bodies<T>, positions, kRowThreads, stream, a, k, barrier);
}

template <class T>
cudaError_t Corrections<T>::reverse(int k, int wanted) const {
  const View<T> a{s, *in.coarse, w};
  const int64_t positions = s.scenes * s.positions, active = host.color_block[host.plan.colors] * kSlice;
  if (auto error = launch(sum_adjoints<T>, s.scenes * active, kRowThreads, stream, s, w.gradient)) return error;
  if (auto error = restricted<true>(a, k, stream)) return error;
  if (auto error = launch(move_back<T>, positions, kRowThreads, stream, a, k, barrier)) return error;
  if (auto error = invert_with_vertex_blocks()) return error;
  if (auto error = solve<true>(a, k, stream)) return error;
  if (auto error = launch(prolong<T, true>, positions, kRowThreads, stream, a, k)) return error;
  return gradients(wanted);
}

template <class T>
cudaError_t Corrections<T>::invert_with_vertex_blocks() const {
  const View<T> a{s, *in.coarse, w};
  if (!a.c.has_vertex_blocks) return cudaSuccess;
  if (auto error = launch(vertex_block_rows<T>, s.scenes * a.c.plan.listed, kRowThreads, stream, a, in)) return error;
  return inverse_with_vertex_blocks(a.c, s.base, s.scenes, s.positions, w.vertex_blocks, w.matrix, w.inverse, stream);
}

template <class T>
cudaError_t Corrections<T>::matrix_bars() const {
  const View<T> a{s, *in.coarse, w};
  if (!a.c.matrix_bar) return cudaSuccess;
  return launch(sum_products<T>, s.scenes * 3 * a.c.plan.functions * 32, kRowThreads, stream, a);
}

#ifdef DIFFVBD_SCALAR
template struct Corrections<DIFFVBD_SCALAR>;
#else
template struct Corrections<float>;
template struct Corrections<double>;
#endif

}  // namespace diffvbd::cuda
