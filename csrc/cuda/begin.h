// The beginning of a step on the device: see start/begin.h.
#pragma once

#include <cuda_runtime_api.h>

#include "../start/begin.h"
#include "../start/lower.h"
#include "bodies.h"

namespace diffvbd::cuda {

// `two`: the bodies whose start is chosen, or null; falls receives the choice. from_y: where they start from y.
template <class T>
cudaError_t begin(const start::Inputs<T>& in, const BodyGroups& groups, const start::Candidates<T>* two,
                  const BodyGroups& two_groups, T* x_start, T* from_y, T* y, uint8_t* falls, double* workspace,
                  cudaStream_t stream);
template <class T>
cudaError_t begin_backward(const start::Inputs<T>& in, const BodyGroups& groups, const start::Adjoints<T>& a,
                           T* coasted, T* y, double* workspace, cudaStream_t stream);

}  // namespace diffvbd::cuda
