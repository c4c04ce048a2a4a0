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
template <class T>
ReverseKernel<T> reverse_kernel(int energies);

}  // namespace diffvbd
