// Kernels of friction and damping as they are at the start of a step (contact/lag.h): a thread for each pair, or
// a warp for each corner point.
#pragma once

#include "../contact/lag.h"
#include "clear_rows.cuh"
#include "contact.cuh"

namespace diffvbd::cuda {
namespace {

// A pair that is in the list, with what its lag depends on.
template <class T>
struct LagPair {
  const int32_t* record;
  contact::PairConstants<T> constants;
  T kappa;
  contact::Corners<T> corners;
  __device__ __forceinline__ LagPair(const ContactInputs<T>& in, const T* x, int64_t pair)
      : record(in.listed.pairs + contact::kPairRow * pair),
        constants(in.constants + contact::kConstants * pair),
        kappa(in.kappa.data[record[5] * in.kappa.scene]) {
    const UserRows<T> rows{x + static_cast<int64_t>(record[5]) * 3 * in.num_vertices};
    corners = contact::Source<T, UserRows<T>>{in, record[5], rows}.corners(record);
  }
};

template <class T>
__global__ void lag_forward(const __grid_constant__ ContactInputs<T> in, const T* x, int64_t scenes, int64_t pairs,
                            T* values) {
  const int64_t pair = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  const int64_t count = in.listed.ptr[scenes * in.corners] / 4;
  clear_rows(values, contact::kLagScalars, count, pairs);
  if (pair >= count) return;
  T* to = values + contact::kLagScalars * pair;
  const LagPair<T> at(in, x, pair);
  contact::store_lag(contact::lag_state(at.record[4], at.corners, at.constants, at.kappa), to);
}

template <class T>
__global__ void lag_reverse(const __grid_constant__ ContactInputs<T> in, const T* x, int64_t scenes, int64_t pairs,
                            const T* bar, T* slots) {
  const int64_t pair = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (pair >= pairs || 4 * pair >= in.listed.ptr[scenes * in.corners]) return;
  const LagPair<T> at(in, x, pair);
  contact::PairAdjoint<T> out;
  contact::reverse_lag(at.record[4], at.corners, at.constants, at.kappa, bar + contact::kLagScalars * pair, out);
  for (int k = 0; k < 4; ++k) {
    T* to = slots + 4 * (4 * pair + k);
    to[0] = out.x[k].x, to[1] = out.x[k].y, to[2] = out.x[k].z, to[3] = k == 0 ? out.kappa : T(0);
  }
}

// By corner point, with a warp: what its pairs' corners have received.
template <class T>
__global__ void lag_collect(const __grid_constant__ ContactInputs<T> in, int64_t scenes, const T* slots, T* x_bar,
                            T* collider_bar) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x, row = i / kSlice;
  if (row >= scenes * in.corners) return;
  const auto lane = static_cast<int>(i % kSlice);
  Vec3<T> sum = zero3<T>();
  for (int e = in.listed.ptr[row] + lane; e < in.listed.ptr[row + 1]; e += kSlice) {
    sum += contact::vector_at(slots + int64_t{4} * in.listed.entry[e]);
  }
  sum_share<kSlice>(sum);
  if (lane != 0) return;
  const int64_t scene = row / in.corners, corner = row - scene * in.corners, colliders = in.corners - in.num_vertices;
  T* to = corner < in.num_vertices ? x_bar + 3 * (scene * in.num_vertices + corner)
                                   : collider_bar + 3 * (scene * colliders + corner - in.num_vertices);
  to[0] = sum.x, to[1] = sum.y, to[2] = sum.z;
}

}  // namespace

template <class T>
cudaError_t pair_lag(const ContactInputs<T>& in, const T* x, int64_t scenes, int64_t pairs, T* values,
                     cudaStream_t stream) {
  return launch_contact(lag_forward<T>, pairs, stream, in, x, scenes, pairs, values);
}

template <class T>
cudaError_t pair_lag_backward(const ContactInputs<T>& in, const T* x, int64_t scenes, int64_t pairs, const T* bar,
                              T* slots, T* x_bar, T* collider_bar, T* kappa_bar, cudaStream_t stream) {
  if (auto error = launch_contact(lag_reverse<T>, pairs, stream, in, x, scenes, pairs, bar, slots)) return error;
  const T* from = slots;
  if (auto error =
          launch_contact(lag_collect<T>, scenes * in.corners * kSlice, stream, in, scenes, from, x_bar, collider_bar)) {
    return error;
  }
  return launch_sum(scenes, stream, in, int64_t{0}, from + 3, 4, kappa_bar);
}

}  // namespace diffvbd::cuda

#define DIFFVBD_INSTANTIATE_LAG(T)                                                                              \
  template cudaError_t diffvbd::cuda::pair_lag<T>(const diffvbd::contact::ContactInputs<T>&, const T*, int64_t, \
                                                  int64_t, T*, cudaStream_t);                                   \
  template cudaError_t diffvbd::cuda::pair_lag_backward<T>(const diffvbd::contact::ContactInputs<T>&, const T*, \
                                                           int64_t, int64_t, const T*, T*, T*, T*, T*, cudaStream_t);
