// A team of threads for each body: 8 lanes of a warp, a block, or, one body after another, the whole device.
#include <cooperative_groups.h>

#include "rigid.h"

namespace diffvbd::cuda {
namespace {

constexpr int kTile = 8, kTileThreads = 128, kTiles = kTileThreads / kTile;
constexpr int kThreads = 256, kWarps = kThreads / 32;
constexpr int kMostSums = 1 + 6 + rigid::kSix;  // numbers that a team adds up at once
constexpr int64_t kEnoughBlocks = 48;           // large bodies of all scenes that fill the device with a block each

template <int n, class F>
__device__ __forceinline__ void own_sum(int32_t first, int32_t count, int32_t stride, double* out, const F& f) {
#pragma unroll
  for (int k = 0; k < n; ++k) out[k] = 0;
  for (int32_t i = first; i < count; i += stride) f(i, out);
}

// Sums by a butterfly, after which every lane holds the same bits.
template <int n, int width>
__device__ __forceinline__ void butterfly(unsigned mask, double* out) {
#pragma unroll
  for (int k = 0; k < n; ++k) {
#pragma unroll
    for (int d = width / 2; d > 0; d /= 2) out[k] += __shfl_xor_sync(mask, out[k], d, width);
  }
}

struct Tile {
  int lane;
  unsigned mask;
  __device__ Tile() : lane(threadIdx.x % kTile), mask(((1u << kTile) - 1) << (threadIdx.x % 32 / kTile * kTile)) {}
  __device__ bool leads() const { return lane == 0; }
  template <int n, class F>
  __device__ void sum(int32_t count, double* out, const F& f) const {
    own_sum<n>(lane, count, kTile, out, f);
    __syncwarp(mask);
    butterfly<n, kTile>(mask, out);
  }
  template <class F>
  __device__ void each(int32_t count, const F& f) const {
    for (int32_t i = lane; i < count; i += kTile) f(i);
  }
};

struct BlockTeam {
  double (*part)[kMostSums];  // [kWarps], shared
  __device__ bool leads() const { return threadIdx.x == 0; }
  template <int n, class F>
  __device__ void sum(int32_t count, double* out, const F& f) const {
    static_assert(n <= kMostSums);
    own_sum<n>(static_cast<int32_t>(threadIdx.x), count, kThreads, out, f);
    reduce<n>(out);
  }
  template <class F>
  __device__ void each(int32_t count, const F& f) const {
    for (int32_t i = static_cast<int32_t>(threadIdx.x); i < count; i += kThreads) f(i);
  }
  template <int n>
  __device__ void reduce(double* out) const {
    butterfly<n, 32>(0xffffffffu, out);
    if (threadIdx.x % 32 == 0) {
      for (int k = 0; k < n; ++k) part[threadIdx.x / 32][k] = out[k];
    }
    __syncthreads();
    for (int k = 0; k < n; ++k) {
      double sum = part[0][k];
      for (int w = 1; w < kWarps; ++w) sum += part[w][k];
      out[k] = sum;
    }
    __syncthreads();
  }
};

struct DeviceTeam {
  BlockTeam block;
  double* workspace;  // [2, blocks, kMostSums]
  mutable int turn = 0;
  __device__ bool leads() const { return block.leads(); }  // each block keeps a record of its own
  template <int n, class F>
  __device__ void sum(int32_t count, double* out, const F& f) const {
    own_sum<n>(first(), count, stride(), out, f);
    block.reduce<n>(out);
    double* to = workspace + static_cast<int64_t>(turn) * gridDim.x * kMostSums;  // two in turn: one barrier a sum
    turn = 1 - turn;
    if (threadIdx.x == 0) {
      for (int k = 0; k < n; ++k) to[blockIdx.x * kMostSums + k] = out[k];
    }
    cooperative_groups::this_grid().sync();
    own_sum<n>(static_cast<int32_t>(threadIdx.x), static_cast<int32_t>(gridDim.x), kThreads, out,
               [&](int32_t b, double* sum) {
                 for (int k = 0; k < n; ++k) sum[k] += __ldcg(to + b * kMostSums + k);
               });
    block.reduce<n>(out);
  }
  template <class F>
  __device__ void each(int32_t count, const F& f) const {
    for (int32_t i = first(); i < count; i += stride()) f(i);
  }
  __device__ int32_t first() const { return static_cast<int32_t>(blockIdx.x * kThreads + threadIdx.x); }
  __device__ int32_t stride() const { return static_cast<int32_t>(gridDim.x * kThreads); }
};

// What a kernel does to a body: the correction, or its transpose.
template <class T, bool energies>
struct Forward {
  static constexpr bool keeps_record = false;
  T* x;
  template <class Team>
  __device__ void operator()(const rigid::Body<T>& body, const Team& team, rigid::Iteration*) const {
    rigid::correct<energies>(body, team, nullptr, x);
  }
};
template <class T, bool energies>
struct Reverse {
  static constexpr bool keeps_record = energies;
  rigid::Adjoints<T> a;
  template <class Team>
  __device__ void operator()(const rigid::Body<T>& body, const Team& team, rigid::Iteration* record) const {
    rigid::reverse<energies>(body, team, record, a);
  }
};

// A record has no constructor that shared memory could run, so it is named by its size.
struct alignas(8) RecordBytes {
  unsigned char bytes[sizeof(rigid::Iteration) * rigid::kMaxIterations];
  __device__ rigid::Iteration* get() { return reinterpret_cast<rigid::Iteration*>(bytes); }
};

template <class T, class Act>
__global__ void __launch_bounds__(kTileThreads)
    small_bodies(const __grid_constant__ rigid::Inputs<T> in, const __grid_constant__ Act act, int32_t bodies) {
  __shared__ RecordBytes records[Act::keeps_record ? kTiles : 1];
  const int64_t item = static_cast<int64_t>(blockIdx.x) * kTiles + threadIdx.x / kTile;
  if (item >= in.scenes * bodies) return;
  const rigid::Body<T> body{in, item / bodies, static_cast<int32_t>(item % bodies)};
  act(body, Tile(), records[Act::keeps_record ? threadIdx.x / kTile : 0].get());
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

int multiprocessors() {
  int device = 0, count = 1;
  cudaGetDevice(&device);
  cudaDeviceGetAttribute(&count, cudaDevAttrMultiProcessorCount, device);
  return count;
}

// Whether large bodies take a block each: there are enough of them.
bool by_block(const RigidGroups& groups, int64_t scenes) { return scenes * groups.large >= kEnoughBlocks; }

template <class T, class Act>
cudaError_t run(const rigid::Inputs<T>& in, RigidGroups groups, const Act& act, double* workspace,
                cudaStream_t stream) {
  if (in.scenes == 0) return cudaSuccess;
  if (groups.small > 0) {
    const int64_t items = in.scenes * groups.small;
    small_bodies<T>
        <<<static_cast<unsigned>((items + kTiles - 1) / kTiles), kTileThreads, 0, stream>>>(in, act, groups.small);
  }
  if (by_block(groups, in.scenes)) groups.medium += groups.large, groups.large = 0;
  if (groups.medium > 0) {
    medium_bodies<T><<<static_cast<unsigned>(in.scenes * groups.medium), kThreads, 0, stream>>>(in, act, groups.small,
                                                                                                groups.medium);
  }
  if (groups.large > 0) {
    int32_t first = groups.small + groups.medium, bodies = groups.large;
    void* arguments[] = {const_cast<rigid::Inputs<T>*>(&in), const_cast<Act*>(&act), &first, &bodies, &workspace};
    const auto kernel = reinterpret_cast<const void*>(&large_bodies<T, Act>);
    const auto error = cudaLaunchCooperativeKernel(kernel, multiprocessors(), kThreads, arguments, 0, stream);
    if (error != cudaSuccess) return error;
  }
  return cudaGetLastError();
}

}  // namespace

int64_t rigid_workspace(const RigidGroups& groups, int64_t scenes) {
  if (groups.large == 0 || by_block(groups, scenes)) return 0;
  return int64_t{2} * multiprocessors() * kMostSums;
}

template <class T>
cudaError_t rigid_correct(const rigid::Inputs<T>& in, const RigidGroups& groups, T* x, double* workspace,
                          cudaStream_t stream) {
  if (in.data.data) return run(in, groups, Forward<T, true>{x}, workspace, stream);
  return run(in, groups, Forward<T, false>{x}, workspace, stream);
}

template <class T>
cudaError_t rigid_reverse(const rigid::Inputs<T>& in, const RigidGroups& groups, const rigid::Adjoints<T>& a,
                          double* workspace, cudaStream_t stream) {
  if (in.data.data) return run(in, groups, Reverse<T, true>{a}, workspace, stream);
  return run(in, groups, Reverse<T, false>{a}, workspace, stream);
}

#define DIFFVBD_INSTANTIATE(T)                                                                                   \
  template cudaError_t rigid_correct<T>(const rigid::Inputs<T>&, const RigidGroups&, T*, double*, cudaStream_t); \
  template cudaError_t rigid_reverse<T>(const rigid::Inputs<T>&, const RigidGroups&, const rigid::Adjoints<T>&,  \
                                        double*, cudaStream_t);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd::cuda
