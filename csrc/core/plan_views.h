// A plan is one int32 buffer: a header of sizes, then its arrays. These find the arrays, wherever the buffer lies.
#pragma once

#include "views.h"

namespace diffvbd {

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
