// The rigid correction on the device: see rigid/body.h.
#pragma once

#include <cuda_runtime.h>

#include "../subspace/rigid.h"
#include "bodies.h"

namespace diffvbd::cuda {

// others: whether some vertices are in no body that is corrected
template <class T>
cudaError_t rigid_correct(const rigid::Inputs<T>& in, const BodyGroups& groups, bool others, T* x, T* velocity,
                          double* workspace, cudaStream_t stream);
template <class T>
cudaError_t rigid_reverse(const rigid::Inputs<T>& in, const BodyGroups& groups, bool others,
                          const rigid::Adjoints<T>& a, double* workspace, cudaStream_t stream);

}  // namespace diffvbd::cuda
