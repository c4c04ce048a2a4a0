// Fixed-radius search among points; the twin of cuda/neighbors.h.
#pragma once

#include <cstdint>

namespace diffvbd {

// points [scenes, n, 3] -> pairs [max_pairs, 3]: (scene, i, j) with i < j and |p_i - p_j| < radius in lexicographic
// order, then rows of -1. Returns how many there are, or -1 where a coordinate is not finite; where that is no number
// in [0, max_pairs], all rows are -1.
template <class T>
int64_t neighbor_pairs(const T* points, int64_t scenes, int64_t n, double radius, int32_t* pairs, int64_t max_pairs);

}  // namespace diffvbd
