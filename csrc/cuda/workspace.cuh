// The parts of a step's workspace.
#pragma once

#include "coarse.h"
#include "step.h"

namespace diffvbd::cuda {
namespace {

constexpr size_t kBarrierBytes = 256;
// Hands out the parts of a workspace; without one it only counts.
template <class T>
struct Carver {
  T* base;
  int64_t used = 0;
  T* operator()(bool wanted, int64_t scalars) {
    if (!wanted) return nullptr;
    T* here = base + used;
    used += (scalars + 3) / 4 * 4;  // rows stay aligned
    return here;
  }
};

// scenes: that are worked on at once
template <class T>
CoarseWork<T> carve_coarse(const coarse::Inputs<T>& in, int64_t positions, int64_t scenes, bool reverse,
                           Carver<T>& take) {
  const coarse::Plan& p = in.plan;
  const auto bytes = [](int64_t count, size_t size) { return static_cast<int64_t>(count * size / sizeof(T) + 1); };
  CoarseWork<T> w{};
  w.gradient = take(true, scenes * kRow * positions);
  w.way = take(true, scenes * kRow * positions);
  w.restricted = take(true, scenes * 3 * p.functions);
  w.solved = take(reverse, scenes * in.corrections * 3 * p.functions);
  w.wanted = take(reverse && in.has_vertex_blocks, scenes * kRow * positions);
  w.inverse = take(in.has_vertex_blocks, scenes * 9 * p.cells);
  const auto doubles = [&](int64_t count) {
    return reinterpret_cast<double*>(take(in.has_vertex_blocks, bytes(scenes * count, sizeof(double))));
  };
  w.press = doubles(6 * positions);
  w.matrix = {nullptr, doubles(int64_t{9} * p.cells), doubles(int64_t{6} * p.functions * kEdge),
              doubles(int64_t{kEdge} * kEdge * p.bodies)};
  w.sums = reinterpret_cast<double*>(take(!reverse, bytes(scenes * p.parts * coarse::kDegree, sizeof(double))));
  w.failures = reinterpret_cast<int32_t*>(take(!reverse, bytes(scenes * p.bodies, sizeof(int32_t))));
  return w;
}

// Arrays that start from zero come first. Returns their scalars through `zeroed`.
template <class T>
Workspace<T> carve(const HostPlan& host, const StepInputs<T>& in, const StepAdjoints<T>* adjoints, const Choice& choice,
                   Carver<T>& take, int64_t* zeroed, T** spill, CoarseWork<T>& coarse) {
  const GroupPlan& plan = host.plan;
  const int64_t n = choice.chunk, positions = int64_t{plan.blocks} * kSlice, pairs = int64_t{plan.slots} * kSlice;
  const bool elastic = (in.energies & kElastic) != 0, reverse = adjoints != nullptr;
  const bool lagged = any_x_prev(in.energies, VertexEnergies{});
  const bool one = one_for_items(in.material);
  int scalars = 0;
  for (int k = 0; k < kVertexEnergies; ++k) scalars += in.data_count[k];
  Workspace<T> w{};
  w.rows = take(reverse, n * (int64_t{plan.edge_slots} * kSlice + 1) * kRow);
  w.y_bar = take(reverse, n * 3 * positions);
  w.x_prev_bar = take(reverse && lagged, n * 3 * positions);
  w.mass_bar = take(reverse && adjoints->mass, n * positions);
  w.material_bar = take(elastic && (choice.wanted & kMaterial), n * kTetScalars * (one ? positions : pairs));
  w.rest_bar = take(elastic && (choice.wanted & kRest), n * kPairRest * pairs);
  w.data_bar = take(reverse && adjoints->data, n * scalars * positions);
  *zeroed = take.used;
  w.x = take(true, n * kRow * positions);
  w.x_bar = take(reverse, n * kRow * positions);
  w.y = take(true, n * 3 * positions);
  w.x_prev = take(lagged, n * 3 * positions);
  w.origin = take(in.origin.data != nullptr, n * 3 * positions);
  w.mass = take(true, (in.mass.scene != 0 ? n : 1) * positions);
  w.material = take(elastic && !one, (one_for_scenes(in.material) ? 1 : n) * kTetScalars * pairs);
  const bool among =
      possible_lanes<T>(host, choice, choice.lanes, reverse) == kManyLanes;  // blocks keep it to themselves
  w.contact = take(in.contact && !among, n * kContactScalars * positions);
  w.moved = take(!reverse && in.contact, n * kRow * positions);
  w.turn = take(reverse && in.contact, n * 6 * positions);
  w.position = reinterpret_cast<int32_t*>(take(in.contact != nullptr, plan.num_vertices));
  *spill = nullptr;
  if (possible_lanes<T>(host, choice, choice.lanes, reverse) == kSpillLanes) {
    const int64_t warps = int64_t{choice.multiprocessors} * kWarpsPerBlock;
    *spill = take(true, warps * shared_scalars<T>(host.degree, host.valence, 0, kSpillLanes, reverse));
  }
  coarse = {};
  if (in.coarse) coarse = carve_coarse(*in.coarse, positions, n, reverse, take);
  return w;
}

}  // namespace
}  // namespace diffvbd::cuda
