// Intersections of surfaces on the CPU: which edges pass through triangles, which points lie behind planes.
#pragma once

#include "../contact/intersect.h"

namespace diffvbd {

template <class T>
void find_intersections(const contact::Surfaces<T>& in, const contact::Intersections& out);

}  // namespace diffvbd
