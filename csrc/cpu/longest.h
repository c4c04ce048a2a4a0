// The longest ways of bodies on the CPU, see contact/longest.h.
#pragma once

#include "../contact/longest.h"

namespace diffvbd {

// out: [1 or, with arms, 2, B, bodies]
template <class T>
void longest_ways(const contact::LongestInputs<T>& in, T* out);

}  // namespace diffvbd
