#include "block_sum.cuh"
#include "segments.h"

namespace diffvbd::cuda {
namespace {

constexpr int kThreads = 256;
constexpr int kWarp = 32, kLongSegment = 512;  // threads for a sum of fewer terms on average; above, kThreads
constexpr int64_t kFewTerms = 32;              // of a segment on average, up to which a thread adds one up
constexpr int32_t kShortSegment = 512;         // terms up to which it may
constexpr int64_t kManySums = 1 << 15;         // of longer ones that a block each is too much for

// A block for kThreads segments of a scene: a thread for each column of a short one, all for a long one.
template <class T>
__global__ void __launch_bounds__(kThreads)
    short_segments_sync_kernel(const T* values, const int32_t* order, const int32_t* ptr, int64_t items,
                               int64_t segments, int64_t c, T* out) {
  __shared__ T part[kThreads];
  const int64_t tiles = (segments + kThreads - 1) / kThreads, scene = blockIdx.x / tiles;
  const int64_t first = (blockIdx.x - scene * tiles) * kThreads;
  const int64_t last = first + kThreads < segments ? first + kThreads : segments;
  const T* own = values + scene * items * c;
  T* to = out + scene * segments * c;
  bool any_long = false;
  for (int64_t i = threadIdx.x; i < (last - first) * c; i += kThreads) {
    const int64_t s = first + i / c, k = i % c;
    if (ptr[s + 1] - ptr[s] > kShortSegment) {
      any_long = true;
      continue;
    }
    T sum = T(0);
    for (int32_t e = ptr[s]; e < ptr[s + 1]; ++e) sum += own[order[e] * c + k];
    to[s * c + k] = sum;
  }
  if (!__syncthreads_or(any_long)) return;
  for (int64_t s = first; s < last; ++s) {
    if (ptr[s + 1] - ptr[s] <= kShortSegment) continue;
    for (int64_t k = 0; k < c; ++k) {
      T sum = T(0);
      for (int64_t e = ptr[s] + int64_t{threadIdx.x}; e < ptr[s + 1]; e += kThreads) sum += own[order[e] * c + k];
      sum = block_sum(sum, part, [](T& a, const T& b) { a += b; });
      if (threadIdx.x == 0) to[s * c + k] = sum;
      __syncthreads();  // part is read
    }
  }
}

// A warp for each segment, with its columns side by side.
template <class T>
__global__ void __launch_bounds__(kThreads)
    warp_segments_sync_kernel(const T* values, const int32_t* order, const int32_t* ptr, int64_t scenes, int64_t items,
                              int64_t segments, int64_t c, T* out) {
  const int64_t row = (static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x) / kWarp;
  if (row >= scenes * segments) return;
  const int64_t scene = row / segments, s = row - scene * segments;
  const auto lane = static_cast<int>(threadIdx.x % kWarp);
  for (int64_t first = 0; first < c; first += kWarp) {
    const int width = c - first < kWarp ? static_cast<int>(c - first) : kWarp, parts = kWarp / width;
    const int part = lane / width;  // of the terms
    const int64_t k = first + lane % width;
    T sum = T(0);
    for (int32_t e = ptr[s] + part; part < parts && e < ptr[s + 1]; e += parts) {
      sum += values[(scene * items + order[e]) * c + k];
    }
    const T own = sum;
    for (int other = 1; other < parts; ++other) sum += __shfl_sync(0xffffffffu, own, (lane + other * width) % kWarp);
    if (part == 0) out[row * c + k] = sum;
  }
}

// A block for each column of each segment.
template <class T>
__global__ void segments_sync_kernel(const T* values, const int32_t* order, const int32_t* ptr, int64_t items,
                                     int64_t segments, int64_t c, T* out) {
  __shared__ T part[kThreads];
  const int64_t row = blockIdx.x / c, k = blockIdx.x - row * c, scene = row / segments, s = row - scene * segments;
  T own = T(0);
  for (int64_t e = ptr[s] + int64_t{threadIdx.x}; e < ptr[s + 1]; e += blockDim.x) {
    own += values[(scene * items + order[e]) * c + k];
  }
  const T sum = block_sum(own, part, [](T& a, const T& b) { a += b; });
  if (threadIdx.x == 0) out[blockIdx.x] = sum;
}

}  // namespace

template <class T>
cudaError_t segment_sum(const T* values, const int32_t* order, const int32_t* ptr, int64_t scenes, int64_t items,
                        int64_t segments, int64_t c, T* out, cudaStream_t stream) {
  if (scenes * segments * c == 0) return cudaSuccess;
  if (items <= kFewTerms * segments) {
    const auto tiles = static_cast<unsigned>(scenes * ((segments + kThreads - 1) / kThreads));
    short_segments_sync_kernel<<<tiles, kThreads, 0, stream>>>(values, order, ptr, items, segments, c, out);
    return cudaGetLastError();
  }
  if (scenes * segments * c > kManySums) {
    const auto blocks = static_cast<unsigned>((scenes * segments * kWarp + kThreads - 1) / kThreads);
    warp_segments_sync_kernel<<<blocks, kThreads, 0, stream>>>(values, order, ptr, scenes, items, segments, c, out);
    return cudaGetLastError();
  }
  const auto blocks = static_cast<unsigned>(scenes * segments * c);
  const int threads = items > kLongSegment * segments ? kThreads : kWarp;
  segments_sync_kernel<<<blocks, threads, 0, stream>>>(values, order, ptr, items, segments, c, out);
  return cudaGetLastError();
}

#define DIFFVBD_INSTANTIATE(T)                                                                                      \
  template cudaError_t segment_sum<T>(const T*, const int32_t*, const int32_t*, int64_t, int64_t, int64_t, int64_t, \
                                      T*, cudaStream_t);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd::cuda
