// The coarse correction of bodies that touch (subspace/contact_coarse.h), on the CPU.
#pragma once

#include "../subspace/contact_coarse.h"

namespace diffvbd {

template <class T>
void contact_coarse_system(const contact::CoarseInputs<T>& c, const Batched<const T>& packed,
                           const contact::SystemMemory& memory, double* r, double* matrix);
template <class T>
void contact_coarse_move(const contact::CoarseInputs<T>& c, const double* a, const double* r, const int32_t* info,
                         const contact::TrialMemory<T>& memory, T* x);
template <class T>
void contact_coarse_restrict(const contact::CoarseInputs<T>& c, const T* x_bar, const double* fraction, double* to);
template <class T>
void contact_coarse_motions(const contact::CoarseInputs<T>& c, const double* a, const double* l, const double* fraction,
                            T* p, T* q);
template <class T>
void contact_coarse_reverse(const contact::CoarseInputs<T>& c, const double* a, const double* l, const double* fraction,
                            const T* x_bar, const contact::VirtualMotions<T>& given,
                            const contact::PointWork<T>& scattered, const contact::CoarseAdjoints<T>& out);

}  // namespace diffvbd
