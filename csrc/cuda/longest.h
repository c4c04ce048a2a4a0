// The longest ways of bodies on the device, see contact/longest.h.
#pragma once

#include <cuda_runtime_api.h>

#include "../contact/longest.h"

namespace diffvbd::cuda {

// out: [1 or, with arms, 2, B, bodies]
template <class T>
cudaError_t longest_ways(const contact::LongestInputs<T>& in, T* out, cudaStream_t stream);

}  // namespace diffvbd::cuda
