// How much of its way each vertex goes at the start of the sweeps (contact/advance.h), on the device.
#pragma once

#include <cuda_runtime_api.h>

#include "../contact/advance.h"
#include "../contact/pair_list.h"

namespace diffvbd::cuda {

// Bytes of memory that it works in, where the list has room for so many pairs.
template <class T>
int64_t advance_workspace_bytes(const contact::AdvanceInputs<T>& in, int64_t capacity);

// share, stuck [1] as cpu/advance.h. capacity: pairs that the list has room for.
template <class T>
cudaError_t advance(const contact::AdvanceInputs<T>& in, int64_t capacity, T* share, int64_t* stuck, void* workspace,
                    int multiprocessors, cudaStream_t stream);

// constants [pairs, 8] (contact/narrow.h).
template <class T>
cudaError_t refresh_gaps(const contact::GapInputs<T>& in, int64_t pairs, T* constants, cudaStream_t stream);

}  // namespace diffvbd::cuda
