// Memory that is zero at first, of several arrays in one launch.
#pragma once

#include <cuda_runtime.h>

#include <cstdint>
#include <vector>

namespace diffvbd::cuda {

struct Span {
  void* data;
  int64_t bytes;  // a multiple of four
};

cudaError_t clear(const std::vector<Span>& spans, cudaStream_t stream);

}  // namespace diffvbd::cuda
