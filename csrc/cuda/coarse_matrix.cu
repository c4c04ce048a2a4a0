// Matrices of a step, their inverses body by body, and the transpose.
#include "../subspace/coarse.h"
#include "bodies.cuh"
#include "coarse.h"
#include "common.cuh"

namespace diffvbd::cuda {
namespace {

using coarse::MatrixInputs, coarse::Plan;
using rigid::Matrix, rigid::outer, rigid::transposed, rigid::Vector;

constexpr int kEdgeRows = 8;
constexpr int kPairThreads = 128;
constexpr int kDetermined = 18;  // 1 where the rotation is determined

__device__ __forceinline__ Matrix load_matrix(const double* a) {
  return {{a[0], a[1], a[2]}, {a[3], a[4], a[5]}, {a[6], a[7], a[8]}};
}
__device__ __forceinline__ void store_matrix(double* a, const Matrix& m, int64_t row = 3) {
  a[0] = m.x.x, a[1] = m.x.y, a[2] = m.x.z, a += row;
  a[0] = m.y.x, a[1] = m.y.y, a[2] = m.y.z, a += row;
  a[0] = m.z.x, a[1] = m.z.y, a[2] = m.z.z;
}

// Deformations and rotations, a block for each group of each scene.
template <class T>
__global__ void __launch_bounds__(kThreads)
    rotate_groups(const __grid_constant__ MatrixInputs<T> in, double* __restrict__ states) {
  __shared__ double part[kWarps][kMostSums];
  const int64_t scene = blockIdx.x / in.plan.groups;
  const int group = static_cast<int>(blockIdx.x - scene * in.plan.groups);
  const int32_t first = in.plan.moment_ptr[group], count = in.plan.moment_ptr[group + 1] - first;
  const BlockTeam team{part};
  double sums[9];
  team.sum<9>(count, sums, [&](int32_t i, double* out) {
    const T* x = in.x_prev + 3 * (scene * in.vertices + in.plan.moment_vertex[first + i]);
    const T* m = in.moment + 3 * static_cast<int64_t>(first + i);
    for (int r = 0; r < 3; ++r) {
      for (int c = 0; c < 3; ++c) out[3 * r + c] += double(x[r]) * double(m[c]);
    }
  });
  if (!team.leads()) return;
  double* to = states + static_cast<int64_t>(blockIdx.x) * kGroupScalars;
  Matrix rotation = rigid::identity();
  const Matrix f = load_matrix(sums);
  to[kDetermined] = coarse::nearest_rotation(f, in.volume[group], rotation) ? 1 : 0;
  store_matrix(to, f);
  store_matrix(to + 9, rotation);
}

// Body and two functions of a cell of the matrices.
struct Cell {
  int body, i, j, count;
  __device__ Cell(const Plan& p, int cell) {
    int low = 0, high = p.bodies;  // mass_ptr[low] <= cell < mass_ptr[high]
    while (high - low > 1) {
      const int middle = (low + high) / 2;
      (__ldg(p.mass_ptr + middle) <= cell ? low : high) = middle;
    }
    body = low;
    count = __ldg(p.function_ptr + body + 1) - __ldg(p.function_ptr + body);
    const int own = cell - __ldg(p.mass_ptr + body);
    i = own / count, j = own % count;
  }
};

template <class T>
__device__ __forceinline__ Matrix load_block(const T* k, int64_t plane) {
  const auto at = [&](int i) { return double(__ldg(k + i * plane)); };
  return {{at(0), at(1), at(2)}, {at(3), at(4), at(5)}, {at(6), at(7), at(8)}};
}

// A thread for each two functions of a body.
template <class T>
__global__ void __launch_bounds__(kPairThreads)
    assemble_pairs(const __grid_constant__ MatrixInputs<T> in, const double* __restrict__ states,
                   double* __restrict__ matrix) {
  const Plan& p = in.plan;
  const int64_t item = own_item(kPairThreads);
  if (item >= in.scenes * p.cells) return;
  const int64_t scene = item / p.cells, cell = item - scene * p.cells;
  const Cell at(p, static_cast<int>(cell));
  const bool mirrored = at.i > at.j;  // both halves get the same bits
  const int i = mirrored ? at.j : at.i, j = mirrored ? at.i : at.j;
  const int64_t plane = int64_t{p.width} * p.width;
  Matrix sum{};
  for (int g = __ldg(p.group_ptr + at.body); g < __ldg(p.group_ptr + at.body + 1); ++g) {
    const int32_t* place = p.place + __ldg(p.place_ptr + g);
    const int one = __ldg(place + i), two = __ldg(place + j);
    if (one < 0 || two < 0) continue;
    const T* k = in.stiffness.data + scene * in.stiffness.scene + g * 9 * plane;
    const Matrix r = load_matrix(states + (scene * p.groups + g) * kGroupScalars + 9);
    sum = sum + r * load_block(k + int64_t{one} * p.width + two, plane) * transposed(r);
  }
  sum = in.time_step * in.time_step * sum;
  const double mass = in.mass.data[scene * in.mass.scene + __ldg(p.mass_ptr + at.body) + i * at.count + j];
  sum = sum + mass * rigid::identity();
  if (mirrored) sum = transposed(sum);
  const int64_t n = 3 * at.count;
  store_matrix(matrix + 9 * (scene * p.cells + __ldg(p.mass_ptr + at.body)) + 3 * at.i * n + 3 * at.j, sum, n);
}

// --- the inverse: a symmetric sweep (Goodnight) over tiles of the diagonal, after which the matrix holds -A^-1
// --------

// Body of a block, its matrix and workspace.
struct Swept {
  int n, tiles;
  double *matrix, *panel, *columns, *block;
  template <class T>
  __device__ Swept(const MatrixInputs<T>& in, const MatrixWork& work, int64_t scene, int body) {
    const Plan& p = in.plan;
    const int first = __ldg(p.function_ptr + body);
    n = 3 * (__ldg(p.function_ptr + body + 1) - first);
    tiles = (n + kEdge - 1) / kEdge;
    matrix = work.matrix + 9 * (scene * p.cells + __ldg(p.mass_ptr + body));
    panel = work.panel + (2 * scene * 3 * p.functions + 3 * first) * kEdge;
    columns = panel + int64_t{3} * p.functions * kEdge;
    block = work.block + (scene * p.bodies + body) * kEdge * kEdge;
  }
};

// Minus the inverse of a symmetric tile, by a warp whose threads hold one column each.
__device__ __forceinline__ void invert_tile(double (&tile)[kEdge][kEdge + 1], int c) {
  double column[kEdge];
#pragma unroll
  for (int r = 0; r < kEdge; ++r) column[r] = tile[r][c];
#pragma unroll
  for (int k = 0; k < kEdge; ++k) {
    __syncwarp();
    tile[0][c] = column[k];  // row k, which is column k
    __syncwarp();
    const double over = 1 / tile[0][k], scaled = column[k] * over;
#pragma unroll
    for (int r = 0; r < kEdge; ++r) {
      if (r != k) column[r] = c == k ? tile[0][r] * over : column[r] - tile[0][r] * scaled;
    }
    column[k] = c == k ? -over : scaled;
  }
  __syncwarp();
#pragma unroll
  for (int r = 0; r < kEdge; ++r) tile[r][c] = column[r];
}

// Minus the inverse of the pivot tile of each body, a warp each.
template <class T>
__global__ void __launch_bounds__(kEdge)
    invert_pivots(const __grid_constant__ MatrixInputs<T> in, const __grid_constant__ MatrixWork work, int bodies,
                  int first_body, int pivot) {
  __shared__ double own[kEdge][kEdge + 1];
  const int64_t scene = blockIdx.x / bodies;
  const Swept a(in, work, scene, first_body + static_cast<int>(blockIdx.x - scene * bodies));
  const int begin = pivot * kEdge, size = min(kEdge, a.n - begin), c = threadIdx.x;
  if (size <= 0) return;
  for (int r = 0; r < kEdge; ++r) {
    const bool inside = r < size && c < size;
    own[r][c] = inside ? a.matrix[int64_t{begin + r} * a.n + begin + c] : double(r == c);
  }
  __syncwarp();
  invert_tile(own, c);
  __syncwarp();
  for (int r = 0; r < kEdge; ++r) a.block[r * kEdge + c] = own[r][c];
}

// Panel of a tile of rows, a block of kEdge x kEdgeRows threads each: its columns of the pivot tile, and these times
// the inverse of the pivot tile.
template <class T>
__global__ void __launch_bounds__(kEdge* kEdgeRows)
    sweep_panel(const __grid_constant__ MatrixInputs<T> in, const __grid_constant__ MatrixWork work, int bodies,
                int first_body, int pivot) {
  __shared__ double own[kEdge][kEdge + 1], tile[kEdge][kEdge + 1];
  const int64_t scene = blockIdx.x / bodies;
  const Swept a(in, work, scene, first_body + static_cast<int>(blockIdx.x - scene * bodies));
  const int begin = pivot * kEdge, size = min(kEdge, a.n - begin), mine = static_cast<int>(blockIdx.y) * kEdge;
  if (size <= 0 || mine >= a.n) return;
  const int c = threadIdx.x, first = threadIdx.y;
  for (int r = first; r < kEdge; r += kEdgeRows) {
    own[r][c] = a.block[r * kEdge + c];
    tile[r][c] = mine + r < a.n && c < size ? a.matrix[int64_t{mine + r} * a.n + begin + c] : 0;
  }
  __syncthreads();
  double sum[kEdge / kEdgeRows] = {};
  for (int k = 0; k < kEdge; ++k) {
#pragma unroll
    for (int u = 0; u < kEdge / kEdgeRows; ++u) sum[u] -= tile[first + u * kEdgeRows][k] * own[k][c];
  }
#pragma unroll
  for (int u = 0; u < kEdge / kEdgeRows; ++u) {
    const int r = first + u * kEdgeRows;
    if (mine + r < a.n) {
      a.columns[int64_t{mine + r} * kEdge + c] = tile[r][c];
      a.panel[int64_t{mine + r} * kEdge + c] = c < size ? sum[u] : 0;
    }
  }
}

// Update of a lower tile and its mirror image, a block each; the last pivot leaves the inverse.
template <class T>
__global__ void __launch_bounds__(kEdge* kEdgeRows)
    sweep_tiles(const __grid_constant__ MatrixInputs<T> in, const __grid_constant__ MatrixWork work, int bodies,
                int first_body, int pivot, T* inverse) {
  __shared__ double one[kEdge][kEdge + 1], two[kEdge][kEdge + 1];
  const int64_t scene = blockIdx.x / bodies;
  const int body = first_body + static_cast<int>(blockIdx.x - scene * bodies);
  const Swept a(in, work, scene, body);
  int high = static_cast<int>((sqrtf(8.0f * blockIdx.y + 1) - 1) / 2);
  if (high * (high + 1) / 2 > static_cast<int>(blockIdx.y)) --high;
  if ((high + 1) * (high + 2) / 2 <= static_cast<int>(blockIdx.y)) ++high;
  const int low = static_cast<int>(blockIdx.y) - high * (high + 1) / 2;
  if (pivot >= a.tiles || high >= a.tiles) return;
  const int c = threadIdx.x, first = threadIdx.y, rows = high * kEdge, columns = low * kEdge;
  const bool last = pivot + 1 == a.tiles;
  const bool moves = high != pivot && low != pivot;
  for (int r = first; r < kEdge; r += kEdgeRows) {
    one[r][c] = rows + r < a.n ? a.panel[int64_t{rows + r} * kEdge + c] : 0;
    two[r][c] = columns + r < a.n ? (moves ? a.columns : a.panel)[int64_t{columns + r} * kEdge + c] : 0;
  }
  __syncthreads();
  T* out = inverse + 9 * (scene * in.plan.cells + __ldg(in.plan.mass_ptr + body));
  double sum[kEdge / kEdgeRows] = {};
  for (int k = 0; moves && k < kEdge; ++k) {
#pragma unroll
    for (int u = 0; u < kEdge / kEdgeRows; ++u) sum[u] -= one[first + u * kEdgeRows][k] * two[c][k];
  }
#pragma unroll
  for (int u = 0; u < kEdge / kEdgeRows; ++u) {
    const int r = first + u * kEdgeRows;
    // on the diagonal the lower half stands for both
    if (rows + r >= a.n || columns + c >= a.n || (high == low && c > r)) continue;
    const int64_t at = int64_t{rows + r} * a.n + columns + c, mirror = int64_t{columns + c} * a.n + rows + r;
    double value = 0;
    if (moves) {
      value = a.matrix[at] + sum[u];
    } else if (high == low) {
      value = a.block[r * kEdge + c];
    } else {
      value = low == pivot ? one[r][c] : two[c][r];
    }
    if (last) {
      out[at] = T(-value), out[mirror] = T(-value);
    } else {
      a.matrix[at] = value, a.matrix[mirror] = value;
    }
  }
}

// --- the transpose --------------------------------------------------------------------------------------------------

// h^2 times the adjoint of a block plus that of its mirror image.
template <class T>
__device__ __forceinline__ Matrix pair_bar(const MatrixInputs<T>& in, const T* bar, int body, int i, int j) {
  const int64_t n = int64_t{3} * (__ldg(in.plan.function_ptr + body + 1) - __ldg(in.plan.function_ptr + body));
  const T* own = bar + int64_t{9} * __ldg(in.plan.mass_ptr + body);
  const Matrix above = coarse::block_at(own + 3 * i * n + 3 * j, n);
  const double h2 = in.time_step * in.time_step;
  return i == j ? h2 * above : h2 * (above + transposed(coarse::block_at(own + 3 * j * n + 3 * i, n)));
}

// Replaces the deformation of each group by its adjoint, a block each.
template <class T>
__global__ void __launch_bounds__(kThreads)
    rotate_groups_vjp(const __grid_constant__ MatrixInputs<T> in, const T* __restrict__ bar, double* states) {
  __shared__ double part[kWarps][kMostSums];
  const Plan& p = in.plan;
  const int64_t scene = blockIdx.x / p.groups, plane = int64_t{p.width} * p.width;
  const int g = static_cast<int>(blockIdx.x - scene * p.groups), body = __ldg(p.group_body + g);
  const int32_t *functions = p.group_function + static_cast<int64_t>(g) * p.width, first = p.function_ptr[body];
  double* state = states + static_cast<int64_t>(blockIdx.x) * kGroupScalars;
  const Matrix f = load_matrix(state), r = load_matrix(state + 9);
  const T *k = in.stiffness.data + scene * in.stiffness.scene + g * 9 * plane,
          *own = bar + int64_t{9} * p.cells * scene;
  const BlockTeam team{part};
  double sums[9];
  team.sum<9>(static_cast<int32_t>(plane), sums, [&](int32_t at, double* out) {
    const int i = at / p.width, j = at % p.width;
    if (j < i || functions[i] < 0 || functions[j] < 0) return;
    const Matrix a_bar = pair_bar(in, own, body, functions[i] - first, functions[j] - first);
    const Matrix block = load_block(k + at, plane);
    double add[9];
    store_matrix(add, a_bar * r * transposed(block) + transposed(a_bar) * r * block);
    for (int c = 0; c < 9; ++c) out[c] += add[c];
  });
  if (!team.leads()) return;
  Matrix f_bar{};
  if (state[kDetermined] > 0) f_bar = rigid::polar_vjp(f, r, load_matrix(sums));
  store_matrix(state, f_bar);
}

template <class T>
__global__ void __launch_bounds__(kPairThreads)
    vertices_vjp(const __grid_constant__ MatrixInputs<T> in, const double* __restrict__ states, T* __restrict__ x_bar) {
  const int64_t item = own_item(kPairThreads);
  if (item >= in.scenes * in.vertices) return;
  const int64_t scene = item / in.vertices, v = item - scene * in.vertices;
  Vector sum{0, 0, 0};
  for (int e = __ldg(in.plan.vertex_ptr + v); e < __ldg(in.plan.vertex_ptr + v + 1); ++e) {
    const int64_t moment = __ldg(in.plan.vertex_moment + e);
    const T* m = in.moment + 3 * moment;
    const double* f_bar = states + (scene * in.plan.groups + __ldg(in.plan.moment_group + moment)) * kGroupScalars;
    sum += load_matrix(f_bar) * Vector{double(m[0]), double(m[1]), double(m[2])};
  }
  x_bar[3 * item] = T(sum.x), x_bar[3 * item + 1] = T(sum.y), x_bar[3 * item + 2] = T(sum.z);
}

// A thread for each two places of a group; sums over scenes that share a stiffness.
template <class T>
__global__ void __launch_bounds__(kPairThreads)
    stiffness_vjp(const __grid_constant__ MatrixInputs<T> in, const T* __restrict__ bar,
                  const double* __restrict__ states, T* __restrict__ stiffness_bar) {
  const Plan& p = in.plan;
  const int64_t plane = int64_t{p.width} * p.width, item = own_item(kPairThreads);
  const bool shared = in.stiffness.scene == 0;
  if (item >= (shared ? 1 : in.scenes) * p.groups * plane) return;
  const int64_t first_scene = item / (p.groups * plane);
  const int g = static_cast<int>(item / plane % p.groups), at = static_cast<int>(item % plane);
  const int i = at / p.width, j = at % p.width, body = __ldg(p.group_body + g), first = p.function_ptr[body];
  const int32_t* functions = p.group_function + static_cast<int64_t>(g) * p.width;
  Matrix sum{};
  if (j >= i && functions[i] >= 0 && functions[j] >= 0) {
    for (int64_t scene = first_scene; scene < (shared ? in.scenes : first_scene + 1); ++scene) {
      const Matrix r = load_matrix(states + (scene * p.groups + g) * kGroupScalars + 9);
      const T* own = bar + int64_t{9} * p.cells * scene;
      sum = sum + transposed(r) * pair_bar(in, own, body, functions[i] - first, functions[j] - first) * r;
    }
  }
  T* to = stiffness_bar + (first_scene * p.groups + g) * 9 * plane + at;
  double out[9];
  store_matrix(out, sum);
  for (int c = 0; c < 9; ++c) to[c * plane] = T(out[c]);
}

template <class T>
__global__ void __launch_bounds__(kPairThreads)
    mass_vjp(const __grid_constant__ MatrixInputs<T> in, const T* __restrict__ bar, T* __restrict__ mass_bar) {
  const Plan& p = in.plan;
  const int64_t item = own_item(kPairThreads);
  if (item >= in.scenes * p.cells) return;
  const int64_t scene = item / p.cells;
  const Cell at(p, static_cast<int>(item - scene * p.cells));
  const int64_t n = 3 * at.count;
  const T* own = bar + 9 * (scene * p.cells + __ldg(p.mass_ptr + at.body)) + 3 * at.i * n + 3 * at.j;
  mass_bar[item] = own[0] + own[n + 1] + own[2 * n + 2];
}

// Inverts the matrices of the bodies [first, first + count), of at most `tiles` tiles.
template <class T>
void invert(const MatrixInputs<T>& in, const MatrixWork& work, int first, int count, int tiles, T* inverse,
            cudaStream_t stream) {
  const auto items = static_cast<unsigned>(in.scenes * count);
  const dim3 threads(kEdge, kEdgeRows);
  for (int pivot = 0; count > 0 && pivot < tiles; ++pivot) {
    invert_pivots<<<items, kEdge, 0, stream>>>(in, work, count, first, pivot);
    sweep_panel<<<dim3(items, tiles), threads, 0, stream>>>(in, work, count, first, pivot);
    sweep_tiles<<<dim3(items, tiles * (tiles + 1) / 2), threads, 0, stream>>>(in, work, count, first, pivot, inverse);
  }
}

template <class T>
void invert_all(const MatrixInputs<T>& in, const MatrixWork& work, T* inverse, cudaStream_t stream) {
  const Plan& p = in.plan;
  invert(in, work, 0, p.bodies - p.large, 1, inverse, stream);
  invert(in, work, p.bodies - p.large, p.large, (3 * p.most + kEdge - 1) / kEdge, inverse, stream);
}

template <class T>
__global__ void __launch_bounds__(kPairThreads)
    store_matrices(const double* __restrict__ matrix, int64_t count, T* __restrict__ out) {
  const int64_t i = own_item(kPairThreads);
  if (i < count) out[i] = T(matrix[i]);
}

// Blocks of A + P' H P, a thread for each two functions of a body. vertex_blocks: H of each position.
template <class T>
__global__ void __launch_bounds__(kPairThreads)
    add_vertex_blocks(const __grid_constant__ coarse::Inputs<T> c, int64_t base, int64_t scenes, int64_t positions,
                      const double* __restrict__ vertex_blocks, double* __restrict__ matrix) {
  const Plan& p = c.plan;
  const int64_t item = own_item(kPairThreads);
  if (item >= scenes * p.cells) return;
  const int64_t scene = item / p.cells;
  const Cell at(p, static_cast<int>(item - scene * p.cells));
  if (at.j > at.i) return;
  const int first = __ldg(p.function_ptr + at.body), i = first + at.i, j = first + at.j;
  const int64_t n = 3 * at.count, own = int64_t{9} * __ldg(p.mass_ptr + at.body);
  Matrix sum = coarse::block_at(c.factor.data + (base + scene) * c.factor.scene + own + 3 * at.i * n + 3 * at.j, n);
  for (int e = __ldg(p.row_ptr + i); e < __ldg(p.row_ptr + i + 1); ++e) {
    const int position = __ldg(p.row + e);
    const double* H = vertex_blocks + (scene * positions + position) * 6;
    const Sym3<double> block{H[0], H[1], H[2], H[3], H[4], H[5]};
    if (!coarse::acts(block)) continue;
    for (int f = __ldg(p.position_ptr + position); f < __ldg(p.position_ptr + position + 1); ++f) {
      if (__ldg(p.function + f) != j) continue;
      const double weight = double(__ldg(c.row_weight + e)) * double(__ldg(c.weight + f));
      sum = sum + weight * Matrix{{H[0], H[1], H[2]}, {H[1], H[3], H[4]}, {H[2], H[4], H[5]}};
    }
  }
  double* to = matrix + 9 * scene * p.cells + own;
  store_matrix(to + 3 * at.i * n + 3 * at.j, sum, n);
  if (at.i != at.j) store_matrix(to + 3 * at.j * n + 3 * at.i, transposed(sum), n);
}

}  // namespace

template <class T>
cudaError_t coarse_inverse(const MatrixInputs<T>& in, const MatrixWork& work, T* inverse, bool inverts,
                           cudaStream_t stream) {
  const Plan& p = in.plan;
  if (in.scenes * p.bodies == 0) return cudaSuccess;
  if (p.groups > 0) {
    rotate_groups<<<static_cast<unsigned>(in.scenes * p.groups), kThreads, 0, stream>>>(in, work.states);
  }
  assemble_pairs<<<blocks_for(in.scenes * p.cells, kPairThreads), kPairThreads, 0, stream>>>(in, work.states,
                                                                                             work.matrix);
  if (inverts) {
    invert_all(in, work, inverse, stream);
  } else if (p.cells > 0) {
    const int64_t count = in.scenes * 9 * p.cells;
    store_matrices<<<blocks_for(count, kPairThreads), kPairThreads, 0, stream>>>(work.matrix, count, inverse);
  }
  return cudaGetLastError();
}

template <class T>
cudaError_t inverse_with_vertex_blocks(const coarse::Inputs<T>& c, int64_t base, int64_t scenes, int64_t positions,
                                       const double* vertex_blocks, const MatrixWork& work, T* inverse,
                                       cudaStream_t stream) {
  if (scenes * c.plan.cells == 0) return cudaSuccess;
  add_vertex_blocks<<<blocks_for(scenes * c.plan.cells, kPairThreads), kPairThreads, 0, stream>>>(
      c, base, scenes, positions, vertex_blocks, work.matrix);
  MatrixInputs<T> in{};
  in.plan = c.plan, in.scenes = scenes;
  invert_all(in, work, inverse, stream);
  return cudaGetLastError();
}

template <class T>
cudaError_t coarse_inverse_vjp(const MatrixInputs<T>& in, const T* bar, double* states, T* x_bar, T* stiffness_bar,
                               T* mass_bar, cudaStream_t stream) {
  const Plan& p = in.plan;
  if (in.scenes * in.vertices == 0) return cudaSuccess;
  const int64_t plane = int64_t{p.width} * p.width;
  if (p.groups > 0 && p.width > 0) {
    rotate_groups<<<static_cast<unsigned>(in.scenes * p.groups), kThreads, 0, stream>>>(in, states);
    const int64_t pairs = (in.stiffness.scene == 0 ? 1 : in.scenes) * p.groups * plane;
    stiffness_vjp<<<blocks_for(pairs, kPairThreads), kPairThreads, 0, stream>>>(in, bar, states, stiffness_bar);
    rotate_groups_vjp<<<static_cast<unsigned>(in.scenes * p.groups), kThreads, 0, stream>>>(in, bar, states);
  }
  vertices_vjp<<<blocks_for(in.scenes * in.vertices, kPairThreads), kPairThreads, 0, stream>>>(in, states, x_bar);
  if (p.cells > 0)
    mass_vjp<<<blocks_for(in.scenes * p.cells, kPairThreads), kPairThreads, 0, stream>>>(in, bar, mass_bar);
  return cudaGetLastError();
}

DIFFVBD_INSTANTIATE(coarse_inverse)
DIFFVBD_INSTANTIATE(inverse_with_vertex_blocks)
DIFFVBD_INSTANTIATE(coarse_inverse_vjp)

}  // namespace diffvbd::cuda
