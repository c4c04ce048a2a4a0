// Start of a substep (contact/start.h, contact/above_floor.h): a block for each body, a thread for each vertex.
#include "bodies.cuh"
#include "contact.h"

namespace diffvbd::cuda {

constexpr int kWarp = 32, kMostThreads = 1024;
constexpr int kVertices = 4;  // average vertices per thread above which the block becomes larger

// A power of two.
inline int threads_for(int64_t vertices, int64_t bodies) {
  int threads = kWarp;
  while (threads < kMostThreads && vertices > kVertices * threads * bodies) threads *= 2;
  return threads;
}

// Team of a block, for up to kSums numbers at once.
struct BodyBlock {
  static constexpr int kSums = 8;
  double (*part)[kSums];  // [kMostThreads / kWarp], shared
  __device__ bool leads() const { return threadIdx.x == 0; }
  __device__ void meet() const { __syncthreads(); }
  __device__ static int32_t first() { return static_cast<int32_t>(threadIdx.x); }
  __device__ static int32_t stride() { return static_cast<int32_t>(blockDim.x); }
  template <class F>
  __device__ void each(int32_t count, const F& f) const {
    for (int32_t i = first(); i < count; i += stride()) f(i);
  }
  template <int n, class F>
  __device__ void sum(int32_t count, double* out, const F& f) const {
    own_sum<n>(first(), count, stride(), out, f);
    butterfly<n, kWarp>(kWholeWarp, out);
    share<n>(out);
    for (int k = 0; k < n; ++k) {
      double total = 0;
      for (int w = 0; w < stride() / kWarp; ++w) total += part[w][k];
      out[k] = total;
    }
    __syncthreads();
  }
  template <class F>
  __device__ double least(int32_t count, const F& f) const {
    double own = butterfly_least<kWarp>(kWholeWarp, own_least(first(), count, stride(), f));
    share<1>(&own);
    for (int w = 0; w < stride() / kWarp; ++w) own = fmin(own, part[w][0]);
    __syncthreads();
    return own;
  }
  // Sums of all warps, in shared memory.
  template <int n>
  __device__ void share(const double* own) const {
    static_assert(n <= kSums);
    if (threadIdx.x % kWarp == 0) {
      for (int k = 0; k < n; ++k) part[threadIdx.x / kWarp][k] = own[k];
    }
    __syncthreads();
  }
};

namespace {

template <class T, template <class> class Act>
__global__ void __launch_bounds__(kMostThreads) body_kernel(const __grid_constant__ Act<T> act) {
  __shared__ double part[kMostThreads / kWarp][BodyBlock::kSums];
  const int64_t item = blockIdx.x, bodies = act.in.scene.bodies;
  act(rigid::Body<T>{act.in.scene, item / bodies, static_cast<int32_t>(item % bodies)}, BodyBlock{part});
}

template <class Act>
__global__ void __launch_bounds__(kVertexThreads) vertex_kernel(const __grid_constant__ Act act) {
  const Row row(act.in.scene);
  if (row.exists) act(row.scene, row.vertex);
}

}  // namespace

template <class Act>
cudaError_t act_on_bodies(const Act& act, cudaStream_t stream) {
  const int64_t items = act.in.scene.scenes * act.in.scene.bodies;
  if (items == 0) return cudaSuccess;
  const int threads = threads_for(act.in.scene.vertices, act.in.scene.bodies);
  body_kernel<<<static_cast<unsigned>(items), threads, 0, stream>>>(act);
  return cudaGetLastError();
}

template <class Act>
cudaError_t act_on_vertices(const Act& act, cudaStream_t stream) {
  if (act.in.scene.scenes * act.in.scene.vertices == 0) return cudaSuccess;
  vertex_kernel<<<blocks_of(act.in.scene), kVertexThreads, 0, stream>>>(act);
  return cudaGetLastError();
}

#define DIFFVBD_ACT(on, Act)                                                  \
  template cudaError_t act_on_##on(const contact::Act<float>&, cudaStream_t); \
  template cudaError_t act_on_##on(const contact::Act<double>&, cudaStream_t);
DIFFVBD_ACT(bodies, AboveFloorDisplacements)
DIFFVBD_ACT(bodies, ReverseAboveFloor)
DIFFVBD_ACT(bodies, RigidMoves)
DIFFVBD_ACT(bodies, Deformations)
DIFFVBD_ACT(bodies, BlockedBodies)
DIFFVBD_ACT(vertices, Wishes)
DIFFVBD_ACT(vertices, Freeze)
DIFFVBD_ACT(vertices, GravityMoves)
DIFFVBD_ACT(vertices, Starts)
DIFFVBD_ACT(vertices, ReverseStarts)
#undef DIFFVBD_ACT

}  // namespace diffvbd::cuda
