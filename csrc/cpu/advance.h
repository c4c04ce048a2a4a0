// The start of the sweeps (contact/start.h), and gaps refreshed (contact/pair_list.h), on the CPU.
#pragma once

#include "../contact/pair_list.h"
#include "../contact/start.h"

namespace diffvbd {

template <class T>
void start_substep(const contact::StartStep<T>& s);

// constants [pairs, 8]
template <class T>
void refresh_gaps(const contact::GapInputs<T>& in, int64_t pairs, T* constants);

}  // namespace diffvbd
