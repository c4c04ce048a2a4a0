// The start of a part on the device: what contact/part.h and contact/above_floor_reverse.h do with bodies and vertices.
#pragma once

#include <cuda_runtime_api.h>

#include "../contact/above_floor.h"
#include "../contact/start.h"

namespace diffvbd::cuda {

// Calls act(body, team) for all bodies of all scenes, a block for each.
template <class Act>
cudaError_t act_on_bodies(const Act& act, cudaStream_t stream);
// Calls act(scene, vertex) for all of them.
template <class Act>
cudaError_t act_on_vertices(const Act& act, cudaStream_t stream);

}  // namespace diffvbd::cuda
