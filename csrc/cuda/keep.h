// A part of a list of pairs (contact/keep.h) on the device, in room for all of them: how many there are, nobody asks.
#pragma once

#include <cuda_runtime_api.h>

#include "../contact/pair_list.h"

namespace diffvbd::cuda {

template <class T>
int64_t keep_bytes(const contact::CompactInputs<T>& in);
template <class T>
cudaError_t keep(const contact::CompactInputs<T>& in, const contact::CompactList<T>& out, void* workspace, cudaStream_t stream);

}  // namespace diffvbd::cuda
