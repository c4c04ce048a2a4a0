#include "reductions.h"

namespace diffvbd::cuda {
namespace {

constexpr int kItemThreads = 256;
constexpr int64_t kShortRow = 32;  // a row of at most this many columns is summed by one thread
constexpr int64_t kChunk = 4096;   // a longer one by blocks of threads, each this many columns

unsigned blocks_for(int64_t items) { return static_cast<unsigned>((items + kItemThreads - 1) / kItemThreads); }

__device__ __forceinline__ int64_t own_item() { return static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x; }

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

// one block for each chunk of each row
template <class T>
__global__ void chunk_kernel(const T* values, int64_t columns, int64_t chunks, T* out) {
  __shared__ T part[kItemThreads];
  const int64_t row = blockIdx.x / chunks, chunk = blockIdx.x - row * chunks;
  const int64_t end = min(columns, (chunk + 1) * kChunk);
  T sum = T(0);
  for (int64_t k = chunk * kChunk + threadIdx.x; k < end; k += kItemThreads) sum += values[row * columns + k];
  part[threadIdx.x] = sum;
  for (int half = kItemThreads / 2; half > 0; half /= 2) {
    __syncthreads();
    if (threadIdx.x < half) part[threadIdx.x] += part[threadIdx.x + half];
  }
  if (threadIdx.x == 0) out[blockIdx.x] = part[0];
}

int64_t chunks_of(int64_t columns) { return (columns + kChunk - 1) / kChunk; }

}  // namespace

template <class T>
cudaError_t pack_rest(const GroupPlan& plan, int64_t scenes, const T* rest, T* packed, cudaStream_t stream) {
  const int64_t items = scenes * plan.slots * kSlice;
  if (items > 0) pack_rest_kernel<<<blocks_for(items), kItemThreads, 0, stream>>>(plan, scenes, rest, packed);
  return cudaGetLastError();
}

template <class T>
cudaError_t gather_rows(const T* values, const int64_t* index, int64_t scenes, int64_t vertices, int64_t n, int64_t c,
                        T* out, cudaStream_t stream) {
  const int64_t items = scenes * n * c;
  if (items > 0)
    gather_kernel<<<blocks_for(items), kItemThreads, 0, stream>>>(values, index, scenes, vertices, n, c, out);
  return cudaGetLastError();
}

template <class T>
cudaError_t sum_segments(const T* values, const int64_t* ptr, const int32_t* entry, int64_t scenes, int64_t n,
                         int64_t segments, int64_t c, T* out, cudaStream_t stream) {
  const int64_t items = scenes * segments * c;
  if (items > 0) {
    segment_kernel<<<blocks_for(items), kItemThreads, 0, stream>>>(values, ptr, entry, scenes, n, segments, c, out);
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
    short_rows_kernel<<<blocks_for(rows), kItemThreads, 0, stream>>>(values, rows, columns, out);
    return cudaGetLastError();
  }
  const int64_t chunks = chunks_of(columns);
  T* sums = chunks == 1 ? out : partial;
  chunk_kernel<<<static_cast<unsigned>(rows * chunks), kItemThreads, 0, stream>>>(values, columns, chunks, sums);
  if (auto error = cudaGetLastError()) return error;
  return chunks == 1 ? cudaSuccess : sum_rows(sums, rows, chunks, partial + rows * chunks, out, stream);
}

#define DIFFVBD_INSTANTIATE(T)                                                                                         \
  template cudaError_t pack_rest<T>(const GroupPlan&, int64_t, const T*, T*, cudaStream_t);                            \
  template cudaError_t gather_rows<T>(const T*, const int64_t*, int64_t, int64_t, int64_t, int64_t, T*, cudaStream_t); \
  template cudaError_t sum_segments<T>(const T*, const int64_t*, const int32_t*, int64_t, int64_t, int64_t, int64_t,   \
                                       T*, cudaStream_t);                                                              \
  template cudaError_t sum_rows<T>(const T*, int64_t, int64_t, T*, T*, cudaStream_t);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd::cuda
