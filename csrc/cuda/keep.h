// A part of a list of pairs (contact/keep.h) on the device, in room for all of them: how many there are, nobody asks.
#pragma once

#include <cuda_runtime_api.h>

#include "../contact/pair_list.h"

namespace diffvbd::cuda {

template <class T>
int64_t keep_bytes(const contact::KeepInputs<T>& in);
template <class T>
cudaError_t keep(const contact::KeepInputs<T>& in, const contact::Kept<T>& out, void* workspace, cudaStream_t stream);

}  // namespace diffvbd::cuda
