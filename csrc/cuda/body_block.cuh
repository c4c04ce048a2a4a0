// A block for each body of each scene, as large as bodies are on average.
#pragma once

#include "bodies.cuh"

namespace diffvbd::cuda {

constexpr int kWarp = 32, kMostThreads = 1024;
constexpr int kVertices = 4;  // of a body on average that a thread looks at before the block becomes larger

// A power of two.
inline int threads_for(int64_t vertices, int64_t bodies) {
  int threads = kWarp;
  while (threads < kMostThreads && vertices > kVertices * threads * bodies) threads *= 2;
  return threads;
}

// The team of such a block, for up to kSums numbers at once.
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
  // The numbers of each warp, once all are there.
  template <int n>
  __device__ void share(const double* own) const {
    static_assert(n <= kSums);
    if (threadIdx.x % kWarp == 0) {
      for (int k = 0; k < n; ++k) part[threadIdx.x / kWarp][k] = own[k];
    }
    __syncthreads();
  }
};

}  // namespace diffvbd::cuda
