// Step fractions at the start of the sweeps (contact/advance.h), and gaps refreshed (contact/pair_list.h), on the CPU.
#pragma once

#include "../contact/advance.h"
#include "../contact/pair_list.h"

namespace diffvbd {

// fraction of each unit; returns the number of pairs that make the prescribed motion infeasible
template <class T>
int64_t advance(const contact::AdvanceInputs<T>& in, T* fraction);

// constants [pairs, 8]
template <class T>
void refresh_gaps(const contact::GapInputs<T>& in, int64_t pairs, T* constants);

}  // namespace diffvbd
