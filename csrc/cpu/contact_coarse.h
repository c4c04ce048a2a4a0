// The coarse correction of bodies that touch (subspace/contact_coarse.h), on the CPU.
#pragma once

#include "../subspace/contact_coarse.h"
#include "runs.h"

namespace diffvbd {

template <class T, class... Args>
void contact_coarse_system(const Args&... args) {
  contact::coarse_system<T>(Loops(), args...);
}
template <class T, class... Args>
void contact_coarse_move(const Args&... args) {
  contact::coarse_move<T>(Loops(), args...);
}
template <class T, class... Args>
void contact_coarse_restrict(const Args&... args) {
  contact::coarse_restrict<T>(Loops(), args...);
}
template <class T, class... Args>
void contact_coarse_motions(const Args&... args) {
  contact::coarse_motions<T>(Loops(), args...);
}
template <class T, class... Args>
void contact_coarse_reverse(const Args&... args) {
  contact::coarse_reverse<T>(Loops(), args...);
}

}  // namespace diffvbd
