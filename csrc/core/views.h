// Plain structs that pass between loops and the algorithm: raw pointers and values, shapes in comments.
#pragma once

#include <cstdint>

#include "vec.h"

namespace diffvbd {

// What an energy of one vertex may read. Positions are relative to `origin` (zero unless float32 asks for a local one).
template <class R>
struct VertexState {
  Vec3<R> x;       // current position [m]
  Vec3<R> x_prev;  // position at the start of the step [m]
  Vec3<R> origin;  // [m]
  R h;             // time step [s]
};

// Index data of one mesh in sweep order, all int32. Vertices of a color lie side by side, in blocks of `kLanes`; the last
// block of a color is filled with phantom vertices. Inactive vertices (pinned, isolated) fill the blocks after the last
// color. A slot is one incident tet for each lane of a block; a lane with fewer tets is padded by pairs of itself.
constexpr int kLanes = 8;

struct Plan {
  int32_t num_vertices, num_tets, num_active, colors, blocks, slots;
  const int32_t* color_block;  // [colors + 1]  first block of each color; the last entry ends the active blocks
  const int32_t* block_slot;   // [blocks + 1]  first slot of each block
  const int32_t* block_rank;   // [blocks + 1]  number of real vertices before each block
  const int32_t* order;        // [blocks, kLanes]  vertex in the user's numbering, -1 for a phantom
  const int32_t* pair;         // [slots, kLanes]  4 tet + local index
  const int32_t* neighbors;    // [slots, 3, kLanes]  the pair's j, k, l as (block, lane) positions
  const int32_t* targets;      // [slots, 3, kLanes]  the pair of the same tet that belongs to j, k, l
};

}  // namespace diffvbd
