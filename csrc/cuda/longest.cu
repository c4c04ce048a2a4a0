#include "body_block.cuh"
#include "longest.h"

namespace diffvbd::cuda {
namespace {

using contact::Longest;

constexpr unsigned kWholeWarp = 0xffffffff;

// The largest of a warp, at its first thread.
template <class T>
__device__ Longest<T> of_warp(Longest<T> own) {
  for (int d = kWarp / 2; d > 0; d /= 2) {
    own.keep({__shfl_down_sync(kWholeWarp, own.square, d), __shfl_down_sync(kWholeWarp, own.angle, d)});
  }
  return own;
}

// A block of whole warps for each scene and body.
template <class T>
__global__ void longest_sync_kernel(const __grid_constant__ contact::LongestInputs<T> in, T* out) {
  __shared__ Longest<T> part[kMostThreads / kWarp];
  const auto t = static_cast<int32_t>(threadIdx.x), threads = static_cast<int32_t>(blockDim.x);
  const int64_t row = blockIdx.x;
  Longest<T> own = of_warp(contact::longest_of_body(in, row / in.bodies, row % in.bodies, t, threads));
  if (threads > kWarp) {
    if (t % kWarp == 0) part[t / kWarp] = own;
    __syncthreads();
    if (t >= kWarp) return;
    own = of_warp(t < threads / kWarp ? part[t] : Longest<T>{T(0), T(0)});
  }
  if (t == 0) contact::store_longest(in, own, row, out);
}

}  // namespace

template <class T>
cudaError_t longest_ways(const contact::LongestInputs<T>& in, T* out, cudaStream_t stream) {
  const int64_t rows = in.scenes * in.bodies;
  if (rows == 0) return cudaSuccess;
  const int threads = threads_for(in.vertices, in.bodies);
  longest_sync_kernel<<<static_cast<unsigned>(rows), threads, 0, stream>>>(in, out);
  return cudaGetLastError();
}

template cudaError_t longest_ways<float>(const contact::LongestInputs<float>&, float*, cudaStream_t);
template cudaError_t longest_ways<double>(const contact::LongestInputs<double>&, double*, cudaStream_t);

}  // namespace diffvbd::cuda
