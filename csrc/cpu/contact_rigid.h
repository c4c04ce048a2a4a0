// The rigid correction of bodies that touch (subspace/rigid_step.h), on the CPU.
#pragma once

#include "runs.h"

namespace diffvbd {

template <class T>
void contact_rigid_correct(const contact::RigidStep<T>& s) {
  contact::correct_bodies(Loops(), s);
}
template <class T>
void contact_rigid_reverse(const contact::RigidReverse<T>& r) {
  contact::reverse_bodies(Loops(), r);
}
template <class T>
void work_of_pairs(const contact::WorkStep<T>& s) {
  contact::sum_work(Loops(), s);
}

}  // namespace diffvbd
