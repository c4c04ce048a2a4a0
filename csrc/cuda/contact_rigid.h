// The rigid correction of bodies that touch (contact/rigid.h), on the device.
#pragma once

#include <cuda_runtime_api.h>

#include "../contact/rigid_reverse.h"
#include "../contact/rigid_tries.h"

namespace diffvbd::cuda {

// Rows that the lists of a correction have room for.
struct PairRoom {
  int64_t listed, lagged;
  DIFFVBD_FN int64_t rows() const { return listed + lagged; }
};

// Bytes that each works in.
template <class T>
int64_t rigid_system_bytes(const contact::RigidInputs<T>& in, const PairRoom& room);
template <class T>
int64_t rigid_move_bytes(const contact::RigidInputs<T>& in, const PairRoom& room);

// As cpu/contact_rigid.h.
template <class T>
cudaError_t rigid_system(const contact::RigidInputs<T>& in, const PairRoom& room, double* center, double* motion,
                         double* factor, int32_t* groups, void* workspace, cudaStream_t stream);
template <class T>
cudaError_t rigid_move(const contact::RigidInputs<T>& in, const PairRoom& room, const double* center,
                       const double* motion, T* move, const contact::RigidOutcome<T>& out, T* x, void* workspace,
                       cudaStream_t stream);

// pushing: memory of 1 + listed numbers.
template <class T>
cudaError_t rigid_backward(const contact::RigidInputs<T>& in, const contact::VirtualMotions<T>& given,
                           const contact::RigidWork<T>& out, const contact::PointWork<T>& sums, int32_t* pushing,
                           cudaStream_t stream);

// solutions [B, bodies, 6]: memory, too, for what is solved for; x, mass, p, q as of reverse_end() and
// virtual_motion().
template <class T>
cudaError_t rigid_end_backward(const contact::RigidInputs<T>& in, const double* motions, const double* shares,
                               const T* end_bar, const double* factor, double* solutions, T* x, T* mass, T* p, T* q,
                               cudaStream_t stream);
template <class T>
cudaError_t rigid_vertices_backward(const contact::RigidInputs<T>& in, const double* motions, const double* solutions,
                                    const contact::SentBack<T>& sent, const rigid::Adjoints<T>& out, T* floor_lag,
                                    cudaStream_t stream);

}  // namespace diffvbd::cuda
