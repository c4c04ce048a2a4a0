// By how much the potentials of bodies rise, on the device.
#pragma once

#include <cuda_runtime_api.h>

#include "../subspace/coarse.h"

namespace diffvbd::cuda {

// Doubles that potential_rise works in.
template <class T>
int64_t rise_workspace(const coarse::IncreaseInputs<T>& in) {
  return 2 * in.bodies.scenes * (in.blocks + in.listed);
}

// out [B, bodies, 2]: rise and size of the terms; infinite, or no number, where a vertex comes too near a plane.
template <class T>
cudaError_t potential_rise(const coarse::IncreaseInputs<T>& in, double* workspace, double* out, cudaStream_t stream);

}  // namespace diffvbd::cuda
