// The two hot loops of the CPU backend, chosen by a scene's energies.
#pragma once

#include <utility>

#include "scene.h"

namespace diffvbd {

// One color (blocks [begin, end)) of one sweep; `tape` is the policy.
template <class T>
using ForwardKernel = void (*)(const Plan&, const SceneView<T>&, const StepParameters<T>&, int sweep, int tape,
                               int64_t begin, int64_t end);
template <class T>
using ReverseKernel = void (*)(const Plan&, const SceneView<T>&, const StepParameters<T>&, int sweep, int tape,
                               int64_t begin, int64_t end);

template <class T>
ForwardKernel<T> forward_kernel(int energies);
// For one of kState, kMaterial and kMaterial | kRest: a file for each, so that the build can run them side by side.
template <class T, int wanted>
ReverseKernel<T> reverse_kernel_of(int energies);
template <class T>
ReverseKernel<T> reverse_kernel(int energies, int wanted) {
  if (wanted & kRest) return reverse_kernel_of<T, kMaterial | kRest>(energies);
  if (wanted & kMaterial) return reverse_kernel_of<T, kMaterial>(energies);
  return reverse_kernel_of<T, kState>(energies);
}

}  // namespace diffvbd
