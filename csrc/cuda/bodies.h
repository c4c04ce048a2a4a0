// Work on the bodies of a scene: the start of a step, the rigid correction and energy increases.
#pragma once

#include <cuda_runtime_api.h>

#include <cstdint>

#include "../coarse/rise.h"
#include "../rigid/reverse.h"
#include "../start/part.h"

namespace diffvbd::cuda {

// How many of the bodies, smallest first, are worked on by a thread (where there are many), by a part of a warp, by a
// block, and by the whole device, unless there are so many that a block each is faster.
struct BodyGroups {
  int32_t tiny, small, medium, large;
};

// Doubles of memory that the sums of the whole device go through; 0 where no body needs it.
int64_t bodies_workspace(const BodyGroups& groups, int64_t scenes, int64_t vertices);

// others: whether some vertices are in no body that is corrected
template <class T>
cudaError_t rigid_correct(const rigid::Inputs<T>& in, const BodyGroups& groups, bool others, T* x, T* velocity,
                          double* workspace, cudaStream_t stream);
template <class T>
cudaError_t rigid_reverse(const rigid::Inputs<T>& in, const BodyGroups& groups, bool others,
                          const rigid::Adjoints<T>& a, double* workspace, cudaStream_t stream);

// Bodies whose start is chosen, null for none; their second state; and what receives whether they take it.
template <class T>
struct StartChoice {
  const start::Candidates<T>* two;
  T* second;
  uint8_t* taken;
};

template <class T>
cudaError_t begin(const start::Inputs<T>& in, const BodyGroups& groups, const StartChoice<T>& of_corrected,
                  const BodyGroups& other_groups, const StartChoice<T>& of_others, T* x_start, T* y, double* workspace,
                  cudaStream_t stream);
template <class T>
cudaError_t begin_backward(const start::Inputs<T>& in, const BodyGroups& groups, const start::Adjoints<T>& a,
                           T* coasted, T* y, double* workspace, cudaStream_t stream);

// Doubles that potential_rise works in.
template <class T>
int64_t rise_workspace(const coarse::RiseInputs<T>& in) {
  return 2 * in.bodies.scenes * (in.blocks + in.listed);
}

// out [B, bodies, 2]: rise and size of the terms; infinite, or no number, where a vertex comes too near a plane.
template <class T>
cudaError_t potential_rise(const coarse::RiseInputs<T>& in, double* workspace, double* out, cudaStream_t stream);

}  // namespace diffvbd::cuda
