// Sums over segments, on the device.
#pragma once

#include <cuda_runtime_api.h>

#include <cstdint>

namespace diffvbd::cuda {

// values [B, items, c] -> [B, segments, c]: sums of the rows order[ptr[s]..ptr[s + 1]) in an order that depends on the
// shapes alone
template <class T>
cudaError_t segment_sum(const T* values, const int32_t* order, const int32_t* ptr, int64_t scenes, int64_t items,
                        int64_t segments, int64_t c, T* out, cudaStream_t stream);

}  // namespace diffvbd::cuda
