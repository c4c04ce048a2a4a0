// Gathers and fixed-order sums on the device; the twins of cpu/reductions.h, and pack_rest.
#pragma once

#include "step.h"

namespace diffvbd::cuda {

// rest [scenes, T, 7] -> as the pairs see it: k_ij k_ik k_il c6, [scenes, slots, 4 / W, kSlice, W], W scalars being 16
// bytes
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

// values [rows, columns] -> [rows], in an order that depends on the shape alone. `partial` holds partial_sums()
// scalars.
int64_t partial_sums(int64_t rows, int64_t columns);
template <class T>
cudaError_t sum_rows(const T* values, int64_t rows, int64_t columns, T* partial, T* out, cudaStream_t stream);

}  // namespace diffvbd::cuda
