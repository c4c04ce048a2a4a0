// What contact leaves of an acceleration, on the device: see contact/unsupported.h.
#pragma once

#include <cuda_runtime_api.h>

#include "../contact/residual_acceleration.h"

namespace diffvbd::cuda {

// out [B, V, 3]
template <class T>
cudaError_t unsupported(const contact::ResidualInputs<T>& in, T* out, cudaStream_t stream);
template <class T>
cudaError_t unsupported_backward(const contact::ResidualInputs<T>& in, const T* bar,
                                 const contact::ResidualAdjoints<T>& out, cudaStream_t stream);

}  // namespace diffvbd::cuda
