// A whole step of sweeps over a batch of scenes: the arrays as the user keeps them, and the loops over scenes and
// colors.
#pragma once

#include "../contact/passes.h"
#include "../subspace/coarse.h"
#include "plan.h"
#include "scene.h"

namespace diffvbd {

// Inputs in the user's numbering; `scene` strides are 0 where scenes share a tensor.
template <class T>
struct StepInputs {
  using Scalar = T;
  int64_t scenes;
  Batched<const T> x_start, x_prev, y, origin;  // [B, V, 3]; origin may be null
  Batched<const T> material[kMaterialScalars];  // [B, T], also item stride 0 for one value
  Batched<const T> mass;                        // [B, V]
  Batched<const T> rest;                        // [B, slots, kPairRest, kLanes]
  Batched<const T> data;                        // [B, N]
  int energies;                                 // mask, see energies.h
  int data_count[kVertexEnergies];              // scalars per scene, or per vertex, of each energy
  int64_t data_size;                            // N
  StepParameters<T> parameters;
  int sweeps, tape_policy;
  const contact::ContactInputs<T>* contact;  // null without contact
  const coarse::Inputs<T>* coarse;           // null without coarse corrections
  int64_t debug_step;                        // step number to name when a position is not finite; -1: do not look
};

template <class T>
struct StepAdjoints {
  using Scalar = T;
  T *x_start, *x_prev, *y;                     // [B, V, 3]
  T* material[kMaterialScalars];               // [B, T] each; null where not wanted, as below
  T *mass, *rest, *data;                       // [B, V], [B, T, kRestScalars], [B, N]
  const contact::ContactAdjoints<T>* contact;  // with contact
  T* collider;                                 // [B, Vc, 3] with contact
};

// The values that a step cannot work with raise std::invalid_argument naming the argument.
template <class T>
void check_values(const Plan& plan, const StepInputs<T>& in);

// shares [B, T, stride] of the tets' masses in their corners: finite and > 0
template <class T>
void check_masses(const T* fractions, int64_t scenes, int64_t tets, int64_t stride);

// x [B, V, 3], tape [B, sweeps, tape_rows, active]; truncations with contact: [B, sweeps, V] exponents of limits
// (contact/limit.h)
template <class T>
void run_forward(const Plan& plan, const StepInputs<T>& in, T* x, T* tape, uint8_t* truncations = nullptr);

// x and limits are what run_forward returned, x_bar is the adjoint of x; both [B, V, 3]
template <class T>
void run_reverse(const Plan& plan, const StepInputs<T>& in, const T* x, const T* x_bar, const T* tape,
                 const uint8_t* limits, const StepAdjoints<T>& out);

// [T, kRestScalars] -> [slots, kPairRest, kLanes]: the rest shape of each tet, as its four vertices see it
template <class T>
void pack_rest(const Plan& plan, const T* rest, T* packed);

}  // namespace diffvbd
