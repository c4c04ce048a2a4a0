// The coarse space of a Model (diffvbd/model/coarse.py) as the loops read it: functions, groups and tets of each body.
#pragma once

#include "../core/views.h"
#include "../energies/tet.h"

namespace diffvbd::coarse {

// Functions count from 0 over all bodies; body b has function_ptr[b] ... function_ptr[b + 1] - 1. A position is where a
// vertex stands in sweep order; twin of CoarsePlan in diffvbd/model/coarse_plan.py.
struct Plan {
  int32_t bodies, functions, groups, width, entries, tet_blocks, moments, positions, listed;
  int32_t cells, most, parts, places, vertices;  // of all matrices; functions of a body at most
  int32_t large;                                 // bodies of more than kTile unknowns, the last ones
  int32_t every, begun;                          // sweeps after each correction; sweeps before the first that is run
  const int32_t* function_ptr;                   // [bodies + 1]
  const int32_t* mass_ptr;                       // [bodies + 1]  sums of squares of the numbers of functions
  const int32_t* function_body;                  // [functions]
  const int32_t* position_body;                  // [positions]  -1: none with a vertex to move
  const int32_t *position_ptr, *function;        // [positions + 1], [entries]  the functions of a position
  const int32_t *row_ptr, *row;                  // [functions + 1], [entries]  the positions of a function
  const int32_t* block_ptr;                      // [bodies + 1]  blocks of kLanes tets of a body
  const int32_t* part_ptr;                       // [bodies + 1]  parts of a body: sums over its tets are made of theirs
  const int32_t *part_body, *part_begin;         // [parts], [parts + 1]  blocks of a part
  const int32_t* corner;                         // [tet_blocks, 4, kLanes]  positions times kRow
  const int32_t* tet;             // [tet_blocks, kLanes]  any at padding, which has one corner four times
  const int32_t* group_ptr;       // [bodies + 1]  groups of a body
  const int32_t* group_body;      // [groups]
  const int32_t* group_function;  // [groups, width]  -1 beyond the last
  // the reverse, [groups], [places]: for each function of a body its place in a group, -1: none
  const int32_t *place_ptr, *place;
  const int32_t* tet_ptr;  // [groups + 1]  tets of a group, which are one after the other in its body's blocks
  // what the mean deformation of a group is made of: [groups + 1], [moments] twice; and by vertex: [vertices + 1],
  // [moments]
  const int32_t *moment_ptr, *moment_vertex, *moment_group, *vertex_ptr, *vertex_moment;
  const int32_t *list_ptr, *list, *list_position;  // [bodies + 1], [listed] twice  the vertices of a body that move
};
constexpr int kSizes = 17;
constexpr int kTile = 32;  // unknowns that CUDA takes at once; twin of TILE in diffvbd/model/coarse_plan.py

// sizes [kSizes]: those of Plan in their order. Returns the number of int32 behind p through `used`.
DIFFVBD_FN Plan view_plan(const int64_t* sizes, const int32_t* p, int64_t& used) {
  const int32_t* const start = p;
  const auto size = [&](int i) { return static_cast<int32_t>(sizes[i]); };
  Plan out{size(0), size(1),  size(2),  size(3),  size(4),  size(5),  size(6),  size(7), size(8),
           size(9), size(10), size(11), size(12), size(13), size(14), size(15), size(16)};
  const auto take = [&](int64_t count) {
    const int32_t* at = p;
    p += count;
    return at;
  };
  out.function_ptr = take(out.bodies + 1);
  out.mass_ptr = take(out.bodies + 1);
  out.function_body = take(out.functions);
  out.position_body = take(out.positions);
  out.position_ptr = take(out.positions + 1);
  out.function = take(out.entries);
  out.row_ptr = take(out.functions + 1);
  out.row = take(out.entries);
  out.block_ptr = take(out.bodies + 1);
  out.part_ptr = take(out.bodies + 1);
  out.part_body = take(out.parts);
  out.part_begin = take(out.parts + 1);
  out.corner = take(int64_t{4} * out.tet_blocks * kLanes);
  out.tet = take(int64_t{out.tet_blocks} * kLanes);
  out.group_ptr = take(out.bodies + 1);
  out.group_body = take(out.groups);
  out.group_function = take(int64_t{out.groups} * out.width);
  out.place_ptr = take(out.groups);
  out.place = take(out.places);
  out.tet_ptr = take(out.groups + 1);
  out.moment_ptr = take(out.groups + 1);
  out.moment_vertex = take(out.moments);
  out.moment_group = take(out.moments);
  out.vertex_ptr = take(out.vertices + 1);
  out.vertex_moment = take(out.moments);
  out.list_ptr = take(out.bodies + 1);
  out.list = take(out.listed);
  out.list_position = take(out.listed);
  used = p - start;
  return out;
}

// What the corrections of a step read besides the scene.
template <class T>
struct Inputs {
  Plan plan;
  const T *weight, *row_weight;  // [entries] each, by position and by function
  Batched<const T> rest;         // [B, tet_blocks, kRestScalars, kLanes]
  Batched<const T> factor;       // [B, 9 cells]  L of A = L L^T of each body, n x n; on CUDA the inverse; if pressed A
  Batched<const T> mass;         // [B, mass_ptr[bodies]]
  int corrections;
  T* tape;        // [B, corrections, tape_size()]
  T* matrix_bar;  // [B, 9 mass_ptr[bodies]], reverse only; null where not wanted

  bool keeps_positions;
  bool pressed;  // whether energies of vertices act: each correction then adds their blocks to A

  // of a correction: the coarse vector, the length of each body and, where gaps must come back to the bit, what it read
  DIFFVBD_FN int64_t tape_size() const {
    return int64_t{3} * plan.functions + plan.bodies + (keeps_positions ? int64_t{3} * plan.positions : 0);
  }
};

// How many corrections so many sweeps have, and whether one comes before sweep k, which is `sweeps` at the end of a
// short step; twin of CoarseSpace.corrections. begun: 1 where these sweeps go on after the first of a step.
DIFFVBD_FN int corrections_of(int sweeps, int every, int begun) {
  const int after = sweeps + begun - 1;  // sweeps that follow a correction
  return after <= 0 ? 1 : (after - 1) / every + 1;
}
DIFFVBD_FN bool corrects_before(int k, int sweeps, int every, int begun) {
  const int after = k + begun - 1;
  return sweeps + begun <= 1 ? k == sweeps : after >= 0 && k < sweeps && after % every == 0;
}

}  // namespace diffvbd::coarse
