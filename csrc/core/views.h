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

// Index data of one mesh in sweep order, all int32. Vertices of a color lie side by side, in blocks of `kLanes`; the
// last block of a color is filled with phantom vertices. Inactive vertices (pinned, isolated) fill the blocks after the
// last color. A position is block kLanes + lane. A slot is one incident tet for each lane of a block; a lane with fewer
// tets is padded by pairs of itself. The reverse sends what an update adds to a neighbour along edges: a row for each
// ordered pair (active vertex, neighbour), written by the vertex, read by the neighbour when its own turn comes.
constexpr int kLanes = 8;
constexpr int kRow = 4;  // scalars in a row: x, y, z and one unused; indices come multiplied by it

struct Plan {
  int32_t num_vertices, num_tets, num_active, colors, blocks, slots;
  int32_t edge_slots, incoming_slots;
  const int32_t* color_block;     // [colors + 1]  first block of each color; the last entry ends the active blocks
  const int32_t* block_slot;      // [blocks + 1]  first slot of each block
  const int32_t* block_rank;      // [blocks + 1]  number of real vertices before each block
  const int32_t* block_edge;      // [blocks + 1]  first edge slot of each block
  const int32_t* block_incoming;  // [blocks + 1]  first incoming slot of each block
  const int32_t* order;           // [blocks, kLanes]  vertex in the user's numbering, -1 for a phantom
  const int32_t* pair;            // [slots, kLanes]  4 tet + local index
  const int32_t* neighbors;       // [slots, 3, kLanes]  positions of the pair's j, k, l, times kRow
  const int32_t* edge;            // [slots, 3, kLanes]  the row, among those of its block, of the edge to
                                  // j, k, l, times kRow
  const int32_t* incoming;  // [incoming_slots, kLanes]  rows (edge slot kLanes + lane) that end in the lane's vertex,
                            // times kRow; padding names the row after the last, which stays zero
};

}  // namespace diffvbd
