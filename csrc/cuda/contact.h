// Contact on the device: launchers of the passes of contact/passes.h, for a chunk of scenes.
#pragma once

#include "../contact/friction.h"
#include "../contact/passes.h"
#include "step.h"

namespace diffvbd::cuda {

// Of the blocks [begin, end) of a color, whose kernel may wait for the one before by itself (`follows`, follow.cuh).
// Each returns after its launches. Where warps share a vertex, all but reverse() are part of the sweep's kernel; where
// that has all sweeps, reverse() too.
template <class T>
struct ContactPasses {
  const StepView<T>& s;
  const ContactView<T>& c;
  cudaStream_t stream;

  // Before their turn: the pairs' part of the blocks; sweep: in the reverse, else negative.
  cudaError_t assemble(int sweep, int64_t begin, int64_t end, bool follows) const;
  // After it: takes back what planes do not let pass of the motion.
  cudaError_t limit(int sweep, int64_t begin, int64_t end, bool follows) const;
  // In the reverse, before their turn: what pairs have sent.
  cudaError_t prepare(int64_t begin, int64_t end, bool follows) const;
  // And after it: the adjoint of assemble(). few: a warp for each kind of pair of a vertex.
  cudaError_t reverse(bool few, int64_t begin, int64_t end, bool follows) const;
  // After the last turn, before the adjoints are stored: what is left for vertices and colliders.
  cudaError_t collect(const StepAdjoints<T>& out) const;
  // After the adjoints are stored: those of the start of the step, of kappa.
  cudaError_t store(const StepAdjoints<T>& out) const;

 private:
  template <class... P, class... A>
  cudaError_t over(void (*kernel)(P...), int64_t begin, int64_t end, int warps, bool follows, A... arguments) const;
};

// After all scenes: the slots of the corners of each lagged pair added up; zero where there is none.
template <class T>
cudaError_t sum_lag(const contact::ContactInputs<T>& in, int64_t scenes, const contact::ContactAdjoints<T>& slots,
                    int64_t pairs, T* lag, cudaStream_t stream);

// contact_lag and its adjoint; `pairs` that the list has room for, `count` on the device at ptr[scenes corners]. The
// reverse writes `slots` [pairs, kLagSlots], three scalars for each corner and after each of the first three corners
// one of the pair, and adds them up.
constexpr int kLagSlots = 16;
template <class T>
cudaError_t pair_lag(const contact::ContactInputs<T>& in, const T* x, int64_t scenes, int64_t pairs, T* values,
                     cudaStream_t stream);
template <class T>
cudaError_t pair_lag_backward(const contact::ContactInputs<T>& in, const T* x, int64_t scenes, int64_t pairs,
                              const T* bar, T* slots, T* points, T* kappa, cudaStream_t stream);
// As cpu/contact_lag.cpp's contact_rubbing; friction and damping may be null.
template <class T>
cudaError_t rubbing(const contact::ContactInputs<T>& in, const contact::LagCoefficients<T>& by, const T* x,
                    int64_t scenes, int64_t pairs, T* values, T* slots, T* push, cudaStream_t stream);
template <class T>
cudaError_t rubbing_backward(const contact::ContactInputs<T>& in, const contact::LagCoefficients<T>& by,
                             const contact::LaggedFrictionBars<T>& given, const T* x, int64_t scenes, int64_t pairs, T* slots,
                             T* points, T* kappa, T* friction, T* damping, cudaStream_t stream);

}  // namespace diffvbd::cuda
