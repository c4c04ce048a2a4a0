// A whole scene per thread: many small meshes (see scene.cuh).
#pragma once

#include "step.h"

namespace diffvbd::cuda {

// rare [scenes]: for the kernels
template <class T>
cudaError_t run_scene_forward(const HostPlan& host, const StepInputs<T>& in, const StepOutputs<T>& out,
                              const Choice& choice, uint8_t* rare, cudaStream_t stream);
template <class T>
cudaError_t run_scene_reverse(const HostPlan& host, const StepInputs<T>& in, const T* ends, const T* tape,
                              const StepAdjoints<T>& out, const Choice& choice, uint8_t* rare, cudaStream_t stream);

}  // namespace diffvbd::cuda
