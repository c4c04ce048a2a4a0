// Motion and rooms of bodies on the device; the twin of cpu/motion.h.
#pragma once

#include <cuda_runtime_api.h>

#include "../contact/motion.h"
#include "../contact/trust_region.h"

namespace diffvbd::cuda {

template <class T>
cudaError_t find_motion(const contact::MotionInputs<T>& in, T* rigid, T* ways, T* sums, cudaStream_t stream);
template <class T>
cudaError_t reverse_motion(const contact::MotionInputs<T>& in, const contact::MotionAdjoints<T>& a,
                           cudaStream_t stream);

template <class T>
cudaError_t extrapolate(const contact::MotionInputs<T>& in, double chord, T* coasted, cudaStream_t stream);
template <class T>
cudaError_t reverse_extrapolate(const contact::MotionInputs<T>& in, double chord, const contact::MotionAdjoints<T>& a,
                          cudaStream_t stream);

// islands: memory of islands_workspace_bytes().
template <class T>
cudaError_t find_trust_radii(contact::RadiusInputs<T> in, const contact::RadiusWork<T>& work, void* islands, cudaStream_t stream);

}  // namespace diffvbd::cuda
