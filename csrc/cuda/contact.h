// Contact on the device: launchers of the passes of contact/passes.h, for a chunk of scenes.
#pragma once

#include "../contact/passes.h"
#include "step.h"

namespace diffvbd::cuda {

// In the order of a step; each returns after its launches. `begin`, `end`: blocks of a color.
template <class T>
struct ContactPasses {
  const StepView<T>& s;
  const contact::ContactInputs<T>& in;
  const StepAdjoints<T>* out;  // null in the forward
  uint8_t* cut;                // null in the reverse
  int64_t scenes;              // of the batch
  cudaStream_t stream;
  bool follows = false;  // the passes over a color wait for the kernel before them by themselves (follow.cuh)

  // No pairs yet; where vertices are within their rooms.
  cudaError_t load() const;
  // The pairs' part of the blocks; in the forward remembers where the color is.
  cudaError_t assemble(int64_t begin, int64_t end) const;
  // After the update of a color: takes back what planes do not let pass of its motion.
  cudaError_t limit(int sweep, int64_t begin, int64_t end) const;
  // Reverse, before a color's turn: positions before its update from the tape, and what pairs have sent.
  cudaError_t prepare(int sweep, int64_t begin, int64_t end) const;
  // Reverse, after the turn: the adjoint of assemble().
  cudaError_t reverse(int64_t begin, int64_t end) const;
  // After the last turn, before the adjoints are stored: what is left for vertices and colliders.
  cudaError_t collect() const;
  // After the adjoints are stored: those of the start of the step, of kappa.
  cudaError_t store() const;
};

// After all scenes: the slots of the corners of each lagged pair added up; zero where there is none.
template <class T>
cudaError_t sum_lag(const contact::ContactInputs<T>& in, int64_t scenes, const contact::ContactAdjoints<T>& slots,
                    int64_t pairs, T* lag, cudaStream_t stream);

// contact_lag and its adjoint; `pairs` that the list has room for, `count` on the device at ptr[scenes corners]. The
// reverse writes `slots` [4 pairs, 4] (x, y, z and kappa of each corner) and then adds them up by corner point.
template <class T>
cudaError_t pair_lag(const contact::ContactInputs<T>& in, const T* x, int64_t scenes, int64_t pairs, T* values,
                     cudaStream_t stream);
template <class T>
cudaError_t pair_lag_backward(const contact::ContactInputs<T>& in, const T* x, int64_t scenes, int64_t pairs,
                              const T* bar, T* slots, T* x_bar, T* collider_bar, T* kappa_bar, cudaStream_t stream);

}  // namespace diffvbd::cuda
