// The lowest vertices of islands, see contact/lowest.h.
#pragma once

#include <cuda_runtime_api.h>

#include "../contact/islands.h"

namespace diffvbd::cuda {

// own, out: [B, bodies, planes]
template <class T>
cudaError_t lowest_vertices(const contact::SupportVertexInputs<T>& in, int32_t* own, int32_t* out, cudaStream_t stream);

}  // namespace diffvbd::cuda
