// Which rows of pairs the groups of a rigid correction have: what each presses, and its place in the list of its
// bodies.
#pragma once

#include "../subspace/contact_rigid.h"
#include "contact_rigid.cuh"

namespace diffvbd::cuda {
namespace {

template <class T>
__device__ int64_t scene_of_row(const RigidInputs<T>& in, const PairRoom& room, int64_t row) {
  return row < room.listed ? in.gate.listed.pairs[kPairRow * row + 5]
                           : in.lagged.pairs[kPairRow * (row - room.listed) + 5];
}
// The place of a body of a row's scene.
template <class T>
__device__ int64_t unit_of(const RigidInputs<T>& in, const PairRoom& room, int64_t row, int32_t body) {
  return scene_of_row(in, room, row) * in.bodies() + body;
}

// Calls f(side, place of the body) for the bodies that a row acts on.
template <class T, class F>
__device__ void each_side(const RigidInputs<T>& in, const PairRoom& room, const GroupMemory& memory, int64_t row,
                          const F& f) {
  for (int side = 0; side < 2; ++side) {
    const int32_t body = memory.sides[2 * row + side];
    if (body >= 0) f(side, unit_of(in, room, row, body));
  }
}

// What a listed pair presses, and the sides of a row.
template <class T>
__device__ void press_row(const RigidInputs<T>& in, const PairRoom& room, const GroupMemory& memory, int64_t row) {
  const CornerPoints<T> at{in, false};
  PairForce a;
  const int64_t scene = scene_of_row(in, room, row);
  bool acts = false;
  if (in.together() && !in.moves(scene, in.groups_of(scene), 0)) {
    // nobody is solved for: a captured step makes all of its corrections, of which most move nothing
  } else if (row < room.listed) {
    acts = barrier_force(in, row, at, a);
    if (acts) store_force(a, memory.press + kForceDoubles * row);
  } else {
    acts = lagged_force(in, row - room.listed, at, BodyMotions{}, a, -1);
  }
  for (int side = 0; side < 2; ++side) memory.sides[2 * row + side] = acts ? a.body[side] : -1;
}

// That the bodies of a row have one more.
template <class T>
__device__ void count_row(const RigidInputs<T>& in, const PairRoom& room, const GroupMemory& memory, int64_t row) {
  each_side(in, room, memory, row,
            [&](int, int64_t unit) { atomicAdd(memory.counts + 2 * unit + (row < room.listed ? 0 : 1), 1); });
}

// Where the rows of a body begin in a scene that is one group: of each row a scene has two entries at most.
template <class T>
__device__ int32_t begin_in_scene(const RigidInputs<T>& in, const GroupMemory& memory, int64_t unit) {
  const int64_t scene = unit / in.bodies();
  auto at = static_cast<int32_t>(2 * (in.first_listed(scene) + in.first_lagged(scene)));
  for (int64_t other = scene * in.bodies(); other < unit; ++other) {
    at += memory.counts[2 * other] + memory.counts[2 * other + 1];
  }
  return at;
}

// Puts a row where its bodies have theirs. begin_of(place of a body).
template <class T, class F>
__device__ void fill_row(const RigidInputs<T>& in, const PairRoom& room, const GroupMemory& memory, int64_t row,
                         const F& begin_of) {
  each_side(in, room, memory, row, [&](int side, int64_t unit) {
    const int which = row < room.listed ? 0 : 1;
    const int32_t at = begin_of(unit) + which * memory.counts[2 * unit];
    memory.found[at + atomicAdd(memory.filled + 2 * unit + which, 1)] = static_cast<int32_t>(2 * row) + side;
  });
}

// count_row() and fill_row() for all rows of a scene that is one group, by its block.
template <class T, class Team>
__device__ void list_rows(const RigidInputs<T>& in, const PairRoom& room, const GroupMemory& memory, const Team& team,
                          int64_t scene) {
  const int32_t n = in.bodies();
  const int64_t unit = scene * n, listed = in.first_listed(scene), lagged = in.first_lagged(scene);
  const auto repels = static_cast<int32_t>(in.first_listed(scene + 1) - listed);
  const auto rubs = static_cast<int32_t>(in.first_lagged(scene + 1) - lagged);
  const auto each = [&](const auto& f) {
    team.each(repels + rubs, [&](int32_t i) { f(i < repels ? listed + i : room.listed + lagged + i - repels); });
    team.meet();
  };
  team.each(2 * n, [&](int32_t i) { memory.counts[2 * unit + i] = memory.filled[2 * unit + i] = 0; });
  team.meet();
  each([&](int64_t row) { count_row(in, room, memory, row); });
  team.each(n, [&](int32_t b) { memory.begins[unit + b] = begin_in_scene(in, memory, unit + b); });
  team.meet();
  each([&](int64_t row) { fill_row(in, room, memory, row, [&](int64_t of) { return memory.begins[of]; }); });
}

}  // namespace
}  // namespace diffvbd::cuda
