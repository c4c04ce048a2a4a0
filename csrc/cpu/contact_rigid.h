// The rigid correction of bodies that touch (subspace/rigid_step.h), on the CPU.
#pragma once

#include "runs.h"

namespace diffvbd {

template <class T>
void rigid_correct(const contact::RigidStep<T>& s) {
  contact::rigid_correct(Loops(), s);
}
template <class T>
void rigid_reverse(const contact::RigidReverse<T>& r) {
  contact::rigid_reverse(Loops(), r);
}
template <class T>
void work_of_pairs(const contact::WorkStep<T>& s) {
  contact::work_of_pairs(Loops(), s);
}

}  // namespace diffvbd
