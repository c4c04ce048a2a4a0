// Arrays on the device: clears, gathers and sums in a fixed order.
#pragma once

#include <cuda_runtime_api.h>

#include <cstdint>
#include <vector>

#include "../core/views.h"

namespace diffvbd::cuda {

struct Span {
  void* data;  // at a multiple of 16 bytes
  int64_t bytes;
  // Rows of pairs, whose number only the device knows: entries / 4 rows of `row` bytes; the rest stays as it is.
  const int32_t* entries = nullptr;
  int64_t row = 0;
};

// Also for a few bytes: in a captured graph cudaMemsetAsync takes 6 microseconds for them, a kernel 1.
cudaError_t clear(const std::vector<Span>& spans, cudaStream_t stream);

// rest [scenes, T, 7] -> layout of the pairs, k_ij k_ik k_il c6: [scenes, slots, 4 / W, kSlice, W], W scalars being 16
// bytes.
template <class T>
cudaError_t pack_rest(const GroupPlan& plan, int64_t scenes, const T* rest, T* packed, cudaStream_t stream);

// values [scenes, vertices, c] -> [scenes, n, c]: rows index[i]
template <class T>
cudaError_t gather_rows(const T* values, const int64_t* index, int64_t scenes, int64_t vertices, int64_t n, int64_t c,
                        T* out, cudaStream_t stream);

// values [scenes, n, c] -> [scenes, segments, c]: sums of the rows entry[e], e in [ptr[v], ptr[v + 1]), in this order
template <class T>
cudaError_t sum_segments(const T* values, const int64_t* ptr, const int32_t* entry, int64_t scenes, int64_t n,
                         int64_t segments, int64_t c, T* out, cudaStream_t stream);

// values [rows, columns] -> [rows], in an order that depends only on the shape. partial: partial_sums() scalars.
int64_t partial_sums(int64_t rows, int64_t columns);
template <class T>
cudaError_t sum_rows(const T* values, int64_t rows, int64_t columns, T* partial, T* out, cudaStream_t stream);

// values [B, items, c] -> [B, segments, c]: sums of the rows order[ptr[s]..ptr[s + 1]) in an order that depends only on
// the shapes.
template <class T>
cudaError_t segment_sum(const T* values, const int32_t* order, const int32_t* ptr, int64_t scenes, int64_t items,
                        int64_t segments, int64_t c, T* out, cudaStream_t stream);

}  // namespace diffvbd::cuda
