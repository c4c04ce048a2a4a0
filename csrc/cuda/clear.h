// Memory that is zero at first, of several arrays in one launch.
#pragma once

#include <cuda_runtime.h>

#include <cstdint>
#include <vector>

namespace diffvbd::cuda {

struct Span {
  void* data;  // at a multiple of 16 bytes
  int64_t bytes;
  // Of the rows of pairs, where only the device knows how many there are: entries / 4 rows of so many bytes, the rest
  // is left as it is.
  const int32_t* entries = nullptr;
  int64_t row = 0;
};

// For a few bytes, too: in a captured graph cudaMemsetAsync takes 6 microseconds for them, and a kernel 1.
cudaError_t clear(const std::vector<Span>& spans, cudaStream_t stream);

}  // namespace diffvbd::cuda
