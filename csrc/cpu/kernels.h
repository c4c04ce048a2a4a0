// The two hot loops of the CPU backend, chosen by a scene's energies and by what the processor can do.
#pragma once

#include "scene.h"

namespace diffvbd {

// One color (blocks [begin, end)) of one sweep; `tape` is the policy.
template <class T>
using SweepKernel = void (*)(const Plan&, const SceneView<T>&, const StepParameters<T>&, int sweep, int tape,
                             int64_t begin, int64_t end);

template <class T>
SweepKernel<T> forward_kernel(int energies);
template <class T>
SweepKernel<T> reverse_kernel(int energies);

// The loops of one instruction set: each is compiled in files of its own, sweep_<scalar>_<set>.cpp.
template <class T>
struct Kernels {
  SweepKernel<T> (*forward)(int energies), (*reverse)(int energies);
};
namespace baseline {
template <class T>
Kernels<T> sweep_kernels();
}
#ifdef DIFFVBD_HAS_SETS
namespace v3 {
template <class T>
Kernels<T> sweep_kernels();
}
namespace v4 {
template <class T>
Kernels<T> sweep_kernels();
}
#endif

}  // namespace diffvbd
