#include <algorithm>

#include "clear.h"

namespace diffvbd::cuda {
namespace {

constexpr int kThreads = 256, kMost = 8;  // spans of a launch
constexpr int64_t kBlocks = 1024;         // of a span, at most

struct Spans {
  Span of[kMost];
};

// A row of blocks for each span.
__global__ void __launch_bounds__(kThreads) clear_kernel(const __grid_constant__ Spans spans) {
  const Span& own = spans.of[blockIdx.y];
  const int64_t first = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
  const int64_t used = own.entries ? *own.entries / 4 * own.row : own.bytes,
                bytes = used < own.bytes ? used : own.bytes;
  const int64_t step = static_cast<int64_t>(gridDim.x) * kThreads, wide = bytes / static_cast<int64_t>(sizeof(uint4));
  for (int64_t i = first; i < wide; i += step) static_cast<uint4*>(own.data)[i] = uint4{};
  const int64_t words = bytes / static_cast<int64_t>(sizeof(uint32_t));
  for (int64_t i = 4 * wide + first; i < words; i += step) static_cast<uint32_t*>(own.data)[i] = 0;
  for (int64_t i = 4 * words + first; i < bytes; i += step) static_cast<uint8_t*>(own.data)[i] = 0;
}

}  // namespace

cudaError_t clear(const std::vector<Span>& given, cudaStream_t stream) {
  Spans spans{};
  unsigned count = 0;
  int64_t most = 0;
  const auto launch = [&] {
    const auto wide = static_cast<int64_t>(kThreads * sizeof(uint4));
    const auto blocks = static_cast<unsigned>(std::min(kBlocks, (most + wide - 1) / wide));
    if (count > 0) clear_kernel<<<dim3(blocks, count), kThreads, 0, stream>>>(spans);
    count = 0, most = 0;
    return cudaGetLastError();
  };
  for (const Span& span : given) {
    if (span.bytes == 0) continue;
    spans.of[count++] = span;
    most = std::max(most, span.bytes);
    if (count < kMost) continue;
    if (auto error = launch()) return error;
  }
  return launch();
}

}  // namespace diffvbd::cuda
