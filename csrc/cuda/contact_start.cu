// Start of a step with contact: support vertices and translations of islands, trust-region radii of the sweeps,
// residual acceleration of bodies.
#include "bodies.cuh"
#include "common.cuh"
#include "contact.h"

namespace diffvbd::cuda {
namespace {

using contact::ResidualAdjoints, contact::ResidualInputs;
using contact::SupportVertexInputs, contact::SweepRadiusInputs, contact::TranslationInputs;

constexpr int kHalfBlock = 128;  // threads of the kernels with a short reduction

// --- support vertices (contact/lowest.h) ---

// A block for each scene, body and plane.
template <class T>
__global__ void support_of_bodies(const __grid_constant__ SupportVertexInputs<T> in, int32_t* own) {
  __shared__ contact::SupportVertex<T> part[kHalfBlock];
  const int32_t plane = static_cast<int32_t>(blockIdx.x % in.num_planes), thread = static_cast<int32_t>(threadIdx.x);
  const int64_t row = blockIdx.x / in.num_planes;
  part[threadIdx.x] = contact::support_vertex_of_body(in, row / in.bodies, static_cast<int32_t>(row % in.bodies), plane,
                                                      thread, kHalfBlock);
  reduce_block<kHalfBlock>(part, [](auto& own, const auto& other) { own.keep(other); });
  if (threadIdx.x == 0) own[blockIdx.x] = part[0].vertex;
}

template <class T>
__global__ void support_of_islands(const __grid_constant__ SupportVertexInputs<T> in, const int32_t* own,
                                   int32_t* out) {
  const int64_t i = own_item(kHalfBlock), row = i / in.num_planes;
  if (row >= in.scenes * in.bodies) return;
  out[i] = contact::support_vertex_of_island(in, own, row / in.bodies, static_cast<int32_t>(row % in.bodies),
                                             static_cast<int32_t>(i % in.num_planes));
}

// --- translations of islands (contact/translation.h) ---

template <class T>
__global__ void sum_bodies(const __grid_constant__ TranslationInputs<T> in, T* sums) {
  __shared__ contact::Mean<T> part[kHalfBlock];
  const int64_t row = blockIdx.x;
  part[threadIdx.x] = contact::mean_of_body(in, row / in.bodies, static_cast<int32_t>(row % in.bodies),
                                            static_cast<int32_t>(threadIdx.x), kHalfBlock);
  reduce_block<kHalfBlock>(part, [](auto& own, const auto& other) { own.add(other); });
  if (threadIdx.x != 0) return;
  T* to = sums + 4 * row;
  to[0] = part[0].sum.x, to[1] = part[0].sum.y, to[2] = part[0].sum.z, to[3] = part[0].mass;
}

template <class T>
__global__ void translate(const __grid_constant__ TranslationInputs<T> in, const T* sums, T* u) {
  const int64_t row = own_item(kHalfBlock);
  if (row >= in.scenes * in.bodies) return;
  const Vec3<T> out = contact::translation_of(in, sums, row / in.bodies, static_cast<int32_t>(row % in.bodies));
  u[3 * row] = out.x, u[3 * row + 1] = out.y, u[3 * row + 2] = out.z;
}

template <class T>
__global__ void reverse_islands(const __grid_constant__ TranslationInputs<T> in, const T* sums, const T* u_bar, T* rate,
                                T* mean, T* x_bar, T* planes_slots) {
  const int64_t row = own_item(kHalfBlock);
  if (row >= in.scenes * in.bodies) return;
  contact::reverse_island(in, sums, u_bar, row / in.bodies, static_cast<int32_t>(row % in.bodies), rate, mean, x_bar,
                          planes_slots + row * in.floor.num_planes * contact::kPlaneScalars);
}

template <class T>
__global__ void reverse_vertices(const __grid_constant__ TranslationInputs<T> in, const T* rate, const T* mean,
                                 T* move_bar, T* mass_bar) {
  const int64_t row = own_item(kHalfBlock);
  if (row >= in.scenes * in.vertices) return;
  contact::reverse_vertex_mean(in, rate, mean, row / in.vertices, static_cast<int32_t>(row % in.vertices), move_bar,
                               mass_bar);
}

template <class T>
__global__ void sum_planes(const T* slots, int64_t scenes, int32_t bodies, int32_t scalars, T* planes_bar) {
  const int64_t i = own_item(kHalfBlock);
  if (i >= scenes * scalars) return;
  T sum = T(0);
  for (int32_t b = 0; b < bodies; ++b) sum += slots[(i / scalars * bodies + b) * scalars + i % scalars];
  planes_bar[i] = sum;
}

// --- trust-region radii of the sweeps (contact/sweep_rooms.h) ---

// A block for each body of each scene.
template <class T>
__global__ void __launch_bounds__(kHalfBlock) wish_kernel(const __grid_constant__ SweepRadiusInputs<T> in, T* wishes) {
  __shared__ contact::SweepDisplacements<T> part[kHalfBlock];
  const int64_t row = blockIdx.x;
  part[threadIdx.x] = contact::displacements_of_body(in, row / in.bodies, row % in.bodies,
                                                     static_cast<int32_t>(threadIdx.x), kHalfBlock);
  reduce_block<kHalfBlock>(part, [](auto& own, const auto& other) { own.keep(other); });
  if (threadIdx.x == 0) wishes[row] = contact::wish_of_body(in, part[0], row);
}

// A block for each scene.
template <class T>
__global__ void __launch_bounds__(kHalfBlock)
    most_kernel(const __grid_constant__ SweepRadiusInputs<T> in, const T* wishes, T* most) {
  __shared__ T part[kHalfBlock];
  part[threadIdx.x] =
      contact::most_of_scene(in, wishes, int64_t{blockIdx.x}, static_cast<int32_t>(threadIdx.x), kHalfBlock);
  reduce_block<kHalfBlock>(part, [](T& own, const T& other) { own = larger(own, other); });
  if (threadIdx.x == 0) most[blockIdx.x] = part[0];
}

template <class T>
__global__ void __launch_bounds__(kHalfBlock)
    radius_kernel(const __grid_constant__ SweepRadiusInputs<T> in, const T* most, T* radii) {
  const int64_t row = own_item(kHalfBlock);
  if (row >= in.scenes * in.vertices) return;
  const int64_t scene = row / in.vertices;
  radii[row] = contact::sweep_radius(in, most[scene], scene, row % in.vertices);
}

// --- residual acceleration (contact/unsupported.h) ---

template <class T>
unsigned blocks_of_bodies(const ResidualInputs<T>& in) {
  return static_cast<unsigned>(in.scene.scenes * in.scene.bodies);
}
// The body of a block.
template <class T>
__device__ rigid::Body<T> own_body(const ResidualInputs<T>& in) {
  const int64_t item = blockIdx.x;
  return {in.scene, item / in.scene.bodies, static_cast<int32_t>(item % in.scene.bodies)};
}

template <class T>
__global__ void __launch_bounds__(kThreads) residual_kernel(const __grid_constant__ ResidualInputs<T> in, T* out) {
  __shared__ double part[kWarps][kMostSums];
  contact::residual_acceleration(in, own_body(in), BlockTeam{part}, out);
}

template <class T>
__global__ void __launch_bounds__(kThreads)
    residual_vjp_kernel(const __grid_constant__ ResidualInputs<T> in, const T* bar,
                        const __grid_constant__ ResidualAdjoints<T> out) {
  __shared__ double part[kWarps][kMostSums];
  contact::reverse_residual_acceleration(in, own_body(in), BlockTeam{part}, bar, out);
}

}  // namespace

template <class T>
cudaError_t support_vertices(const SupportVertexInputs<T>& in, int32_t* own, int32_t* out, cudaStream_t stream) {
  const int64_t items = in.scenes * in.bodies * in.num_planes;
  if (items == 0) return cudaSuccess;
  support_of_bodies<<<static_cast<unsigned>(items), kHalfBlock, 0, stream>>>(in, own);
  support_of_islands<<<blocks_for(items, kHalfBlock), kHalfBlock, 0, stream>>>(in, own, out);
  return cudaGetLastError();
}

template <class T>
cudaError_t translation(const TranslationInputs<T>& in, T* sums, T* u, cudaStream_t stream) {
  const int64_t rows = in.scenes * in.bodies;
  if (rows == 0) return cudaSuccess;
  sum_bodies<<<static_cast<unsigned>(rows), kHalfBlock, 0, stream>>>(in, sums);
  translate<<<blocks_for(rows, kHalfBlock), kHalfBlock, 0, stream>>>(in, sums, u);
  return cudaGetLastError();
}

template <class T>
cudaError_t translation_backward(const TranslationInputs<T>& in, const T* u_bar, T* sums, T* zeroed, T* move_bar,
                                 T* mass_bar, T* x_bar, T* planes_bar, cudaStream_t stream) {
  const int64_t rows = in.scenes * in.bodies, vertices = in.scenes * in.vertices;
  const int32_t scalars = in.floor.num_planes * contact::kPlaneScalars;
  if (rows == 0 || vertices == 0) return cudaSuccess;
  const auto blocks = [](int64_t items) { return blocks_for(items, kHalfBlock); };
  T *rate = zeroed, *mean = rate + 3 * rows, *slots = mean + 3 * rows;
  sum_bodies<<<static_cast<unsigned>(rows), kHalfBlock, 0, stream>>>(in, sums);
  reverse_islands<<<blocks(rows), kHalfBlock, 0, stream>>>(in, sums, u_bar, rate, mean, x_bar, slots);
  reverse_vertices<<<blocks(vertices), kHalfBlock, 0, stream>>>(in, rate, mean, move_bar, mass_bar);
  if (scalars == 0) return cudaGetLastError();
  sum_planes<<<blocks(in.scenes * scalars), kHalfBlock, 0, stream>>>(slots, in.scenes, in.bodies, scalars, planes_bar);
  return cudaGetLastError();
}

template <class T>
cudaError_t sweep_radii(const SweepRadiusInputs<T>& in, T* wishes, T* most, T* radii, cudaStream_t stream) {
  const int64_t vertices = in.scenes * in.vertices;
  if (vertices == 0) return cudaSuccess;
  wish_kernel<T><<<static_cast<unsigned>(in.scenes * in.bodies), kHalfBlock, 0, stream>>>(in, wishes);
  most_kernel<T><<<static_cast<unsigned>(in.scenes), kHalfBlock, 0, stream>>>(in, wishes, most);
  radius_kernel<T><<<blocks_for(vertices, kHalfBlock), kHalfBlock, 0, stream>>>(in, most, radii);
  return cudaGetLastError();
}

template <class T>
cudaError_t residual_acceleration(const ResidualInputs<T>& in, T* out, cudaStream_t stream) {
  if (blocks_of_bodies(in) == 0) return cudaSuccess;
  residual_kernel<T><<<blocks_of_bodies(in), kThreads, 0, stream>>>(in, out);
  return cudaGetLastError();
}

template <class T>
cudaError_t residual_acceleration_backward(const ResidualInputs<T>& in, const T* bar, const ResidualAdjoints<T>& out,
                                           cudaStream_t stream) {
  if (blocks_of_bodies(in) == 0) return cudaSuccess;
  residual_vjp_kernel<T><<<blocks_of_bodies(in), kThreads, 0, stream>>>(in, bar, out);
  return cudaGetLastError();
}

DIFFVBD_INSTANTIATE(support_vertices)
DIFFVBD_INSTANTIATE(translation)
DIFFVBD_INSTANTIATE(translation_backward)
DIFFVBD_INSTANTIATE(sweep_radii)
DIFFVBD_INSTANTIATE(residual_acceleration)
DIFFVBD_INSTANTIATE(residual_acceleration_backward)

}  // namespace diffvbd::cuda
