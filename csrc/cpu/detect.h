// Detection of contact on the CPU: which pairs of primitives are, or may come, closer than the reach of the barrier.
#pragma once

#include <vector>

#include "../contact/detection.h"
#include "../contact/intersect.h"

namespace diffvbd {

// Everything but the list of pairs, of which it returns the keys, sorted.
template <class T>
std::vector<uint64_t> detect(const contact::Surfaces<T>& in, const contact::Detected<T>& out);

// The list, of as many of these pairs as there is room for: `pairs`, `constants`, `ptr`, `entry`.
template <class T>
void store_list(const contact::Surfaces<T>& in, const std::vector<uint64_t>& keys, const contact::Detected<T>& out);

// Intersections of surfaces on the CPU: which edges pass through triangles, which points lie behind planes.

template <class T>
void find_intersections(const contact::Surfaces<T>& in, const contact::Intersections& out);

}  // namespace diffvbd
