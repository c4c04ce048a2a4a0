// What contact leaves of an acceleration, on the device: see contact/unsupported.h.
#pragma once

#include <cuda_runtime_api.h>

#include "../contact/residual_acceleration.h"

namespace diffvbd::cuda {

// out [B, V, 3]
template <class T>
cudaError_t unsupported(const contact::UnsupportedInputs<T>& in, T* out, cudaStream_t stream);
template <class T>
cudaError_t unsupported_backward(const contact::UnsupportedInputs<T>& in, const T* bar,
                                 const contact::UnsupportedAdjoints<T>& out, cudaStream_t stream);

}  // namespace diffvbd::cuda
