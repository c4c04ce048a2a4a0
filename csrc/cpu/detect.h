// Detection of contact on the CPU: which pairs of primitives are, or may come, closer than the reach of the barrier.
#pragma once

#include "../contact/candidates.h"

namespace diffvbd {

template <class T>
void detect(const contact::Surfaces<T>& in, const contact::Detected<T>& out);

}  // namespace diffvbd
