// The rooms of sweeps on the device, see contact/sweep_rooms.h.
#pragma once

#include <cuda_runtime_api.h>

#include "../contact/trust_region.h"

namespace diffvbd::cuda {

// rooms [B, V]; wishes [B, bodies] and most [B] are for the kernels
template <class T>
cudaError_t sweep_rooms(const contact::SweepRadiusInputs<T>& in, T* wishes, T* most, T* rooms, cudaStream_t stream);

}  // namespace diffvbd::cuda
