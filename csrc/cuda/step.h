// Interface between the bindings and the kernels of a step: plain structs and launchers, without torch.
#pragma once

#include <cuda_runtime_api.h>

#include "../contact/passes.h"
#include "../core/views.h"
#include "../energies/energies.h"
#include "../subspace/coarse.h"

namespace diffvbd::cuda {

// Scalars of a pair's rest shape in memory: a multiple of the widest load.
constexpr int kRestRow = (kPairRest + 3) / 4 * 4;

// Distribution of a step's sweeps over the device (docs/performance.md).
enum Regime {
  kThread = 1,  // a scene per thread, a step per launch
  kBlock = 2,   // a scene per thread block, a step per launch
  kGrid = 3,    // all scenes by one cooperative grid, a step per launch
  kColor = 4,   // all scenes, a launch per color
};

// Inputs of a step in the user's numbering.
template <class T>
struct StepInputs {
  using Scalar = T;
  int64_t scenes;
  Batched<const T> x_start, x_prev, y, origin;  // [B, V, 3]; origin may be null
  Batched<const T> material[kMaterialScalars];  // [B, T] or one value for a scene (item 0)
  Batched<const T> mass;                        // [B, V]
  Batched<const T> rest;                        // [B, slots, kRestRow / pack, kSlice, pack], see pack_rest
  Batched<const T> data;                        // [B, N]
  int energies;                                 // mask, see energies.h
  int data_count[kVertexEnergies];
  int64_t data_size;  // N
  StepParameters<T> parameters;
  int sweeps, tape_policy;
  // A fused step has these in place of x_start and y, which are then the predictor (pinned vertices: `prescribed`, or
  // x_prev), and returns velocities.
  bool fused;
  Batched<const T> v, acceleration,
      prescribed;                            // [B, V, 3]; acceleration also [B, 1, 3] (item 0); prescribed may be null
  const contact::ContactInputs<T>* contact;  // on the host; null without contact
  const coarse::Inputs<T>* coarse;           // on the host; null without corrections
};

template <class T>
struct StepOutputs {
  T *x, *v;              // [B, V, 3]; v only of a fused step
  T* tape;               // [B, sweeps, rows, active] in all; a scene per thread keeps scenes last
  uint8_t* truncations;  // [B, sweeps, V], zero: exponents of limits; with contact
};

template <class T>
struct StepAdjoints {
  using Scalar = T;
  const T *x_bar, *v_bar;                      // of the outputs; v_bar only of a fused step, either may be null there
  T *x_start, *x_prev, *y;                     // [B, V, 3]
  T* material[kMaterialScalars];               // [B, 1 | T] each; null where not wanted, as below
  T *mass, *rest, *data;                       // [B, V], [B, T, kRestScalars], [B, N]
  T *x, *v, *acceleration, *prescribed;        // of a fused step, null where not wanted
  const contact::ContactAdjoints<T>* contact;  // on the host; with contact, as are the next
  const uint8_t* limits;                       // `truncations` of the forward
  T *collider, *collider_prev, *kappa;         // [B, Vc, 3], [B, Vc, 3], [B]
};

// Workspace of the kernels for a chunk of scenes, in sweep order; sizes per scene.
template <class T>
struct Workspace {
  T *x, *x_bar, *rows;                          // [positions, 4], [positions, 4], [edge_slots kSlice + 1, 4]
  T *y, *x_prev, *origin, *y_bar, *x_prev_bar;  // [blocks, 3, kSlice]
  T *mass, *mass_bar;                           // [positions]
  T *material,
      *material_bar;  // [slots, kSlice, kMaterialScalars]; the bar [positions, ...] if a scene has one material
  T* rest_bar;        // [slots, kSlice, kPairRest]
  T* data_bar;        // [scalars, positions]
  // with contact:
  T* contact;         // [positions, kContactScalars]: pair terms of the block
  T* moved;           // [positions, 4]: vertices that have moved in a sweep; x of the next one
  T* reversed;        // [positions, 6]: p and d_raw of the latest reversed update
  int32_t* position;  // [V]: position of a vertex in sweep order
};

// Rows of vertices before and after their motion in a sweep.
template <class T>
struct MovingRows {
  T *x, *moved;
};

// Arguments of the sweep kernels for a chunk of scenes.
template <class T>
struct StepView {
  GroupPlan plan;
  int64_t scenes, positions;
  int64_t base;         // the first scene of the chunk
  int degree, valence;  // largest number of neighbours and of pairs
  int stages;           // of records in shared memory: 0, kFewStages or kManyStages
  StepParameters<T> parameters;
  int sweeps, tape_policy, tape_rows;  // tape_rows: scalars of a vertex and sweep
  bool one_material;                   // `material` below; else w.material
  bool has_tets;                       // whether tets have an energy
  bool own;                            // whether a block has its scene to itself
  Batched<const T> mass, rest, data, material[kMaterialScalars];
  int64_t material_scene;
  int64_t data_start[kVertexEnergies];
  int data_count[kVertexEnergies], data_row[kVertexEnergies];
  int data_scalars;
  Workspace<T> w;
  const uint8_t* limits;  // [B, sweeps, V] exponents, with contact in the reverse
  T* spill;               // [warps, shared_scalars] for kSpillLanes
  T* tape;
};

constexpr int kMaxThreads = 256;  // of a block of the sweep kernels

// Part of a step in one launch: sweeps [first_sweep, end_sweep) in the order of execution (reversed in the reverse),
// and of each the colors [first_color, end_color).
struct Range {
  int regime;
  int first_sweep, end_sweep, first_color, end_color;
  unsigned* barrier;  // kGrid: zero before the launch
};

// Further arguments of the kernels with contact.
template <class T>
struct ContactView {
  contact::ContactInputs<T> in;
  contact::ContactAdjoints<T> slots;  // in the reverse
  uint8_t* truncations;               // in the forward
};

// Passes of contact for the blocks [begin, end) of a color. Kernels may be dependent launches (schedule.cuh). Where
// warps share a vertex, all but reverse() are part of the sweep kernel; reverse() too where one launch has all sweeps.
template <class T>
struct ContactPasses {
  const StepView<T>& s;
  const ContactView<T>& c;
  cudaStream_t stream;

  // Before the updates: pair terms of the blocks. sweep: in the reverse, otherwise negative.
  cudaError_t assemble(int sweep, int64_t begin, int64_t end, bool dependent) const;
  // After the updates: limits them.
  cudaError_t limit(int sweep, int64_t begin, int64_t end, bool dependent) const;
  // In the reverse, before the updates: gathers what pairs scattered.
  cudaError_t prepare(int64_t begin, int64_t end, bool dependent) const;
  // In the reverse, after the updates: adjoint of assemble(). few: a warp for each kind of pair of a vertex.
  cudaError_t reverse(bool few, int64_t begin, int64_t end, bool dependent) const;
  // After the last update, before the adjoints are stored: the rest for vertices and colliders.
  cudaError_t collect(const StepAdjoints<T>& out) const;
  // After the adjoints are stored: adjoints of the start of the step and of kappa.
  cudaError_t store(const StepAdjoints<T>& out) const;

 private:
  template <class... P, class... A>
  cudaError_t over(void (*kernel)(P...), int64_t begin, int64_t end, int warps, bool dependent, A... arguments) const;
};

// Kernel with a StepView and a Range, and a ContactView where the set has contact.
using SweepKernel = const void*;

// Threads per vertex: few where vertices fill the device, many to finish a small color soon. The last is for stars too
// large for shared memory: a whole warp that works in device memory.
constexpr int kFewLanes = 2, kSomeLanes = 8, kSomeReverseLanes = 4, kManyLanes = 32, kSpillLanes = 64;
DIFFVBD_FN constexpr int threads_of(int lanes) { return lanes == kSpillLanes ? kSlice : lanes; }
// Whether the reverse gathers single contributions edge by edge (many threads); few threads sum their own contributions
// to each neighbour.
DIFFVBD_FN constexpr bool gathers(int lanes) { return lanes >= kManyLanes; }

// Kernels of a set of energies for `lanes` threads per vertex.
template <class T>
SweepKernel forward_kernel(int energies, int lanes);
template <class T, int wanted, int lanes>
SweepKernel reverse_kernel(int energies);

// Stages of records in shared memory (records.cuh), in the reverse with several pairs per thread: one is read while
// others are loaded.
constexpr int kFewStages = 2, kManyStages = 4;  // powers of two
DIFFVBD_FN constexpr bool has_stages(int lanes, bool reverse) { return reverse && lanes < kManyLanes; }
template <class T>
DIFFVBD_FN constexpr int stage_scalars() {
  return kSlice * (kRestRow + kMaterialScalars) +
         kSlice * static_cast<int>(sizeof(int32_t)) / static_cast<int>(sizeof(T));
}

// Scalars of shared memory of a warp, for stars of up to `degree` neighbours and `valence` pairs.
template <class T>
DIFFVBD_FN constexpr int shared_scalars(int degree, int valence, int stages, int lanes, bool reverse) {
  const int groups = kSlice / threads_of(lanes);
  const int contributions = gathers(lanes) ? 3 * (3 * valence + 1) : 3 * degree * lanes;
  return stages * stage_scalars<T>() + groups * (3 * degree + (reverse ? contributions : 0));
}

// The variant with few threads is not built with contact, nor for a generated law, which is compiled at its first use.
constexpr bool has_few(int mask) { return !kOwnLaw && (mask & kContact) == 0; }
constexpr bool is_built(int mask, int lanes) { return is_compiled(mask) && (lanes != kFewLanes || has_few(mask)); }

// Plan with the numbers that the host needs.
struct HostPlan {
  GroupPlan plan;              // arrays on the device
  const int64_t* color_block;  // [colors + 1] on the host
  int degree, valence;         // largest number of neighbours and of pairs of an active vertex
};

// Choices for the run of a step.
struct Choice {
  int regime, lanes, wanted;
  int64_t chunk;  // scenes that are worked on at once
  int multiprocessors;
  size_t shared;        // bytes of shared memory of a block
  size_t by_pairs = 0;  // and of these for pairs in a sweep
};

constexpr int kWarpsPerBlock = 4;         // of the grid and color regimes
constexpr size_t kPairBytes = 14 * 1024;  // of a block's shared memory for pairs
// Threads per vertex: `least`, or as many more as it takes for stars to fit into shared memory.
template <class T>
int possible_lanes(const HostPlan& host, const Choice& choice, int least, bool reverse) {
  const size_t room = choice.shared - choice.by_pairs;
  const auto needed = [&](int lanes) {
    const int stages = has_stages(lanes, reverse) ? kFewStages : 0;
    return shared_scalars<T>(host.degree, host.valence, stages, lanes, reverse) * sizeof(T);
  };
  const int some = reverse ? kSomeReverseLanes : kSomeLanes;
  if (!kOwnLaw && least <= kFewLanes && 6 * needed(kFewLanes) <= room)
    return kFewLanes;                                          // fewer warps would wait for memory
  if (least <= some && 4 * needed(some) <= room) return some;  // warps of a block
  return needed(kManyLanes) <= room ? kManyLanes : kSpillLanes;
}

template <class T>
size_t workspace_bytes(const HostPlan& host, const StepInputs<T>& in, const StepAdjoints<T>* adjoints,
                       const Choice& choice);
template <class T>
cudaError_t run_forward(const HostPlan& host, const StepInputs<T>& in, const StepOutputs<T>& out, const Choice& choice,
                        void* workspace, cudaStream_t stream);
// ends: x of run_forward().
template <class T>
cudaError_t run_reverse(const HostPlan& host, const StepInputs<T>& in, const T* ends, const T* tape,
                        const StepAdjoints<T>& out, const Choice& choice, void* workspace, cudaStream_t stream);

// A scene per thread, for many small meshes (scene.cuh). ill_conditioned [scenes]: workspace.
template <class T>
cudaError_t run_scene_forward(const HostPlan& host, const StepInputs<T>& in, const StepOutputs<T>& out,
                              const Choice& choice, uint8_t* ill_conditioned, cudaStream_t stream);
template <class T>
cudaError_t run_scene_reverse(const HostPlan& host, const StepInputs<T>& in, const T* ends, const T* tape,
                              const StepAdjoints<T>& out, const Choice& choice, uint8_t* ill_conditioned,
                              cudaStream_t stream);

}  // namespace diffvbd::cuda
