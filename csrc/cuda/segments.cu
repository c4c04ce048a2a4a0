#include "block_sum.cuh"
#include "exchange.cuh"
#include "segments.h"

namespace diffvbd::cuda {
namespace {

constexpr int kThreads = 256;
constexpr int kWarp = 32, kLongSegment = 512;  // threads for a sum of up to so many terms; above, kThreads
constexpr int64_t kFewTerms = 32;              // of a segment on average, up to which a thread adds one up
constexpr int32_t kShortSegment = 512;         // terms up to which it may
constexpr int64_t kManySums = 1 << 15;         // of longer ones, above which a warp adds up all columns of a segment

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

// The sum of one column of a segment, always in the same order, whoever adds it up: of a short one kWarp threads, of a
// long one kThreads take every so many terms, and half of them add what the others have, again and again.
template <class T>
struct Column {
  const T* values;  // of its first item
  const int32_t* order;
  int64_t c;
  int32_t begin, end;
  __device__ bool is_long() const { return end - begin > kLongSegment; }
  // What one of so many threads has.
  __device__ T part(int thread, int threads) const {
    T sum = T(0);
    for (int32_t e = begin + thread; e < end; e += threads) sum += values[order[e] * c];
    return sum;
  }
};
template <class T>
__device__ Column<T> column_of(const T* values, const int32_t* order, const int32_t* ptr, int64_t items,
                               int64_t segments, int64_t c, int64_t row, int64_t k) {
  const int64_t scene = row / segments, s = row - scene * segments;
  return {values + scene * items * c + k, order, c, ptr[s], ptr[s + 1]};
}

// A warp for some columns of a segment, one after another.
template <class T>
__global__ void __launch_bounds__(kThreads)
    warp_segments_sync_kernel(const T* values, const int32_t* order, const int32_t* ptr, int64_t scenes, int64_t items,
                              int64_t segments, int64_t c, int64_t columns, T* out) {
  const int64_t warp = (static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x) / kWarp, groups = c / columns;
  if (warp >= scenes * segments * groups) return;
  const int64_t row = warp / groups, first = (warp - row * groups) * columns;
  const auto lane = static_cast<int>(threadIdx.x % kWarp);
  for (int64_t k = first; k < first + columns; ++k) {
    const Column<T> own = column_of(values, order, ptr, items, segments, c, row, k);
    T sum;
    if (own.is_long()) {  // as many threads would
      T parts[kThreads / kWarp];
      for (int w = 0; w < kThreads / kWarp; ++w) parts[w] = own.part(lane + kWarp * w, kThreads);
      for (int half = kThreads / kWarp / 2; half > 0; half /= 2) {
        for (int w = 0; w < half; ++w) parts[w] += parts[w + half];
      }
      sum = parts[0];
    } else {
      sum = own.part(lane, kWarp);
    }
    for (int half = kWarp / 2; half > 0; half /= 2) sum += __shfl_down_sync(kWholeWarp, sum, half);
    if (lane == 0) out[row * c + k] = sum;
  }
}

// A block for each column of each segment.
template <class T>
__global__ void __launch_bounds__(kThreads)
    segments_sync_kernel(const T* values, const int32_t* order, const int32_t* ptr, int64_t items, int64_t segments,
                         int64_t c, T* out) {
  __shared__ T part[kThreads];
  const int64_t row = blockIdx.x / c;
  const Column<T> own = column_of(values, order, ptr, items, segments, c, row, blockIdx.x - row * c);
  const auto thread = static_cast<int>(threadIdx.x);
  const T sum = own.is_long() ? own.part(thread, kThreads) : thread < kWarp ? own.part(thread, kWarp) : T(0);
  const T total = block_sum(sum, part, [](T& a, const T& b) { a += b; });
  if (thread == 0) out[blockIdx.x] = total;
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
  const int64_t sums = scenes * segments * c;
  if (items > kLongSegment * segments) {
    segments_sync_kernel<<<static_cast<unsigned>(sums), kThreads, 0, stream>>>(values, order, ptr, items, segments, c,
                                                                               out);
    return cudaGetLastError();
  }
  const int64_t columns = sums > kManySums ? c : 1, warps = sums / columns;
  const auto blocks = static_cast<unsigned>((warps * kWarp + kThreads - 1) / kThreads);
  warp_segments_sync_kernel<<<blocks, kThreads, 0, stream>>>(values, order, ptr, scenes, items, segments, c, columns,
                                                             out);
  return cudaGetLastError();
}

#define DIFFVBD_INSTANTIATE(T)                                                                                      \
  template cudaError_t segment_sum<T>(const T*, const int32_t*, const int32_t*, int64_t, int64_t, int64_t, int64_t, \
                                      T*, cudaStream_t);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd::cuda
