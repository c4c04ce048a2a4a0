// A first answer to whether a pair can matter, of which most pairs need no second: by how far each of its vertices may
// be from where gaps were taken.
#pragma once

#include <cstdint>
#include <limits>

#include "../contact/limit.h"

namespace diffvbd {

// By how much the gap of a pair may have shrunk since it was taken, at most. bound [V], of its scene. Infinity where a
// corner is of a collider, whose gap may be of another time.
template <class T>
T most_closed(const int32_t* record, int32_t vertices, const T* bound) {
  const int first = contact::sides(record[4]);
  T most[2] = {T(0), T(0)};
  for (int k = 0; k < 4; ++k) {
    if (record[k] >= vertices) return std::numeric_limits<T>::infinity();
    T& side = most[k < first ? 0 : 1];
    side = side < bound[record[k]] ? bound[record[k]] : side;
  }
  return most[0] + most[1];
}

}  // namespace diffvbd
