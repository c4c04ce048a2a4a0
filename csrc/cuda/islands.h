// Islands of bodies in contact, on the device; the twin of cpu/islands.h.
#pragma once

#include <cuda_runtime.h>

#include <cstddef>

#include "../contact/islands.h"

namespace diffvbd::cuda {

// Bytes of memory that find_islands works in.
template <class T>
size_t islands_workspace_bytes(const contact::IslandInputs<T>& in);

// island [B, mesh_bodies]. again: the workspace is that of a call that differed in its rooms alone.
template <class T>
cudaError_t find_islands(const contact::IslandInputs<T>& in, int32_t* island, void* workspace, cudaStream_t stream,
                         bool again = false);

}  // namespace diffvbd::cuda
