// Plain structs that pass between loops and the algorithm: raw pointers and values, shapes in comments.
#pragma once

#include <cstdint>

#include "vec.h"

namespace diffvbd {

// The state that an energy of one vertex may read. Positions are relative to `origin` (zero unless float32 asks for a
// local one).
template <class R>
struct VertexState {
  Vec3<R> x;       // current position [m]
  Vec3<R> x_prev;  // position at the start of the step [m]
  Vec3<R> origin;  // [m]
  R h;             // time step [s]
};

// A tensor with a scene dimension: stride 0 where the scenes share it, item stride 0 where its items do.
template <class T>
struct Batched {
  T* data = nullptr;
  int64_t scene = 0, item = 1;
};
// Whether each of several tensors holds one value for all items of a scene; whether the scenes share each.
template <class T, int n>
DIFFVBD_FN bool one_for_items(const Batched<T> (&tensors)[n]) {
  bool one = true;
  for (int i = 0; i < n; ++i) one = one && tensors[i].item == 0;
  return one;
}
template <class T, int n>
DIFFVBD_FN bool one_for_scenes(const Batched<T> (&tensors)[n]) {
  bool one = true;
  for (int i = 0; i < n; ++i) one = one && tensors[i].scene == 0;
  return one;
}

enum TapePolicy { kNoTape = 0, kCompactTape = 1, kFullTape = 2 };

// Scalars per active vertex and sweep. Full: d_raw and the factored H. Compact: d_raw. A scene with a step filter or
// contact keeps `kept` more (kept_scalars() in energies.h), in a compact tape instead of d_raw.
DIFFVBD_FN constexpr int tape_rows(int policy, int kept) {
  return policy == kFullTape ? 9 + kept : policy == kCompactTape ? (kept > 0 ? kept : 3) : 0;
}

// The other three vertices of a tet, a = 0, 1, 2, in the order (j, k, l) that makes (j, i, k, l) an even permutation.
DIFFVBD_FN constexpr int other_corner(int i, int a) {
  constexpr int others[4][3] = {{1, 3, 2}, {0, 2, 3}, {1, 0, 3}, {2, 0, 1}};
  return others[i][a];
}

// The place of the weight of an edge among the six of a tet: k01 k02 k03 k12 k13 k23.
DIFFVBD_FN constexpr int weight_index(int a, int b) {
  constexpr int first[4] = {0, 3, 5, 0};
  return a < b ? first[a] + b - a - 1 : first[b] + a - b - 1;
}

// Index data of one mesh in sweep order, all int32. Vertices of a color lie side by side, in blocks of `kLanes`; the
// last block of a color is filled with phantom vertices. Inactive vertices (pinned, isolated) fill the blocks after the
// last color. A position is block kLanes + lane. A slot is one incident tet for each lane of a block; a lane with fewer
// tets is padded by pairs of itself. The reverse scatters adjoints to neighbours along edges: a row for each
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

// The same for CUDA: blocks of kSlice vertices, one warp wide. A vertex's neighbours are listed once; its pairs name
// them by their place in that list, so that a pair costs one word of indices.
constexpr int kSlice = 32;
constexpr int kLocalBits = 10;  // of each of j, k, l in `local`
constexpr int kMaxDegree = (1 << kLocalBits) - 1;

struct GroupPlan {
  int32_t num_vertices, num_tets, num_active, colors, blocks, slots;
  int32_t edge_slots, incoming_slots;
  const int32_t* color_block;     // [colors + 1]
  const int32_t* block_slot;      // [blocks + 1]
  const int32_t* block_rank;      // [blocks + 1]
  const int32_t* block_edge;      // [blocks + 1]
  const int32_t* block_incoming;  // [blocks + 1]
  const int32_t* order;           // [blocks, kSlice]  vertex in the user's numbering, -1 for a phantom
  const int32_t* pair;            // [slots, kSlice]  4 tet + local index, -1 for padding; the last slot is all padding
  const int32_t* local;           // [slots, kSlice]  j + (k << kLocalBits) + (l << 2 kLocalBits) in the edge list
  const int32_t* adjacent;        // [edge_slots, kSlice]  position of the neighbour; padding names the vertex itself
  const int32_t* edge_entry;      // [edge_slots + 1]  first entry slot of each edge slot
  const int32_t* entry;     // [entry_slots, kSlice]  what adds up to an edge: 3 e + a for corner a of pair e of the
                            // vertex; padding names the corner after the last of the block, which stays zero
  const int32_t* incoming;  // [incoming_slots, kSlice]  edges (slot kSlice + lane) that end in the lane's vertex;
                            // padding names the edge after the last, whose row stays zero
  const int32_t* tet_pair;  // [tets, 4]  pair (slot kSlice + lane) of each corner, -1 if it is not active
  // Meshes of at most kSmallMesh vertices only: the sweep as one list, in the user's numbering.
  const int32_t* visit;       // [active, 2]  vertex + (its pairs << kLocalBits), its first pair
  const int32_t* visit_pair;  // [4 tets, 4]  j, k, l as in `local`, tet, pair (slot kSlice + lane), corner
};
constexpr int kSmallMesh = 64;

// A plan is one int32 buffer: a header of sizes, then its arrays. These find the arrays, wherever the buffer lies.

// vertices, tets, active, colors, blocks, slots, edge_slots, incoming_slots, and of the plan for CUDA entry_slots, the
// largest number of neighbours and of pairs of an active vertex
constexpr int kPlanHeader = 11;

class PlanReader {
 public:
  PlanReader(const int32_t* sizes, const int32_t* buffer) : sizes_(sizes), at_(buffer + kPlanHeader) {}

  const int32_t* take(int64_t size) {
    const int32_t* here = at_;
    at_ += size;
    return here;
  }

  // what both plans share
  template <class P>
  void blocks(P& p, int lanes) {
    p.num_vertices = sizes_[0];
    p.num_tets = sizes_[1];
    p.num_active = sizes_[2];
    p.colors = sizes_[3];
    p.blocks = sizes_[4];
    p.slots = sizes_[5];
    p.edge_slots = sizes_[6];
    p.incoming_slots = sizes_[7];
    p.color_block = take(p.colors + 1);
    p.block_slot = take(p.blocks + 1);
    p.block_rank = take(p.blocks + 1);
    p.block_edge = take(p.blocks + 1);
    p.block_incoming = take(p.blocks + 1);
    p.order = take(int64_t{p.blocks} * lanes);
  }

 private:
  const int32_t *sizes_, *at_;
};

inline Plan view_plan(const int32_t* buffer) {
  Plan p{};
  PlanReader read(buffer, buffer);
  read.blocks(p, kLanes);
  p.pair = read.take(int64_t{p.slots} * kLanes);
  p.neighbors = read.take(int64_t{p.slots} * 3 * kLanes);
  p.edge = read.take(int64_t{p.slots} * 3 * kLanes);
  p.incoming = read.take(int64_t{p.incoming_slots} * kLanes);
  return p;
}

// `sizes` is the header on the host, `buffer` the plan on the device.
inline GroupPlan view_group_plan(const int32_t* sizes, const int32_t* buffer) {
  GroupPlan p{};
  PlanReader read(sizes, buffer);
  read.blocks(p, kSlice);
  p.pair = read.take(int64_t{p.slots} * kSlice);
  p.local = read.take(int64_t{p.slots} * kSlice);
  p.adjacent = read.take(int64_t{p.edge_slots} * kSlice);
  p.incoming = read.take(int64_t{p.incoming_slots} * kSlice);
  p.edge_entry = read.take(int64_t{p.edge_slots} + 1);
  p.entry = read.take(int64_t{sizes[8]} * kSlice);
  p.tet_pair = read.take(4 * int64_t{p.num_tets});
  if (p.num_vertices <= kSmallMesh) {
    p.visit = read.take(2 * int64_t{p.num_active});
    p.visit_pair = read.take(16 * int64_t{p.num_tets});
  }
  return p;
}

}  // namespace diffvbd
