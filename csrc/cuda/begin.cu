#include "bodies.cuh"
#include "bodies.h"
#include "common.cuh"

namespace diffvbd::cuda {
namespace {

template <class T>
__global__ void __launch_bounds__(kVertexThreads)
    begin_vertices(const __grid_constant__ start::Inputs<T> in, T* x_start, T* from_y, T* y) {
  const Row row(in.bodies);
  if (row.exists) begin_vertex(in, x_start, from_y, y, row.scene, row.vertex);
}
template <class T>
__global__ void __launch_bounds__(kVertexThreads)
    choose_vertices(const __grid_constant__ start::Inputs<T> in, T* x_start, const T* from_y) {
  const Row row(in.bodies);
  if (row.exists) choose_vertex(in, x_start, from_y, row.scene, row.vertex);
}
template <class T>
__global__ void __launch_bounds__(kVertexThreads)
    reverse_vertices(const __grid_constant__ start::Inputs<T> in, const __grid_constant__ start::Adjoints<T> a) {
  const Row row(in.bodies);
  if (row.exists) reverse_vertex(in, a, row.scene, row.vertex);
}

// Actions of the kernels on a body.
template <class T>
struct Choose {
  static constexpr bool keeps_record = false, computes = false;
  start::Candidates<T> two;
  uint8_t* decreases;
  template <class Team>
  __device__ void operator()(const rigid::Body<T>& body, const Team& team, rigid::Iteration*) const {
    const double increase = start::path_between<false>(two, body, team).increase;
    if (team.leads()) decreases[body.scene * two.bodies.bodies + body.body] = increase <= 0;
  }
};
template <class T, bool energies>
struct Begin {
  static constexpr bool keeps_record = false, computes = energies;
  start::Inputs<T> in;
  T *x_start, *y;
  uint8_t* blocked;
  template <class Team>
  __device__ void operator()(const rigid::Body<T>& body, const Team& team, rigid::Iteration*) const {
    start::begin_body<energies>(in, body, team, x_start, y, blocked);
  }
};
template <class T>
struct Part {
  static constexpr bool keeps_record = false, computes = true;
  start::Inputs<T> in;
  start::Candidates<T> two;
  T *x_start, *apart;
  uint8_t* alone;
  template <class Team>
  __device__ void operator()(const rigid::Body<T>& body, const Team& team, rigid::Iteration*) const {
    start::release_body(in, two, body, team, x_start, apart, alone);
  }
};
template <class T, bool energies>
struct ReverseBegin {
  static constexpr bool keeps_record = energies, computes = energies;
  start::Inputs<T> in;
  start::Adjoints<T> a;
  T *extrapolated, *y;
  template <class Team>
  __device__ void operator()(const rigid::Body<T>& body, const Team& team, rigid::Iteration* record) const {
    start::reverse_body<energies>(in, body, team, record, extrapolated, y, a);
  }
};

}  // namespace

template <class T>
cudaError_t begin(const start::Inputs<T>& in, const BodyGroups& groups, const StartChoice<T>& of_corrected,
                  const BodyGroups& other_groups, const StartChoice<T>& of_others, T* x_start, T* y, double* workspace,
                  cudaStream_t stream) {
  if (in.bodies.scenes * in.bodies.vertices == 0) return cudaSuccess;
  if (in.some_alone) {
    T* second = of_others.two != nullptr && of_others.second != y ? of_others.second : nullptr;
    begin_vertices<T><<<blocks_of(in.bodies), kVertexThreads, 0, stream>>>(in, x_start, second, y);
  }
  if (of_others.two != nullptr) {
    const Choose<T> act{*of_others.two, of_others.taken};
    const auto error = run_bodies(act.two.bodies, other_groups, act, workspace, stream);
    if (error != cudaSuccess) return error;
    choose_vertices<T><<<blocks_of(in.bodies), kVertexThreads, 0, stream>>>(in, x_start, of_others.second);
  }
  if (in.bodies.data.data == nullptr) {
    return run_bodies(in.bodies, groups, Begin<T, false>{in, x_start, y, nullptr}, workspace, stream);
  }
  uint8_t* blocked = of_corrected.two != nullptr ? of_corrected.taken : nullptr;
  const auto error = run_bodies(in.bodies, groups, Begin<T, true>{in, x_start, y, blocked}, workspace, stream);
  if (error != cudaSuccess || of_corrected.two == nullptr) return error;
  const Part<T> act{in, *of_corrected.two, x_start, of_corrected.second, of_corrected.taken};
  return run_bodies(act.two.bodies, groups, act, workspace, stream);
}

template <class T>
cudaError_t begin_backward(const start::Inputs<T>& in, const BodyGroups& groups, const start::Adjoints<T>& a,
                           T* extrapolated, T* y, double* workspace, cudaStream_t stream) {
  if (in.bodies.scenes * in.bodies.vertices == 0) return cudaSuccess;
  if (in.some_alone) reverse_vertices<T><<<blocks_of(in.bodies), kVertexThreads, 0, stream>>>(in, a);
  if (in.bodies.data.data) {
    return run_bodies(in.bodies, groups, ReverseBegin<T, true>{in, a, extrapolated, y}, workspace, stream);
  }
  return run_bodies(in.bodies, groups, ReverseBegin<T, false>{in, a, extrapolated, y}, workspace, stream);
}

DIFFVBD_INSTANTIATE(begin)
#ifndef DIFFVBD_LAW_HEADER  // the rest reads no law
DIFFVBD_INSTANTIATE(begin_backward)
#endif

}  // namespace diffvbd::cuda
