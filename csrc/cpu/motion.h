// Motion and rooms of bodies on the CPU.
#pragma once

#include "../contact/coast.h"
#include "../contact/rooms.h"

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
void find_trust_radii(contact::RoomInputs<T> in, const contact::RoomWork<T>& work);

}  // namespace diffvbd
