// The start of the sweeps (contact/start.h), and pairs that are near (contact/pair_list.h), on the CPU.
#pragma once

#include <vector>

#include "../contact/pair_list.h"
#include "../contact/start.h"

namespace diffvbd {

template <class T>
void start_substep(const contact::StartStep<T>& s);

// Gaps of pairs, infinite where they are not near, and what is left of radii [B, V].
template <class T>
std::vector<T> find_gaps(const contact::NearInputs<T>& in, int64_t scenes, T* radius);
template <class T>
void copy_near(const contact::NearInputs<T>& in, const std::vector<T>& gaps, const contact::NearList<T>& out);

}  // namespace diffvbd
