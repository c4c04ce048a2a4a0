// Contact on the device: detection, lists of pairs, and the start of a step.
#pragma once

#include <cuda_runtime_api.h>

#include <cstddef>

#include "../contact/detection.h"
#include "../contact/friction.h"
#include "../contact/intersect.h"
#include "../contact/islands.h"
#include "../contact/motion.h"
#include "../contact/pair_list.h"
#include "../contact/passes.h"
#include "../contact/start.h"
#include "../contact/trust_region.h"

namespace diffvbd::cuda {

// After all scenes: sum of the slots of the corners of each lagged pair; zero where there is none.
template <class T>
cudaError_t sum_lag(const contact::ContactInputs<T>& in, int64_t scenes, const contact::ContactAdjoints<T>& slots,
                    int64_t pairs, T* lag, cudaStream_t stream);

// Lagged quantities of pairs and their adjoint. pairs: capacity of the list; its length is on the device, at ptr[scenes
// corners]. The reverse writes `slots` [pairs, kLagSlots] and sums them: three scalars for each corner, and after each
// of the first three corners one of the pair.
constexpr int kLagSlots = 16;
template <class T>
cudaError_t pair_lag(const contact::ContactInputs<T>& in, const T* x, int64_t scenes, int64_t pairs, T* values,
                     cudaStream_t stream);
template <class T>
cudaError_t pair_loads(const contact::PairList& listed, int64_t corners, const int32_t* body, const T* lag,
                       int64_t scenes, int64_t pairs, T* force, int64_t* bearer, cudaStream_t stream);
template <class T>
cudaError_t pair_lag_backward(const contact::ContactInputs<T>& in, const T* x, int64_t scenes, int64_t pairs,
                              const T* bar, T* slots, T* points, T* kappa, cudaStream_t stream);
// Bytes of workspace.
template <class T>
size_t detect_workspace_bytes(const contact::Surfaces<T>& in, int64_t capacity);

template <class T>
cudaError_t detect(const contact::Surfaces<T>& in, const contact::Detected<T>& out, void* workspace,
                   cudaStream_t stream);

// Bytes of workspace.
template <class T>
size_t intersections_workspace_bytes(const contact::Surfaces<T>& in, int64_t capacity);

template <class T>
cudaError_t find_intersections(const contact::Surfaces<T>& in, const contact::Intersections& out, void* workspace,
                               cudaStream_t stream);

// Bytes of workspace of find_islands().
template <class T>
size_t islands_workspace_bytes(const contact::IslandInputs<T>& in);

// island [B, mesh_bodies]. again: the workspace is that of a call that differed only in radii.
template <class T>
cudaError_t find_islands(const contact::IslandInputs<T>& in, int32_t* island, void* workspace, cudaStream_t stream,
                         bool again = false);

// Bytes of workspace for a list of that capacity.
template <class T>
int64_t advance_workspace_bytes(const contact::AdvanceInputs<T>& in, int64_t capacity);

// capacity: of the list of pairs.
template <class T>
cudaError_t start_substep(const contact::StartStep<T>& s, int64_t capacity, void* workspace, int multiprocessors,
                          cudaStream_t stream);

// Near pairs and what is left of the radii of vertices (contact/pair_list.h).
template <class T>
int64_t near_workspace_bytes(const contact::NearInputs<T>& in);
template <class T>
cudaError_t find_near(const contact::NearInputs<T>& in, int64_t scenes, T* radius, const contact::NearList<T>& out,
                      void* workspace, cudaStream_t stream);

template <class T>
cudaError_t find_motion(const contact::MotionInputs<T>& in, T* rigid, T* displacements, T* sums, cudaStream_t stream);
// islands: memory of islands_workspace_bytes().
template <class T>
cudaError_t find_trust_radii(contact::RadiusInputs<T> in, const contact::RadiusWork<T>& work, void* islands,
                             cudaStream_t stream);

}  // namespace diffvbd::cuda
