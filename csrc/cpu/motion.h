// Motion and rooms of bodies on the CPU.
#pragma once

#include "../contact/islands.h"
#include "../contact/motion.h"
#include "../contact/trust_region.h"

namespace diffvbd {

// Results as contact/motion.h has them.
template <class T>
void find_motion(const contact::MotionInputs<T>& in, T* rigid, T* ways, T* sums);
template <class T>
void reverse_motion(const contact::MotionInputs<T>& in, const contact::MotionAdjoints<T>& a);

// As contact/coast.h has it; a.rigid: the adjoint of `coasted`.
template <class T>
void coast(const contact::MotionInputs<T>& in, double chord, T* coasted);
template <class T>
void reverse_coast(const contact::MotionInputs<T>& in, double chord, const contact::MotionAdjoints<T>& a);

// Fills all that `work` points to.
template <class T>
void find_rooms(contact::RoomInputs<T> in, const contact::RoomWork<T>& work);

// Islands of bodies in contact, and sums over segments, on the CPU.

// island [B, mesh_bodies]: the smallest body of each body's island, or -1 where the island must stay
template <class T>
void find_islands(const contact::IslandInputs<T>& in, int32_t* island);

// values [B, items, c] -> [B, segments, c]: sums of the rows order[ptr[s]..ptr[s + 1]), pairwise
template <class T>
void segment_sum(const T* values, const int32_t* order, const int32_t* ptr, int64_t scenes, int64_t items,
                 int64_t segments, int64_t c, T* out);

}  // namespace diffvbd
