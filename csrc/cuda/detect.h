// Detection of contact on the device; the twin of cpu/detect.h.
#pragma once

#include <cuda_runtime.h>

#include "../contact/detection.h"

namespace diffvbd::cuda {

// Bytes of memory that a detection works in.
template <class T>
size_t detect_workspace_bytes(const contact::Surfaces<T>& in, int64_t capacity);

template <class T>
cudaError_t detect(const contact::Surfaces<T>& in, const contact::Detected<T>& out, void* workspace,
                   cudaStream_t stream);

}  // namespace diffvbd::cuda
