// The beginning of a step on the device: see start/begin.h.
#pragma once

#include <cuda_runtime_api.h>

#include "../subspace/begin.h"
#include "bodies.h"

namespace diffvbd::cuda {

// Bodies whose start is chosen, null for none; their second state; and what receives whether they take it.
template <class T>
struct Choice {
  const start::Candidates<T>* two;
  T* second;
  uint8_t* taken;
};

template <class T>
cudaError_t begin(const start::Inputs<T>& in, const BodyGroups& groups, const Choice<T>& of_corrected,
                  const BodyGroups& other_groups, const Choice<T>& of_others, T* x_start, T* y, double* workspace,
                  cudaStream_t stream);
template <class T>
cudaError_t begin_backward(const start::Inputs<T>& in, const BodyGroups& groups, const start::Adjoints<T>& a,
                           T* coasted, T* y, double* workspace, cudaStream_t stream);

}  // namespace diffvbd::cuda
