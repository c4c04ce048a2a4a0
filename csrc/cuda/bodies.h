// Work on the bodies of a scene: the start of a step, the rigid correction and energy increases.
#pragma once

#include <cuda_runtime_api.h>

#include <cstdint>

#include "../subspace/begin.h"
#include "../subspace/coarse.h"
#include "../subspace/rigid.h"

namespace diffvbd::cuda {

// Numbers of bodies, smallest first, that a thread (where there are many), some lanes of a warp, a block, and the whole
// device work on. The whole device is used only while one block for each large body would be slower.
struct BodyGroups {
  int32_t tiny, small, medium, large;
};

// Doubles of workspace for sums over the whole device; 0 where no body needs them.
int64_t bodies_workspace(const BodyGroups& groups, int64_t scenes, int64_t vertices);

// others: whether some vertices are in no body that is corrected
template <class T>
cudaError_t rigid_correct(const rigid::Inputs<T>& in, const BodyGroups& groups, bool others, T* x, T* velocity,
                          double* workspace, cudaStream_t stream);
template <class T>
cudaError_t rigid_reverse(const rigid::Inputs<T>& in, const BodyGroups& groups, bool others,
                          const rigid::Adjoints<T>& a, double* workspace, cudaStream_t stream);

using start::StartChoice;

template <class T>
cudaError_t begin(const start::Inputs<T>& in, const BodyGroups& groups, const StartChoice<T>& of_corrected,
                  const BodyGroups& other_groups, const StartChoice<T>& of_others, T* x_start, T* y, double* workspace,
                  cudaStream_t stream);
template <class T>
cudaError_t begin_backward(const start::Inputs<T>& in, const BodyGroups& groups, const start::Adjoints<T>& a,
                           T* extrapolated, T* y, double* workspace, cudaStream_t stream);

// Doubles that energy_increase works in.
template <class T>
int64_t energy_increase_workspace(const coarse::IncreaseInputs<T>& in) {
  return 2 * in.bodies.scenes * (in.blocks + in.listed);
}

// out [B, bodies, 2]: increase and magnitude of the terms; infinite or NaN where a vertex comes too near a plane.
template <class T>
cudaError_t energy_increase(const coarse::IncreaseInputs<T>& in, double* workspace, double* out, cudaStream_t stream);

}  // namespace diffvbd::cuda
