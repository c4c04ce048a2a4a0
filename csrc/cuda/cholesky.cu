// Factors and solutions of the systems of rigid motions, a block for each.
#include "cholesky.cuh"
#include "contact_rigid.cuh"

namespace diffvbd::cuda {
namespace {

__global__ void __launch_bounds__(kSquare) cholesky_kernel(int64_t size, double* matrices, const uint8_t* state) {
  if (!is_done(state, blockIdx.x)) cholesky_of(size, matrices + size * size * blockIdx.x);
}

__global__ void __launch_bounds__(kSquare)
    solve_kernel(int64_t size, const double* factors, double* x, const uint8_t* state) {
  if (!is_done(state, blockIdx.x)) solve_with(size, factors + size * size * blockIdx.x, x + size * blockIdx.x);
}

}  // namespace

cudaError_t cholesky(int64_t count, int64_t size, double* matrices, cudaStream_t stream, const uint8_t* state) {
  if (count > 0) cholesky_kernel<<<static_cast<unsigned>(count), kSquare, 0, stream>>>(size, matrices, state);
  return cudaGetLastError();
}

cudaError_t cholesky_solve(int64_t count, int64_t size, const double* factors, double* x, cudaStream_t stream,
                           const uint8_t* state) {
  if (count > 0) solve_kernel<<<static_cast<unsigned>(count), kSquare, 0, stream>>>(size, factors, x, state);
  return cudaGetLastError();
}

}  // namespace diffvbd::cuda
