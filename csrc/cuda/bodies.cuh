// Teams of threads that work on bodies: 4 or 8 lanes of a warp, a block, or the whole device for one body after
// another.
#pragma once

#include <cooperative_groups.h>
#include <math_constants.h>

#include "../subspace/rigid.h"
#include "bodies.h"
#include "common.cuh"
#include "warp_reduce.cuh"

namespace diffvbd::cuda {

constexpr int kTile = 8, kTileThreads = 128;
constexpr int kTinyTile =
    4;  // lanes for bodies of 8 vertices: all lanes find the rotation, so fewer lanes repeat it less often
constexpr int64_t kEnoughThreads = 16384;  // tiny bodies of all scenes that fill the device with one thread each
constexpr int kThreads = 256, kWarps = kThreads / 32;
constexpr int32_t kOfWarp = 256;                // vertices up to which one warp of a block takes a body
constexpr int kMostSums = 5 + 6 + rigid::kSix;  // numbers in one sum of a team
constexpr int kFewSums = 4;                     // numbers that every thread of a block sums over the warps itself
// Cost model of a large body, from times on an H100: 0.27 ms of a block for 9,261 vertices; for the whole device 15 us
// for 17,576 and 80 us for 195,112 vertices.
constexpr int64_t kBegun = 450, kFaster = 85;

template <int n, class F>
__device__ __forceinline__ void own_sum(int32_t first, int32_t count, int32_t stride, double* out, const F& f) {
#pragma unroll
  for (int k = 0; k < n; ++k) out[k] = 0;
  for (int32_t i = first; i < count; i += stride) f(i, out);
}

// Butterfly sums, after which every lane holds the same bits.
template <int n, int width>
__device__ __forceinline__ void butterfly(unsigned mask, double* out) {
  constexpr int kAtOnce = 8;  // more need registers without a gain
  if constexpr (n > kAtOnce) {
    butterfly<kAtOnce, width>(mask, out);
    butterfly<n - kAtOnce, width>(mask, out + kAtOnce);
  } else {
    double own[n];
#pragma unroll
    for (int k = 0; k < n; ++k) own[k] = out[k];
#pragma unroll
    for (int d = width / 2; d > 0; d /= 2) add_from(own, d, mask);
#pragma unroll
    for (int k = 0; k < n; ++k) out[k] = own[k];
  }
}

// Sums of 32 numbers over the lanes of a warp, each delivered to the lane of its number: every exchange halves the
// numbers. Same bits as a butterfly.
template <int half = 16>
__device__ __forceinline__ double sums_by_lane(double* of) {
  const bool upper = threadIdx.x & half;
#pragma unroll
  for (int k = 0; k < half; ++k) {
    const double kept = upper ? of[k + half] : of[k], sent = upper ? of[k] : of[k + half];
    of[k] = kept + __shfl_xor_sync(kWholeWarp, sent, half);
  }
  if constexpr (half > 1) return sums_by_lane<half / 2>(of);
  return of[0];
}

// Minimum over `width` lanes.
template <int width>
__device__ __forceinline__ double butterfly_least(unsigned mask, double value) {
#pragma unroll
  for (int d = width / 2; d > 0; d /= 2) value = fmin(value, __shfl_xor_sync(mask, value, d, width));
  return value;
}

template <class F>
__device__ __forceinline__ double own_least(int32_t first, int32_t count, int32_t stride, const F& f) {
  double out = CUDART_INF;
  for (int32_t i = first; i < count; i += stride) out = fmin(out, f(i));
  return out;
}

template <int n, class F>
__device__ __forceinline__ void own_most(int32_t first, int32_t count, int32_t stride, double* out, const F& f) {
  for (int k = 0; k < n; ++k) out[k] = 0;
  for (int32_t i = first; i < count; i += stride) {
    double own[n];
    f(i, own);
    for (int k = 0; k < n; ++k) out[k] = larger(out[k], own[k]);
  }
}
template <int n, int width>
__device__ __forceinline__ void butterfly_most(unsigned mask, double* out) {
#pragma unroll
  for (int d = width / 2; d > 0; d /= 2) {
    double other[n];
#pragma unroll
    for (int k = 0; k < n; ++k) other[k] = __shfl_xor_sync(mask, out[k], d, width);
#pragma unroll
    for (int k = 0; k < n; ++k) out[k] = larger(out[k], other[k]);
  }
}

// `width` lanes of a warp.
template <int width>
struct Tile {
  int lane;
  unsigned mask;
  __device__ Tile()
      : lane(threadIdx.x % width), mask(width == 1 ? 0 : (~0u >> (32 - width)) << (threadIdx.x % 32 / width * width)) {}
  __device__ bool leads() const { return lane == 0; }
  __device__ int number() const { return lane; }
  template <int n, class F>
  __device__ void sum(int32_t count, double* out, const F& f) const {
    own_sum<n>(lane, count, width, out, f);
    meet();
    if constexpr (width > 1) butterfly<n, width>(mask, out);
  }
  template <class F>
  __device__ double least(int32_t count, const F& f) const {
    const double own = own_least(lane, count, width, f);
    meet();
    if constexpr (width > 1) return butterfly_least<width>(mask, own);
    return own;
  }
  // As in BlockTeam.
  template <int n, class F>
  __device__ void most(int32_t count, double* out, const F& f) const {
    own_most<n>(lane, count, width, out, f);
    meet();
    if constexpr (width > 1) butterfly_most<n, width>(mask, out);
  }
  __device__ void meet() const {
    if constexpr (width > 1) __syncwarp(mask);
  }
  template <class F>
  __device__ void each(int32_t count, const F& f) const {
    for (int32_t i = lane; i < count; i += width) f(i);
  }
};

struct BlockTeam {
  double (*part)[kMostSums];  // [kWarps], shared
  __device__ bool leads() const { return threadIdx.x == 0; }
  __device__ static int number() { return static_cast<int>(threadIdx.x); }
  template <int n, class F>
  __device__ void sum(int32_t count, double* out, const F& f) const {
    static_assert(n <= kMostSums);
    own_sum<n>(static_cast<int32_t>(threadIdx.x), count, kThreads, out, f);
    reduce<n>(out);
  }
  template <class F>
  __device__ double least(int32_t count, const F& f) const {
    return reduce_least(own_least(static_cast<int32_t>(threadIdx.x), count, kThreads, f));
  }
  // maximum of each of n numbers >= 0 that f(i, of) gives, or NaN
  template <int n, class F>
  __device__ void most(int32_t count, double* out, const F& f) const {
    static_assert(n <= kMostSums);
    own_most<n>(static_cast<int32_t>(threadIdx.x), count, kThreads, out, f);
    butterfly_most<n, 32>(kWholeWarp, out);
    for (int k = 0; k < n && threadIdx.x % 32 == 0; ++k) part[threadIdx.x / 32][k] = out[k];
    __syncthreads();
    for (int k = 0; k < n; ++k) {
      for (int w = 0; w < kWarps; ++w) out[k] = larger(out[k], part[w][k]);
    }
    __syncthreads();
  }
  __device__ void meet() const { __syncthreads(); }
  template <class F>
  __device__ void each(int32_t count, const F& f) const {
    for (int32_t i = static_cast<int32_t>(threadIdx.x); i < count; i += kThreads) f(i);
  }
  __device__ double reduce_least(double own) const {
    own = butterfly_least<32>(kWholeWarp, own);
    if (threadIdx.x % 32 == 0) part[threadIdx.x / 32][0] = own;
    __syncthreads();
    for (int w = 0; w < kWarps; ++w) own = fmin(own, part[w][0]);
    __syncthreads();
    return own;
  }
  template <int n>
  __device__ void reduce(double* out) const {
    const int warp = static_cast<int>(threadIdx.x / 32), lane = static_cast<int>(threadIdx.x % 32);
    if constexpr (n <= kFewSums) {
      butterfly<n, 32>(kWholeWarp, out);
      for (int k = 0; k < n && lane == 0; ++k) part[warp][k] = out[k];
      __syncthreads();
      for (int k = 0; k < n; ++k) out[k] = of_warps(k);
    } else {  // one thread sums one number over the warps
      double all[32];
#pragma unroll
      for (int k = 0; k < 32; ++k) all[k] = k < n ? out[k] : 0;
      const double own = sums_by_lane(all);
      if (lane < n) part[warp][lane] = own;
      __syncthreads();
      if (threadIdx.x < n) part[0][lane] = of_warps(lane);
      __syncthreads();
#pragma unroll
      for (int k = 0; k < n; ++k) out[k] = part[0][k];
    }
    __syncthreads();
  }
  __device__ double of_warps(int k) const {
    double sum = part[0][k];
    for (int w = 1; w < kWarps; ++w) sum += part[w][k];
    return sum;
  }
};

// Calls f(b, team) for bodies of size(b) vertices: a warp for each, or the block for large ones.
template <class Size, class F>
__device__ __forceinline__ void each_body_of(int32_t count, const BlockTeam& block, const Size& size, const F& f) {
  for (auto b = static_cast<int32_t>(threadIdx.x / 32); b < count; b += kWarps) {
    if (size(b) <= kOfWarp) f(b, Tile<32>());
  }
  for (int32_t b = 0; b < count; ++b) {
    if (size(b) > kOfWarp) f(b, block);
  }
}

struct DeviceTeam {
  BlockTeam block;
  double* workspace;  // [2, blocks, kMostSums]
  mutable int turn = 0;
  __device__ bool leads() const { return block.leads(); }  // each block has its own record
  template <int n, class F>
  __device__ void sum(int32_t count, double* out, const F& f) const {
    own_sum<n>(first(), count, stride(), out, f);
    block.reduce<n>(out);
    double* to = share<n>(out);
    own_sum<n>(static_cast<int32_t>(threadIdx.x), static_cast<int32_t>(gridDim.x), kThreads, out,
               [&](int32_t b, double* sum) {
                 for (int k = 0; k < n; ++k) sum[k] += __ldcg(to + b * kMostSums + k);
               });
    block.reduce<n>(out);
  }
  template <class F>
  __device__ double least(int32_t count, const F& f) const {
    const double own = block.reduce_least(own_least(first(), count, stride(), f));
    const double* of = share<1>(&own);
    return block.reduce_least(own_least(static_cast<int32_t>(threadIdx.x), static_cast<int32_t>(gridDim.x), kThreads,
                                        [&](int32_t b) { return __ldcg(of + b * kMostSums); }));
  }
  __device__ void meet() const { cooperative_groups::this_grid().sync(); }
  template <class F>
  __device__ void each(int32_t count, const F& f) const {
    for (int32_t i = first(); i < count; i += stride()) f(i);
  }
  // Sums of all blocks, in the workspace. Two buffers alternate, so that one barrier per sum suffices.
  template <int n>
  __device__ double* share(const double* own) const {
    double* to = workspace + static_cast<int64_t>(turn) * gridDim.x * kMostSums;
    turn = 1 - turn;
    if (threadIdx.x == 0) {
      for (int k = 0; k < n; ++k) to[blockIdx.x * kMostSums + k] = own[k];
    }
    cooperative_groups::this_grid().sync();
    return to;
  }
  __device__ int32_t first() const { return static_cast<int32_t>(blockIdx.x * kThreads + threadIdx.x); }
  __device__ int32_t stride() const { return static_cast<int32_t>(gridDim.x * kThreads); }
};

// Records in shared memory, declared by size: shared memory runs no constructors.
struct alignas(8) RecordBytes {
  unsigned char bytes[sizeof(rigid::Iteration) * rigid::kMaxIterations];
  __device__ rigid::Iteration* get() { return reinterpret_cast<rigid::Iteration*>(bytes); }
};

template <int width, class T, class Act>
__global__ void __launch_bounds__(kTileThreads)
    small_bodies(const __grid_constant__ rigid::Inputs<T> in, const __grid_constant__ Act act, int32_t first,
                 int32_t bodies) {
  constexpr int tiles = kTileThreads / width;
  const int64_t item = static_cast<int64_t>(blockIdx.x) * tiles + threadIdx.x / width;
  if (item >= in.scenes * bodies) return;
  const rigid::Body<T> body{in, item / bodies, static_cast<int32_t>(first + item % bodies)};
  if constexpr (width == 1) {  // records of all threads do not fit into shared memory
    RecordBytes record;
    act(body, Tile<width>(), record.get());
  } else {
    __shared__ RecordBytes records[Act::keeps_record ? tiles : 1];
    act(body, Tile<width>(), records[Act::keeps_record ? threadIdx.x / width : 0].get());
  }
}
template <int width, class T, class Act>
void launch_small(const rigid::Inputs<T>& in, const Act& act, int32_t first, int32_t bodies, cudaStream_t stream) {
  constexpr int tiles = kTileThreads / width;
  const int64_t items = in.scenes * bodies;
  small_bodies<width>
      <<<static_cast<unsigned>((items + tiles - 1) / tiles), kTileThreads, 0, stream>>>(in, act, first, bodies);
}

template <class T, class Act>
__global__ void __launch_bounds__(kThreads)
    medium_bodies(const __grid_constant__ rigid::Inputs<T> in, const __grid_constant__ Act act, int32_t first,
                  int32_t bodies) {
  __shared__ RecordBytes record;
  __shared__ double part[kWarps][kMostSums];
  const int64_t item = blockIdx.x;
  const rigid::Body<T> body{in, item / bodies, static_cast<int32_t>(first + item % bodies)};
  act(body, BlockTeam{part}, record.get());
}

template <class T, class Act>
__global__ void __launch_bounds__(kThreads)
    large_bodies(const __grid_constant__ rigid::Inputs<T> in, const __grid_constant__ Act act, int32_t first,
                 int32_t bodies, double* workspace) {
  __shared__ RecordBytes record;
  __shared__ double part[kWarps][kMostSums];
  const DeviceTeam team{BlockTeam{part}, workspace};
  for (int64_t item = 0; item < in.scenes * bodies; ++item) {
    const rigid::Body<T> body{in, item / bodies, static_cast<int32_t>(first + item % bodies)};
    act(body, team, record.get());
  }
}

// Vertices of all scenes, one thread each.
constexpr int kVertexThreads = 128;
template <class T>
unsigned blocks_of(const rigid::Inputs<T>& in) {
  return blocks_for(in.scenes * in.vertices, kVertexThreads);
}
struct Row {
  int64_t scene;
  int32_t vertex;
  bool exists;
  template <class T>
  __device__ explicit Row(const rigid::Inputs<T>& in) {
    const int64_t row = own_item(kVertexThreads);
    exists = row < in.scenes * in.vertices;
    scene = row / in.vertices;
    vertex = static_cast<int32_t>(row % in.vertices);
  }
};

inline int multiprocessors() {
  int device = 0, count = 1;
  cudaGetDevice(&device);
  cudaDeviceGetAttribute(&count, cudaDevAttrMultiProcessorCount, device);
  return count;
}

// Whether large bodies take one block each. The whole device takes them one after another, in the time in which a block
// processes kBegun vertices plus 1 / kFaster of the rest.
inline bool by_block(const BodyGroups& groups, int64_t scenes, int64_t vertices) {
  if (groups.large == 0) return false;
  const int64_t size = vertices / groups.large;  // upper bound of the average
  return scenes * groups.large * (kBegun + size / kFaster) >= size;
}

// Calls act(body, team, record) for all bodies of all scenes.
template <class T, class Act>
cudaError_t run_bodies(const rigid::Inputs<T>& in, BodyGroups groups, const Act& act, double* workspace,
                       cudaStream_t stream) {
  if (in.scenes == 0) return cudaSuccess;
  // limited by arithmetic rather than memory
  if (Act::computes && in.scenes * groups.tiny >= kEnoughThreads) {
    launch_small<1>(in, act, 0, groups.tiny, stream);
  } else if (groups.tiny > 0) {
    launch_small<Act::computes ? kTile : kTinyTile>(in, act, 0, groups.tiny, stream);
  }
  const int32_t medium = groups.tiny + groups.small;
  if (groups.small > 0) launch_small<kTile>(in, act, groups.tiny, groups.small, stream);
  if (by_block(groups, in.scenes, in.vertices)) groups.medium += groups.large, groups.large = 0;
  if (groups.medium > 0) {
    medium_bodies<T>
        <<<static_cast<unsigned>(in.scenes * groups.medium), kThreads, 0, stream>>>(in, act, medium, groups.medium);
  }
  if (groups.large > 0) {
    int32_t first = medium + groups.medium, bodies = groups.large;
    void* arguments[] = {const_cast<rigid::Inputs<T>*>(&in), const_cast<Act*>(&act), &first, &bodies, &workspace};
    const auto kernel = reinterpret_cast<const void*>(&large_bodies<T, Act>);
    const auto error = cudaLaunchCooperativeKernel(kernel, multiprocessors(), kThreads, arguments, 0, stream);
    if (error != cudaSuccess) return error;
  }
  return cudaGetLastError();
}

}  // namespace diffvbd::cuda
