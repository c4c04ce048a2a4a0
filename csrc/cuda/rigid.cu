#include "bodies.cuh"
#include "rigid.h"

namespace diffvbd::cuda {
namespace {

// What a kernel does to a body: the correction, or its transpose.
template <class T, bool energies>
struct Forward {
  static constexpr bool keeps_record = false, computes = energies;
  T *x, *velocity;
  template <class Team>
  __device__ void operator()(const rigid::Body<T>& body, const Team& team, rigid::Iteration*) const {
    rigid::correct<energies>(body, team, nullptr, x, velocity);
  }
};
template <class T, bool energies>
struct Reverse {
  static constexpr bool keeps_record = energies, computes = energies;
  rigid::Adjoints<T> a;
  template <class Team>
  __device__ void operator()(const rigid::Body<T>& body, const Team& team, rigid::Iteration* record) const {
    rigid::reverse<energies>(body, team, record, a);
  }
};

template <class T>
__global__ void __launch_bounds__(kVertexThreads)
    keep_vertices(const __grid_constant__ rigid::Inputs<T> in, T* x, T* velocity) {
  const Row row(in);
  if (row.exists) keep_vertex(in, row.scene, row.vertex, x, velocity);
}
template <class T>
__global__ void __launch_bounds__(kVertexThreads)
    reverse_vertices(const __grid_constant__ rigid::Inputs<T> in, const __grid_constant__ rigid::Adjoints<T> a) {
  const Row row(in);
  if (row.exists) reverse_kept(in, a, row.scene, row.vertex);
}

}  // namespace

int64_t bodies_workspace(const BodyGroups& groups, int64_t scenes, int64_t vertices) {
  if (groups.large == 0 || by_block(groups, scenes, vertices)) return 0;
  return int64_t{2} * multiprocessors() * kMostSums;
}

template <class T>
cudaError_t rigid_correct(const rigid::Inputs<T>& in, const BodyGroups& groups, bool others, T* x, T* velocity,
                          double* workspace, cudaStream_t stream) {
  if (in.scenes * in.vertices == 0) return cudaSuccess;
  if (others) keep_vertices<T><<<blocks_of(in), kVertexThreads, 0, stream>>>(in, x, velocity);
  if (in.data.data) return run_bodies(in, groups, Forward<T, true>{x, velocity}, workspace, stream);
  return run_bodies(in, groups, Forward<T, false>{x, velocity}, workspace, stream);
}

template <class T>
cudaError_t rigid_reverse(const rigid::Inputs<T>& in, const BodyGroups& groups, bool others,
                          const rigid::Adjoints<T>& a, double* workspace, cudaStream_t stream) {
  if (in.scenes * in.vertices == 0) return cudaSuccess;
  if (others) reverse_vertices<T><<<blocks_of(in), kVertexThreads, 0, stream>>>(in, a);
  if (in.data.data) return run_bodies(in, groups, Reverse<T, true>{a}, workspace, stream);
  return run_bodies(in, groups, Reverse<T, false>{a}, workspace, stream);
}

#define DIFFVBD_INSTANTIATE(T)                                                                                       \
  template cudaError_t rigid_correct<T>(const rigid::Inputs<T>&, const BodyGroups&, bool, T*, T*, double*,           \
                                        cudaStream_t);                                                               \
  template cudaError_t rigid_reverse<T>(const rigid::Inputs<T>&, const BodyGroups&, bool, const rigid::Adjoints<T>&, \
                                        double*, cudaStream_t);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd::cuda
