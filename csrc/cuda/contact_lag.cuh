// Kernels of friction and damping as they are at the start of a step (contact/lag.h): a thread for each pair, or
// a warp for each corner point.
#pragma once

#include "../contact/friction.h"
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

// Three scalars of a pair, beside what it has for its corners.
template <class T>
struct OwnScalars {
  T of[3];
};
template <class T>
struct SceneSums {
  T* out[3];
};
template <class T>
__device__ __forceinline__ void store_slots(const Vec3<T> (&corners)[4], const OwnScalars<T>& own, T* to) {
  for (int k = 0; k < 4; ++k) {
    to[4 * k] = corners[k].x, to[4 * k + 1] = corners[k].y, to[4 * k + 2] = corners[k].z;
    if (k < 3) to[4 * k + 3] = own.of[k];
  }
}

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
  store_slots(out.x, {out.kappa}, slots + kLagSlots * pair);
}

template <class T>
__global__ void rubbing_forward(const __grid_constant__ ContactInputs<T> in, const contact::LagCoefficients<T> by,
                                const T* x, int64_t scenes, int64_t pairs, T* values, T* slots) {
  const int64_t pair = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  const int64_t count = in.listed.ptr[scenes * in.corners] / 4;
  clear_rows(values, contact::kLagScalars, count, pairs);
  if (pair >= count) return;
  const LagPair<T> at(in, x, pair);
  const int64_t scene = at.record[5];
  const auto state = contact::lag_state(at.record[4], at.corners, at.constants, at.kappa);
  contact::store_lagged_friction(state, by.friction_of(scene), by.damping_of(scene), at.kappa, at.constants.dhat,
                         values + contact::kLagScalars * pair);
  Vec3<T> force[4];
  for (int k = 0; k < 4; ++k) force[k] = state.force * state.w[k] * state.n;
  store_slots(force, {}, slots + kLagSlots * pair);
}

template <class T>
__global__ void rubbing_reverse(const __grid_constant__ ContactInputs<T> in, const contact::LagCoefficients<T> by,
                                const contact::LaggedFrictionBars<T> given, const T* x, int64_t scenes, int64_t pairs,
                                T* slots) {
  const int64_t pair = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x;
  if (pair >= pairs || 4 * pair >= in.listed.ptr[scenes * in.corners]) return;
  const LagPair<T> at(in, x, pair);
  contact::LaggedFrictionAdjoint<T> out;
  given.reverse(by, pair, at.record, at.corners, at.constants, at.kappa, out);
  store_slots(out.pair.x, {out.pair.kappa, out.friction, out.damping}, slots + kLagSlots * pair);
}

// By corner point, with a warp: what its pairs' corners have received, [B, N, 3].
template <class T>
__global__ void lag_collect(const __grid_constant__ ContactInputs<T> in, int64_t scenes, const T* slots, T* out) {
  const int64_t i = static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x, row = i / kSlice;
  if (row >= scenes * in.corners) return;
  const auto lane = static_cast<int>(i % kSlice);
  Vec3<T> sum = zero3<T>();
  for (int e = in.listed.ptr[row] + lane; e < in.listed.ptr[row + 1]; e += kSlice) {
    sum += vector_at(slots + int64_t{4} * in.listed.entry[e]);
  }
  sum_share<kSlice, T>(sum);
  if (lane != 0) return;
  T* to = out + 3 * row;
  to[0] = sum.x, to[1] = sum.y, to[2] = sum.z;
}

// Sums of slots: of corner points, and of three scalars of pairs by scene, of which some may be null.
template <class T>
cudaError_t sum_slots(const ContactInputs<T>& in, int64_t scenes, const T* slots, T* points, const SceneSums<T>& of,
                      cudaStream_t stream) {
  if (auto error = launch_contact(lag_collect<T>, scenes * in.corners * kSlice, stream, in, scenes, slots, points)) {
    return error;
  }
  for (int i = 0; i < 3; ++i) {
    if (!of.out[i]) continue;
    if (auto error = launch_sum(scenes, stream, in, int64_t{0}, slots + 4 * i + 3, 1, kLagSlots, of.out[i])) {
      return error;
    }
  }
  return cudaSuccess;
}

}  // namespace

template <class T>
cudaError_t pair_lag(const ContactInputs<T>& in, const T* x, int64_t scenes, int64_t pairs, T* values,
                     cudaStream_t stream) {
  return launch_contact(lag_forward<T>, pairs, stream, in, x, scenes, pairs, values);
}

template <class T>
cudaError_t pair_lag_backward(const ContactInputs<T>& in, const T* x, int64_t scenes, int64_t pairs, const T* bar,
                              T* slots, T* points, T* kappa, cudaStream_t stream) {
  if (auto error = launch_contact(lag_reverse<T>, pairs, stream, in, x, scenes, pairs, bar, slots)) return error;
  return sum_slots(in, scenes, slots, points, {kappa}, stream);
}

template <class T>
cudaError_t rubbing(const ContactInputs<T>& in, const contact::LagCoefficients<T>& by, const T* x, int64_t scenes,
                    int64_t pairs, T* values, T* slots, T* push, cudaStream_t stream) {
  if (auto error = launch_contact(rubbing_forward<T>, pairs, stream, in, by, x, scenes, pairs, values, slots)) {
    return error;
  }
  return sum_slots(in, scenes, slots, push, {}, stream);
}

template <class T>
cudaError_t rubbing_backward(const ContactInputs<T>& in, const contact::LagCoefficients<T>& by,
                             const contact::LaggedFrictionBars<T>& given, const T* x, int64_t scenes, int64_t pairs, T* slots,
                             T* points, T* kappa, T* friction, T* damping, cudaStream_t stream) {
  if (auto error = launch_contact(rubbing_reverse<T>, pairs, stream, in, by, given, x, scenes, pairs, slots)) {
    return error;
  }
  return sum_slots(in, scenes, slots, points, {kappa, friction, damping}, stream);
}

}  // namespace diffvbd::cuda

#define DIFFVBD_INSTANTIATE_LAG(T)                                                                                \
  template cudaError_t diffvbd::cuda::pair_lag<T>(const diffvbd::contact::ContactInputs<T>&, const T*, int64_t,   \
                                                  int64_t, T*, cudaStream_t);                                     \
  template cudaError_t diffvbd::cuda::pair_lag_backward<T>(const diffvbd::contact::ContactInputs<T>&, const T*,   \
                                                           int64_t, int64_t, const T*, T*, T*, T*, cudaStream_t); \
  template cudaError_t diffvbd::cuda::rubbing<T>(const diffvbd::contact::ContactInputs<T>&,                       \
                                                 const diffvbd::contact::LagCoefficients<T>&, const T*, int64_t,  \
                                                 int64_t, T*, T*, T*, cudaStream_t);                              \
  template cudaError_t diffvbd::cuda::rubbing_backward<T>(                                                        \
      const diffvbd::contact::ContactInputs<T>&, const diffvbd::contact::LagCoefficients<T>&,                     \
      const diffvbd::contact::LaggedFrictionBars<T>&, const T*, int64_t, int64_t, T*, T*, T*, T*, T*, cudaStream_t);
