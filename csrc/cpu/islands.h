// Islands of bodies in contact, and sums over segments, on the CPU.
#pragma once

#include "../contact/islands.h"

namespace diffvbd {

// island [B, mesh_bodies]: the smallest body of each body's island, or -1 where the island must stay
template <class T>
void find_islands(const contact::IslandInputs<T>& in, int32_t* island);

// values [B, items, c] -> [B, segments, c]: sums of the rows order[ptr[s]..ptr[s + 1]), pairwise
template <class T>
void segment_sum(const T* values, const int32_t* order, const int32_t* ptr, int64_t scenes, int64_t items,
                 int64_t segments, int64_t c, T* out);

}  // namespace diffvbd
