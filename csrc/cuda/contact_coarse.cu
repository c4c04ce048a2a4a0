#include "contact_coarse.h"
#include "runs.cuh"

namespace diffvbd::cuda {

template <class T>
cudaError_t contact_coarse_system(const CoarseInputs<T>& c, const Batched<const T>& packed, const RowMemory& rows,
                                  const SystemMemory& memory, double* r, double* matrix, cudaStream_t stream) {
  coarse_system(Launches(stream), c, packed, rows, memory, r, matrix);
  return cudaGetLastError();
}
template <class T>
cudaError_t contact_coarse_move(const CoarseStep<T>& s, cudaStream_t stream) {
  coarse_move(Launches(stream), s);
  return cudaGetLastError();
}
template <class T>
cudaError_t contact_coarse_restrict(const CoarseInputs<T>& c, const T* x_bar, const double* fraction, double* to,
                                    cudaStream_t stream) {
  coarse_restrict(Launches(stream), c, x_bar, fraction, to);
  return cudaGetLastError();
}
template <class T>
cudaError_t contact_coarse_motions(const CoarseInputs<T>& c, const double* a, const double* l, const double* fraction,
                                   T* p, T* q, cudaStream_t stream) {
  coarse_motions(Launches(stream), c, a, l, fraction, p, q);
  return cudaGetLastError();
}
template <class T>
cudaError_t contact_coarse_reverse(const CoarseInputs<T>& c, const double* a, const double* l, const double* fraction,
                                   const T* x_bar, const VirtualMotions<T>& given, const PointWork<T>& scattered,
                                   const CoarseAdjoints<T>& out, cudaStream_t stream) {
  coarse_reverse(Launches(stream), c, a, l, fraction, x_bar, given, scattered, out);
  return cudaGetLastError();
}

DIFFVBD_INSTANTIATE(contact_coarse_system)
DIFFVBD_INSTANTIATE(contact_coarse_move)
DIFFVBD_INSTANTIATE(contact_coarse_restrict)
DIFFVBD_INSTANTIATE(contact_coarse_motions)
DIFFVBD_INSTANTIATE(contact_coarse_reverse)

}  // namespace diffvbd::cuda
