// Fixed-radius search among points; the twin of cpu/neighbors.h.
#pragma once

#include <cuda_runtime.h>

#include <cstddef>
#include <cstdint>

namespace diffvbd::cuda {

// Bytes of memory that a search among so many points of scalars T works in.
template <class T>
size_t neighbor_workspace_bytes(int64_t points);

// points [scenes, n, 3] -> pairs [max_pairs, 3]: (scene, i, j) with i < j and |p_i - p_j| < radius in lexicographic
// order, then rows of -1. *count: how many there are, or -1 where a coordinate is not finite; where that is no number
// in [0, max_pairs], all rows are -1.
template <class T>
cudaError_t neighbor_pairs(const T* points, int64_t scenes, int64_t n, double radius, int32_t* pairs, int64_t max_pairs,
                           int64_t* count, void* workspace, cudaStream_t stream);

}  // namespace diffvbd::cuda
