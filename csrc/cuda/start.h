// The translations of islands on the device, see contact/translation.h.
#pragma once

#include <cuda_runtime_api.h>

#include "../contact/islands.h"

namespace diffvbd::cuda {

// sums [B, bodies, 4] is for the kernels; u [B, bodies, 3]
template <class T>
cudaError_t translation(const contact::TranslationInputs<T>& in, T* sums, T* u, cudaStream_t stream);

// `zeroed` [B bodies (3 + 3 + 7 planes)]: rate, mean, adjoints of the planes by island. x_bar is zero at first.
template <class T>
cudaError_t translation_backward(const contact::TranslationInputs<T>& in, const T* u_bar, T* sums, T* zeroed,
                                 T* move_bar, T* mass_bar, T* x_bar, T* planes_bar, cudaStream_t stream);

}  // namespace diffvbd::cuda
