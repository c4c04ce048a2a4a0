// How much of its way each vertex goes at the start of the sweeps (contact/advance.h), on the CPU.
#pragma once

#include "../contact/advance.h"
#include "../contact/narrow.h"

namespace diffvbd {

// share of each unit; returns how many pairs what is prescribed would bring too close.
template <class T>
int64_t advance(const contact::AdvanceInputs<T>& in, T* share);

// constants [pairs, 8] (contact/narrow.h).
template <class T>
void refresh_gaps(const contact::NarrowInputs<T>& in, int64_t pairs, T* constants);

}  // namespace diffvbd
