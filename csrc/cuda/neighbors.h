// Fixed-radius search among points.
#pragma once

#include <cuda_runtime.h>

#include <cstddef>
#include <cstdint>

namespace diffvbd::cuda {

// Bytes of workspace of a search among so many points of scalars T.
template <class T>
size_t neighbor_workspace_bytes(int64_t points);

// points [scenes, n, 3] -> pairs [max_pairs, 3]: (scene, i, j) with i < j and |p_i - p_j| < radius in lexicographic
// order, then rows of -1. *count: their number, or -1 where a coordinate is not finite; all rows are -1 unless it is in
// [0, max_pairs].
template <class T>
cudaError_t neighbor_pairs(const T* points, int64_t scenes, int64_t n, double radius, int32_t* pairs, int64_t max_pairs,
                           int64_t* count, void* workspace, cudaStream_t stream);

}  // namespace diffvbd::cuda
