// The rigid correction on the device: see rigid/body.h.
#pragma once

#include <cuda_runtime.h>

#include "../rigid/reverse.h"

namespace diffvbd::cuda {

// How many of the bodies, smallest first, are worked on by a part of a warp, by a block, and by the whole device.
struct RigidGroups {
  int32_t small, medium, large;
};

// Doubles of memory that the sums of the whole device go through; 0 where no body needs it.
int64_t rigid_workspace(const RigidGroups& groups, int64_t scenes);

template <class T>
cudaError_t rigid_correct(const rigid::Inputs<T>& in, const RigidGroups& groups, T* x, double* workspace,
                          cudaStream_t stream);
template <class T>
cudaError_t rigid_reverse(const rigid::Inputs<T>& in, const RigidGroups& groups, const rigid::Adjoints<T>& a,
                          double* workspace, cudaStream_t stream);

}  // namespace diffvbd::cuda
