// Motions, islands and trust-region radii of bodies on the CPU, and sums over segments.
#pragma once

#include "../contact/islands.h"
#include "../contact/motion.h"
#include "../contact/trust_region.h"

namespace diffvbd {

// Results as contact/motion.h has them.
template <class T>
void find_motion(const contact::MotionInputs<T>& in, T* rigid, T* displacements, T* sums);
// Fills all that `work` points to.
template <class T>
void find_trust_radii(contact::RadiusInputs<T> in, const contact::RadiusWork<T>& work);

// island [B, mesh_bodies]: the smallest body of each body's island, or -1 where the island must stay
template <class T>
void find_islands(const contact::IslandInputs<T>& in, int32_t* island);

// values [B, items, c] -> [B, segments, c]: sums of the rows order[ptr[s]..ptr[s + 1]), pairwise
template <class T>
void segment_sum(const T* values, const int32_t* order, const int32_t* ptr, int64_t scenes, int64_t items,
                 int64_t segments, int64_t c, T* out);

}  // namespace diffvbd
