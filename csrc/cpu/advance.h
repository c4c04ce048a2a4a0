// How much of its way each vertex goes at the start of the sweeps (contact/advance.h), on the CPU.
#pragma once

#include "../contact/advance.h"

namespace diffvbd {

// share [B, V]; returns how many pairs what is prescribed would bring too close.
template <class T>
int64_t advance(const contact::AdvanceInputs<T>& in, T* share);

}  // namespace diffvbd
