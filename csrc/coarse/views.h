// The coarse space of a Model (diffvbd/model/coarse.py) as the loops read it: functions, groups and tets of each body.
#pragma once

#include "../core/views.h"
#include "../energies/tet.h"

namespace diffvbd::coarse {

// Functions count from 0 over all bodies; body b has function_ptr[b] ... function_ptr[b + 1] - 1. A position is where a
// vertex stands in sweep order; twin of CoarsePlan in diffvbd/model/coarse_plan.py.
struct Plan {
  int32_t bodies, functions, groups, width, entries, tet_blocks, moments, every, positions, listed;
  const int32_t* function_ptr;             // [bodies + 1]
  const int32_t* mass_ptr;                 // [bodies + 1]  sums of squares of the numbers of functions
  const int32_t* position_body;            // [positions]  -1: none with a vertex to move
  const int32_t *position_ptr, *function;  // [positions + 1], [entries]  the functions of a position
  const int32_t *row_ptr, *row;            // [functions + 1], [entries]  the positions of a function
  const int32_t* block_ptr;                // [bodies + 1]  blocks of kLanes tets of a body
  const int32_t* corner;                   // [tet_blocks, 4, kLanes]  positions times kRow
  const int32_t* tet;                      // [tet_blocks, kLanes]  any at padding, which has one corner four times
  const int32_t* group_ptr;                // [bodies + 1]  groups of a body
  const int32_t* group_function;           // [groups, width]  -1 beyond the last
  // what the mean deformation of a group is made of: [groups + 1], [moments]
  const int32_t *moment_ptr, *moment_vertex;
  const int32_t *list_ptr, *list, *list_position;  // [bodies + 1], [listed] twice  the vertices of a body that move
};
constexpr int kHeader = 10;

DIFFVBD_FN Plan view_plan(const int32_t* p) {
  Plan out{p[0], p[1], p[2], p[3], p[4], p[5], p[6], p[7], p[8], p[9]};
  p += kHeader;
  const auto take = [&](int64_t count) {
    const int32_t* at = p;
    p += count;
    return at;
  };
  out.function_ptr = take(out.bodies + 1);
  out.mass_ptr = take(out.bodies + 1);
  out.position_body = take(out.positions);
  out.position_ptr = take(out.positions + 1);
  out.function = take(out.entries);
  out.row_ptr = take(out.functions + 1);
  out.row = take(out.entries);
  out.block_ptr = take(out.bodies + 1);
  out.corner = take(int64_t{4} * out.tet_blocks * kLanes);
  out.tet = take(int64_t{out.tet_blocks} * kLanes);
  out.group_ptr = take(out.bodies + 1);
  out.group_function = take(int64_t{out.groups} * out.width);
  out.moment_ptr = take(out.groups + 1);
  out.moment_vertex = take(out.moments);
  out.list_ptr = take(out.bodies + 1);
  out.list = take(out.listed);
  out.list_position = take(out.listed);
  return out;
}
// int32 of a plan with this header
DIFFVBD_FN int64_t plan_size(const int32_t* p) {
  const Plan plan = view_plan(p);
  return plan.list_position + plan.listed - p;
}

// What the corrections of a step read besides the scene.
template <class T>
struct Inputs {
  Plan plan;
  const T *weight, *row_weight;  // [entries] each, by position and by function
  Batched<const T> rest;         // [B, tet_blocks, kRestScalars, kLanes]
  Batched<const T> factor;       // [B, 9 mass_ptr[bodies]]  L of A = L L^T of each body, n x n
  Batched<const T> mass;         // [B, mass_ptr[bodies]]
  int corrections;
  T* tape;        // [B, corrections, tape_size()]
  T* matrix_bar;  // [B, 9 mass_ptr[bodies]], reverse only; null where not wanted

  bool keeps_positions;

  // of a correction: the coarse vector, the length of each body and, where gaps must come back to the bit, what it read
  int64_t tape_size() const {
    return int64_t{3} * plan.functions + plan.bodies + (keeps_positions ? int64_t{3} * plan.positions : 0);
  }
};

// How many corrections a step has, and whether one comes before sweep k, which is `sweeps` at the end of a short step;
// twin of CoarseSpace.corrections.
DIFFVBD_FN int corrections_of(int sweeps, int every) { return sweeps <= 1 ? 1 : (sweeps - 2) / every + 1; }
DIFFVBD_FN bool corrects_before(int k, int sweeps, int every) {
  return sweeps <= 1 ? k == sweeps : k >= 1 && k < sweeps && (k - 1) % every == 0;
}

}  // namespace diffvbd::coarse
