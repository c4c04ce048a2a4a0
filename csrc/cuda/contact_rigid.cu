#include "cluster.cuh"
#include "contact_rigid.h"
#include "runs.cuh"

namespace diffvbd::cuda {
namespace {

template <class T>
__global__ void __launch_bounds__(kThreads) correct_kernel(const __grid_constant__ RigidStep<T> s) {
  __shared__ double part[kWarps][kMostSums];
  contact::correct_bodies(InBlock(blockIdx.x, BlockTeam{part}), s);
}
template <class T>
__global__ void __launch_bounds__(kThreads) reverse_kernel(const __grid_constant__ RigidReverse<T> r) {
  __shared__ double part[kWarps][kMostSums];
  contact::reverse_bodies(InBlock(blockIdx.x, BlockTeam{part}), r);
}

// Whether scenes are so small, or so many, that a block each takes less time than a launch for each loop.
template <class T>
bool is_small(const RigidStep<T>& s) {
  return s.in.bodies() <= kMostCoupled && has_block_each(s.in.gate.corners, s.in.scene.scenes, s.listed() + s.lagged());
}

}  // namespace

template <class T>
cudaError_t contact_rigid_correct(const RigidStep<T>& s, cudaStream_t stream) {
  if (is_small(s)) {
    correct_kernel<<<static_cast<unsigned>(s.in.scene.scenes), kThreads, 0, stream>>>(s);
  } else {
    contact::correct_bodies(Launches(stream), s);
  }
  return cudaGetLastError();
}
template <class T>
cudaError_t contact_rigid_reverse(const RigidReverse<T>& r, cudaStream_t stream) {
  if (is_small(r.step)) {
    reverse_kernel<<<static_cast<unsigned>(r.step.in.scene.scenes), kThreads, 0, stream>>>(r);
  } else {
    contact::reverse_bodies(Launches(stream), r);
  }
  return cudaGetLastError();
}
template <class T>
cudaError_t work_of_pairs(const WorkStep<T>& s, cudaStream_t stream) {
  contact::sum_work(Launches(stream), s);
  return cudaGetLastError();
}

DIFFVBD_INSTANTIATE(work_of_pairs)
#ifndef DIFFVBD_LAW_HEADER  // the rest reads no law
DIFFVBD_INSTANTIATE(contact_rigid_correct)
DIFFVBD_INSTANTIATE(contact_rigid_reverse)
#endif

}  // namespace diffvbd::cuda
