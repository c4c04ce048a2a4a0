// The loops of the instruction set DIFFVBD_SET. setup.py writes a source that instantiates them for each scalar and set.
#pragma once

#include "coarse_kernels.h"
#include "forward.h"
#include "reverse.h"

namespace diffvbd::DIFFVBD_SET {

template <class T>
SweepKernel<T> forward(int energies) {
  return pick_forward<T>(energy_index(energies), std::make_integer_sequence<int, kEnergySets>{});
}
template <class T>
SweepKernel<T> reverse(int energies) {
  return pick_reverse<T>(energy_index(energies), std::make_integer_sequence<int, kEnergySets>{});
}

template <class T>
CoarseKernels<T> coarse(int energies) {
  return pick_coarse<T>(free_index(energies), std::make_integer_sequence<int, kFreeSets>{});
}

// Boxes are single precision: of the scalars one has the kernel, and it costs the other no room for inlining.
template <class T>
MeetKernel meet() {
  if constexpr (std::is_same_v<T, float>) return meet_boxes;
  return nullptr;
}

template <class T>
Kernels<T> sweep_kernels() {
  return {forward<T>, reverse<T>, coarse<T>, {add_lanes<T>, reverse_lanes<T>}, meet<T>()};
}

}  // namespace diffvbd::DIFFVBD_SET
