#include "start.h"

namespace diffvbd::cuda {
namespace {

constexpr int kThreads = 128;
constexpr int kPlane = contact::kPlaneScalars;

unsigned blocks_for(int64_t items) { return static_cast<unsigned>((items + kThreads - 1) / kThreads); }

template <class T>
__global__ void sum_bodies(const __grid_constant__ contact::TranslationInputs<T> in, T* sums) {
  __shared__ contact::Mean<T> part[kThreads];
  const int64_t row = blockIdx.x;
  part[threadIdx.x] = contact::mean_of_body(in, row / in.bodies, static_cast<int32_t>(row % in.bodies),
                                            static_cast<int32_t>(threadIdx.x), kThreads);
  for (int half = kThreads / 2; half > 0; half /= 2) {
    __syncthreads();
    if (threadIdx.x < half) part[threadIdx.x].add(part[threadIdx.x + half]);
  }
  if (threadIdx.x != 0) return;
  T* to = sums + 4 * row;
  to[0] = part[0].sum.x, to[1] = part[0].sum.y, to[2] = part[0].sum.z, to[3] = part[0].mass;
}

template <class T>
__global__ void translate(const __grid_constant__ contact::TranslationInputs<T> in, const T* sums, T* u) {
  const int64_t row = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (row >= in.scenes * in.bodies) return;
  const Vec3<T> out = contact::translation_of(in, sums, row / in.bodies, static_cast<int32_t>(row % in.bodies));
  u[3 * row] = out.x, u[3 * row + 1] = out.y, u[3 * row + 2] = out.z;
}

template <class T>
__global__ void reverse_islands(const __grid_constant__ contact::TranslationInputs<T> in, const T* sums, const T* u_bar,
                                T* rate, T* mean, T* x_bar, T* planes_slots) {
  const int64_t row = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (row >= in.scenes * in.bodies) return;
  contact::reverse_island(in, sums, u_bar, row / in.bodies, static_cast<int32_t>(row % in.bodies), rate, mean, x_bar,
                          planes_slots + row * in.floor.num_planes * kPlane);
}

template <class T>
__global__ void reverse_vertices(const __grid_constant__ contact::TranslationInputs<T> in, const T* rate, const T* mean,
                                 T* move_bar, T* mass_bar) {
  const int64_t row = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (row >= in.scenes * in.vertices) return;
  contact::reverse_vertex_mean(in, rate, mean, row / in.vertices, static_cast<int32_t>(row % in.vertices), move_bar,
                                mass_bar);
}

template <class T>
__global__ void sum_planes(const T* slots, int64_t scenes, int32_t bodies, int32_t scalars, T* planes_bar) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= scenes * scalars) return;
  T sum = T(0);
  for (int32_t b = 0; b < bodies; ++b) sum += slots[(i / scalars * bodies + b) * scalars + i % scalars];
  planes_bar[i] = sum;
}

}  // namespace

template <class T>
cudaError_t translation(const contact::TranslationInputs<T>& in, T* sums, T* u, cudaStream_t stream) {
  const int64_t rows = in.scenes * in.bodies;
  if (rows == 0) return cudaSuccess;
  sum_bodies<<<static_cast<unsigned>(rows), kThreads, 0, stream>>>(in, sums);
  translate<<<blocks_for(rows), kThreads, 0, stream>>>(in, sums, u);
  return cudaGetLastError();
}

template <class T>
cudaError_t translation_backward(const contact::TranslationInputs<T>& in, const T* u_bar, T* sums, T* zeroed,
                                 T* move_bar, T* mass_bar, T* x_bar, T* planes_bar, cudaStream_t stream) {
  const int64_t rows = in.scenes * in.bodies, vertices = in.scenes * in.vertices;
  const int32_t scalars = in.floor.num_planes * kPlane;
  if (rows == 0 || vertices == 0) return cudaSuccess;
  T *rate = zeroed, *mean = rate + 3 * rows, *slots = mean + 3 * rows;
  sum_bodies<<<static_cast<unsigned>(rows), kThreads, 0, stream>>>(in, sums);
  reverse_islands<<<blocks_for(rows), kThreads, 0, stream>>>(in, sums, u_bar, rate, mean, x_bar, slots);
  reverse_vertices<<<blocks_for(vertices), kThreads, 0, stream>>>(in, rate, mean, move_bar, mass_bar);
  if (scalars > 0) {
    sum_planes<<<blocks_for(in.scenes * scalars), kThreads, 0, stream>>>(slots, in.scenes, in.bodies, scalars,
                                                                         planes_bar);
  }
  return cudaGetLastError();
}

#define DIFFVBD_INSTANTIATE(T)                                                                                         \
  template cudaError_t translation<T>(const contact::TranslationInputs<T>&, T*, T*, cudaStream_t);                     \
  template cudaError_t translation_backward<T>(const contact::TranslationInputs<T>&, const T*, T*, T*, T*, T*, T*, T*, \
                                               cudaStream_t);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd::cuda
