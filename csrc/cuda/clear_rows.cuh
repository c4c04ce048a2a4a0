// Zeros where a list has room for rows that are not there, in kernels that have a thread for each row.
#pragma once

#include <cstdint>

namespace diffvbd::cuda {

// Clears the rows [from, to), of so many scalars, that belong to the threads of the block: side by side, where each
// thread by itself would write far apart. All threads must call it.
template <class T>
__device__ __forceinline__ void clear_rows(T* rows, int scalars, int64_t from, int64_t to) {
  const int64_t begin = static_cast<int64_t>(blockIdx.x) * blockDim.x, end = begin + blockDim.x;
  const int64_t last = (end < to ? end : to) * scalars;
  for (int64_t i = (begin < from ? from : begin) * scalars + threadIdx.x; i < last; i += blockDim.x) rows[i] = T(0);
}

}  // namespace diffvbd::cuda
