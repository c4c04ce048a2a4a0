// A part of a list of pairs: the same lists, shorter. Pairs keep their order, and so do those of each corner point.
#pragma once

#include <cstdint>

#include "candidates.h"

namespace diffvbd::contact {

// kept [pairs + 1]: how many pairs before each are kept. Corners: of all scenes.
template <class T>
struct KeepInputs {
  const bool* keep;  // [pairs]
  const int32_t *pairs, *ptr, *entry;
  const T* constants;
  int64_t count, corners;  // pairs that the list has room for; corner points
};
// Room for `capacity` pairs.
template <class T>
struct Kept {
  int64_t* rows;  // [capacity]  which pair of the longer list each is, or -1
  int32_t *pairs, *ptr, *entry;
  T* constants;
  int64_t capacity;
};

// Whether a pair of the list stays; what the list has room for beyond its pairs does not.
template <class T>
DIFFVBD_FN bool stays(const KeepInputs<T>& in, int64_t pair) {
  return pair < in.ptr[in.corners] / 4 && in.keep[pair];
}

template <class T>
DIFFVBD_FN void copy_pair(const KeepInputs<T>& in, int64_t pair, int64_t to, const Kept<T>& out) {
  out.rows[to] = pair;
  for (int k = 0; k < kPairRow; ++k) out.pairs[kPairRow * to + k] = in.pairs[kPairRow * pair + k];
  for (int k = 0; k < kConstants; ++k) out.constants[kConstants * to + k] = in.constants[kConstants * pair + k];
}

// A row that no pair fills.
template <class T>
DIFFVBD_FN void leave_empty(int64_t row, const Kept<T>& out) {
  out.rows[row] = -1;
  for (int k = 0; k < kPairRow; ++k) out.pairs[kPairRow * row + k] = -1;
  for (int k = 0; k < kConstants; ++k) out.constants[kConstants * row + k] = T(0);
  for (int k = 0; k < 4; ++k) out.entry[4 * row + k] = -1;
}

// Calls f(entry in the shorter list) for the pairs of a corner point that stay.
template <class T, class F>
DIFFVBD_FN void each_entry(const KeepInputs<T>& in, const int32_t* kept, int64_t corner, const F& f) {
  for (int32_t e = in.ptr[corner]; e < in.ptr[corner + 1]; ++e) {
    const int32_t entry = in.entry[e], pair = entry >> 2;
    if (in.keep[pair]) f(4 * kept[pair] + (entry & 3));
  }
}

}  // namespace diffvbd::contact
