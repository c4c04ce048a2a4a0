// Intersections of surfaces on the device; the twin of cpu/intersect.h.
#pragma once

#include <cuda_runtime.h>

#include "../contact/intersect.h"

namespace diffvbd::cuda {

// Bytes of memory that a search works in.
template <class T>
size_t intersections_workspace_bytes(const contact::Surfaces<T>& in, int64_t capacity);

template <class T>
cudaError_t find_intersections(const contact::Surfaces<T>& in, const contact::Intersections& out, void* workspace,
                               cudaStream_t stream);

}  // namespace diffvbd::cuda
