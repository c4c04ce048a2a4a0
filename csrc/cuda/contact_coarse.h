// The coarse correction of bodies that touch (subspace/contact_coarse.h), on CUDA.
#pragma once

#include <cuda_runtime_api.h>

#include "../subspace/contact_coarse.h"

namespace diffvbd::cuda {

template <class T>
cudaError_t contact_coarse_system(const contact::CoarseInputs<T>& c, const Batched<const T>& packed,
                                  const contact::RowMemory& rows, const contact::SystemMemory& memory, double* r,
                                  double* matrix, cudaStream_t stream);
template <class T>
cudaError_t contact_coarse_move(const contact::CoarseStep<T>& s, cudaStream_t stream);
template <class T>
cudaError_t contact_coarse_restrict(const contact::CoarseInputs<T>& c, const T* x_bar, const double* fraction,
                                    double* to, cudaStream_t stream);
template <class T>
cudaError_t contact_coarse_motions(const contact::CoarseInputs<T>& c, const double* a, const double* l,
                                   const double* fraction, T* p, T* q, cudaStream_t stream);
template <class T>
cudaError_t contact_coarse_reverse(const contact::CoarseInputs<T>& c, const double* a, const double* l,
                                   const double* fraction, const T* x_bar, const contact::VirtualMotions<T>& given,
                                   const contact::PointWork<T>& scattered, const contact::CoarseAdjoints<T>& out,
                                   cudaStream_t stream);

}  // namespace diffvbd::cuda
