// Arrays: clears, gathers and sums in a fixed order.
#include <algorithm>

#include "arrays.h"
#include "common.cuh"
#include "step.h"
#include "warp_reduce.cuh"

namespace diffvbd::cuda {
namespace {

constexpr int kThreads = 256, kMost = 8;  // spans per launch
constexpr int64_t kBlocks = 1024;         // of a span, at most

struct Spans {
  Span of[kMost];
};

// A row of blocks for each span.
__global__ void __launch_bounds__(kThreads) clear_kernel(const __grid_constant__ Spans spans) {
  const Span& own = spans.of[blockIdx.y];
  const int64_t first = own_item(kThreads);
  const int64_t used = own.entries ? *own.entries / 4 * own.row : own.bytes,
                bytes = used < own.bytes ? used : own.bytes;
  const int64_t step = static_cast<int64_t>(gridDim.x) * kThreads, wide = bytes / static_cast<int64_t>(sizeof(uint4));
  for (int64_t i = first; i < wide; i += step) static_cast<uint4*>(own.data)[i] = uint4{};
  const int64_t words = bytes / static_cast<int64_t>(sizeof(uint32_t));
  for (int64_t i = 4 * wide + first; i < words; i += step) static_cast<uint32_t*>(own.data)[i] = 0;
  for (int64_t i = 4 * words + first; i < bytes; i += step) static_cast<uint8_t*>(own.data)[i] = 0;
}

constexpr int64_t kShortRow = 32;  // a row of at most this many columns is summed by one thread
constexpr int64_t kChunk = 4096;   // a longer one by blocks of threads, each this many columns

template <class T>
__global__ void pack_rest_kernel(GroupPlan plan, int64_t scenes, const T* rest, T* packed) {
  constexpr int width = 16 / sizeof(T);
  const int64_t pairs = static_cast<int64_t>(plan.slots) * kSlice, i = own_item();
  if (i >= scenes * pairs) return;
  const int64_t scene = i / pairs, pair = i - scene * pairs, slot = pair / kSlice, lane = pair % kSlice;
  const int32_t entry = plan.pair[pair];
  T values[kRestRow] = {};
  if (entry >= 0) {
    const T* row = rest + (scene * plan.num_tets + (entry >> 2)) * kRestScalars;
    const int own = entry & 3;
    for (int a = 0; a < kPairRest; ++a) values[a] = row[TetLayout::rest_index(own, a)];
  } else {  // whose parameters are those of some tet
    for (int a = TetLayout::pair_shape; a < kPairRest; ++a) values[a] = rest[TetLayout::rest_index(0, a)];
  }
  T* to = packed + scene * pairs * kRestRow;
#pragma unroll
  for (int a = 0; a < kRestRow; ++a) {
    to[((slot * (kRestRow / width) + a / width) * kSlice + lane) * width + a % width] = values[a];
  }
}

template <class T>
__global__ void gather_kernel(const T* values, const int64_t* index, int64_t scenes, int64_t vertices, int64_t n,
                              int64_t c, T* out) {
  const int64_t i = own_item();
  if (i >= scenes * n * c) return;
  const int64_t row = i / c, k = i - row * c, scene = row / n;
  out[i] = values[(scene * vertices + index[row - scene * n]) * c + k];
}

template <class T>
__global__ void segment_kernel(const T* values, const int64_t* ptr, const int32_t* entry, int64_t scenes, int64_t n,
                               int64_t segments, int64_t c, T* out) {
  const int64_t i = own_item();
  if (i >= scenes * segments * c) return;
  const int64_t row = i / c, k = i - row * c, scene = row / segments, v = row - scene * segments;
  T sum = T(0);
  for (int64_t e = ptr[v]; e < ptr[v + 1]; ++e) sum += values[(scene * n + entry[e]) * c + k];
  out[i] = sum;
}

template <class T>
__global__ void short_rows_kernel(const T* values, int64_t rows, int64_t columns, T* out) {
  const int64_t i = own_item();
  if (i >= rows) return;
  T sum = T(0);
  for (int64_t k = 0; k < columns; ++k) sum += values[i * columns + k];
  out[i] = sum;
}

// A block for each chunk of each row.
template <class T>
__global__ void chunk_kernel(const T* values, int64_t columns, int64_t chunks, T* out) {
  __shared__ T part[kThreads];
  const int64_t row = blockIdx.x / chunks, chunk = blockIdx.x - row * chunks;
  const int64_t end = min(columns, (chunk + 1) * kChunk);
  T sum = T(0);
  for (int64_t k = chunk * kChunk + threadIdx.x; k < end; k += kThreads) sum += values[row * columns + k];
  part[threadIdx.x] = sum;
  reduce_block<kThreads>(part, [](T& own, const T& other) { own += other; });
  if (threadIdx.x == 0) out[blockIdx.x] = part[0];
}

int64_t chunks_of(int64_t columns) { return (columns + kChunk - 1) / kChunk; }

constexpr int kWarp = 32, kLongSegment = 512;  // threads for a sum of up to so many terms; otherwise kThreads
constexpr int64_t kFewTerms = 32;              // terms of a segment on average up to which a thread sums it
constexpr int32_t kShortSegment = 512;         // terms up to which it may
constexpr int64_t kManySums = 1 << 15;  // sums of longer segments above which a warp sums all columns of a segment

// A block for kThreads segments of a scene: a thread for each column of a short one, all threads for a long one.
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

// Sum of one column of a segment in a fixed order, by any kernel: kWarp threads for a short one, kThreads for a long
// one take every so many terms, and halve their number again and again.
template <class T>
struct Column {
  const T* values;  // of the first item
  const int32_t* order;
  int64_t c;
  int32_t begin, end;
  __device__ bool is_long() const { return end - begin > kLongSegment; }
  // Part of one of `threads` threads.
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

// A warp for some columns of a segment in turn.
template <class T>
__global__ void __launch_bounds__(kThreads)
    warp_segments_sync_kernel(const T* values, const int32_t* order, const int32_t* ptr, int64_t scenes, int64_t items,
                              int64_t segments, int64_t c, int64_t columns, T* out) {
  const int64_t warp = own_item(kThreads) / kWarp, groups = c / columns;
  if (warp >= scenes * segments * groups) return;
  const int64_t row = warp / groups, first = (warp - row * groups) * columns;
  const auto lane = static_cast<int>(threadIdx.x % kWarp);
  for (int64_t k = first; k < first + columns; ++k) {
    const Column<T> own = column_of(values, order, ptr, items, segments, c, row, k);
    T sum;
    if (own.is_long()) {  // the order of kThreads threads
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

cudaError_t clear(const std::vector<Span>& given, cudaStream_t stream) {
  Spans spans{};
  unsigned count = 0;
  int64_t most = 0;
  const auto launch = [&] {
    const auto wide = static_cast<int64_t>(kThreads * sizeof(uint4));
    const auto blocks = static_cast<unsigned>(std::min(kBlocks, (most + wide - 1) / wide));
    if (count > 0) clear_kernel<<<dim3(blocks, count), kThreads, 0, stream>>>(spans);
    count = 0, most = 0;
    return cudaGetLastError();
  };
  for (const Span& span : given) {
    if (span.bytes == 0) continue;
    spans.of[count++] = span;
    most = std::max(most, span.bytes);
    if (count < kMost) continue;
    if (auto error = launch()) return error;
  }
  return launch();
}

template <class T>
cudaError_t pack_rest(const GroupPlan& plan, int64_t scenes, const T* rest, T* packed, cudaStream_t stream) {
  const int64_t items = scenes * plan.slots * kSlice;
  if (items > 0) pack_rest_kernel<<<blocks_for(items, kThreads), kThreads, 0, stream>>>(plan, scenes, rest, packed);
  return cudaGetLastError();
}

template <class T>
cudaError_t gather_rows(const T* values, const int64_t* index, int64_t scenes, int64_t vertices, int64_t n, int64_t c,
                        T* out, cudaStream_t stream) {
  const int64_t items = scenes * n * c;
  if (items > 0)
    gather_kernel<<<blocks_for(items, kThreads), kThreads, 0, stream>>>(values, index, scenes, vertices, n, c, out);
  return cudaGetLastError();
}

template <class T>
cudaError_t sum_segments(const T* values, const int64_t* ptr, const int32_t* entry, int64_t scenes, int64_t n,
                         int64_t segments, int64_t c, T* out, cudaStream_t stream) {
  const int64_t items = scenes * segments * c;
  if (items > 0) {
    segment_kernel<<<blocks_for(items, kThreads), kThreads, 0, stream>>>(values, ptr, entry, scenes, n, segments, c,
                                                                         out);
  }
  return cudaGetLastError();
}

int64_t partial_sums(int64_t rows, int64_t columns) {
  return columns <= kChunk ? 0 : rows * (chunks_of(columns) + partial_sums(1, chunks_of(columns)));
}

template <class T>
cudaError_t sum_rows(const T* values, int64_t rows, int64_t columns, T* partial, T* out, cudaStream_t stream) {
  if (rows == 0) return cudaSuccess;
  if (columns <= kShortRow) {
    short_rows_kernel<<<blocks_for(rows, kThreads), kThreads, 0, stream>>>(values, rows, columns, out);
    return cudaGetLastError();
  }
  const int64_t chunks = chunks_of(columns);
  T* sums = chunks == 1 ? out : partial;
  chunk_kernel<<<static_cast<unsigned>(rows * chunks), kThreads, 0, stream>>>(values, columns, chunks, sums);
  if (auto error = cudaGetLastError()) return error;
  return chunks == 1 ? cudaSuccess : sum_rows(sums, rows, chunks, partial + rows * chunks, out, stream);
}

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
  const auto blocks = blocks_for(warps * kWarp, kThreads);
  warp_segments_sync_kernel<<<blocks, kThreads, 0, stream>>>(values, order, ptr, scenes, items, segments, c, columns,
                                                             out);
  return cudaGetLastError();
}

DIFFVBD_INSTANTIATE(pack_rest)
DIFFVBD_INSTANTIATE(gather_rows)
DIFFVBD_INSTANTIATE(sum_segments)
DIFFVBD_INSTANTIATE(sum_rows)
DIFFVBD_INSTANTIATE(segment_sum)

}  // namespace diffvbd::cuda
