#include "contact_rigid.cuh"

namespace diffvbd::cuda {
namespace {

template <class T>
__global__ void __launch_bounds__(kOne)
    work_kernel(const __grid_constant__ RigidInputs<T> in, VirtualMotions<T> given, RigidWork<T> out) {
  const int64_t row = own_item();
  if (row < out.listed) {
    barrier_work(in, given, row, out.barrier + 4 * kWorkScalars * row, out.by_kappa + row);
  } else if (row < out.listed + out.lagged) {
    const int64_t i = row - out.listed;
    lagged_work(in, given, i, out.friction + 4 * kWorkScalars * i, out.by_lag + kLagScalars * i);
  }
}

}  // namespace

template <class T>
cudaError_t rigid_backward(const RigidInputs<T>& in, const VirtualMotions<T>& given, const RigidWork<T>& out,
                           cudaStream_t stream) {
  const int64_t rows = out.listed + out.lagged;
  if (rows > 0) work_kernel<T><<<blocks_for(rows), kOne, 0, stream>>>(in, given, out);
  return cudaGetLastError();
}

#define DIFFVBD_INSTANTIATE(T)                                                                                 \
  template cudaError_t rigid_backward<T>(const RigidInputs<T>&, const VirtualMotions<T>&, const RigidWork<T>&, \
                                         cudaStream_t);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd::cuda
