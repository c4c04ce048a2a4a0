// The rigid correction of bodies that touch (subspace/rigid_step.h), on CUDA.
#pragma once

#include <cuda_runtime_api.h>

#include "../subspace/rigid_step.h"

namespace diffvbd::cuda {

template <class T>
cudaError_t contact_rigid_correct(const contact::RigidStep<T>& s, cudaStream_t stream);
template <class T>
cudaError_t contact_rigid_reverse(const contact::RigidReverse<T>& r, cudaStream_t stream);
template <class T>
cudaError_t work_of_pairs(const contact::WorkStep<T>& s, cudaStream_t stream);

}  // namespace diffvbd::cuda
