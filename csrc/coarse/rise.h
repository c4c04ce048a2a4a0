// What the rise of the potential of all bodies is made of (rigid/rise.h).
#pragma once

#include "../rigid/rise.h"
#include "length.h"

namespace diffvbd::coarse {

constexpr int kBlockTets = 8;  // of a block of MovingBodies; at padding one vertex four times

template <class T>
struct RiseInputs {
  rigid::Inputs<T> bodies;            // x is where the ways begin,
  const T* to;                        // [B, V, 3] and this where they end
  const int32_t *corner, *block_ptr;  // [blocks, 4, kBlockTets] four times a vertex; [bodies + 1]
  Batched<const T> rest, material;    // of the tets by block, [blocks, 7 | 2, kBlockTets]
  int64_t blocks, listed;             // and vertices in the order of bodies
};

}  // namespace diffvbd::coarse
