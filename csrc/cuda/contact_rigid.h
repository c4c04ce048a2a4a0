// Rigid correction of bodies that touch (contact/rigid.h).
#pragma once

#include <cuda_runtime_api.h>

#include "../subspace/contact_rigid.h"
#include "../subspace/contact_rigid_reverse.h"

namespace diffvbd::cuda {

// Capacities of the lists of a correction.
struct PairCapacity {
  int64_t listed, lagged;
  DIFFVBD_FN int64_t rows() const { return listed + lagged; }
};

// Bytes of workspace.
template <class T>
int64_t rigid_system_bytes(const contact::RigidInputs<T>& in, const PairCapacity& capacity);
template <class T>
int64_t rigid_move_bytes(const contact::RigidInputs<T>& in, const PairCapacity& capacity);

// As cpu/contact_rigid.h.
template <class T>
cudaError_t rigid_system(const contact::RigidInputs<T>& in, const PairCapacity& capacity, double* center,
                         double* motion, double* factor, int32_t* groups, void* workspace, cudaStream_t stream);
template <class T>
cudaError_t rigid_move(const contact::RigidInputs<T>& in, const PairCapacity& capacity, const double* center,
                       const double* motion, T* move, const contact::RigidOutcome<T>& out, T* x, void* workspace,
                       cudaStream_t stream);

// pushing: workspace of one number and one for each listed pair.
template <class T>
cudaError_t rigid_backward(const contact::RigidInputs<T>& in, const contact::VirtualMotions<T>& given,
                           const contact::RigidWork<T>& out, const contact::PointWork<T>& sums, int32_t* pushing,
                           cudaStream_t stream);

// Adjoint of a correction.
template <class T>
struct RigidReverse {
  const double *motions, *fractions, *factor;
  const T* end_bar;         // [B, V, 3]; may be out.vertices.x
  double* solutions;        // [B, bodies, 6]  workspace, as the rest
  T *p, *q, *displacement;  // as of virtual_motion() and reverse_end()
  contact::RigidWork<T> work;
  contact::PointWork<T> sums;
  int32_t* pushing;  // a number for each scene and for each listed pair
  contact::CorrectionAdjoints<T> out;
};
template <class T>
cudaError_t rigid_contact_backward(const contact::RigidInputs<T>& in, const RigidReverse<T>& r, cudaStream_t stream);
// Its kernels before and after rigid_backward().
template <class T>
cudaError_t rigid_end_backward(const contact::RigidInputs<T>& in, const RigidReverse<T>& r, cudaStream_t stream);
template <class T>
cudaError_t rigid_vertices_backward(const contact::RigidInputs<T>& in, const RigidReverse<T>& r, cudaStream_t stream);

}  // namespace diffvbd::cuda
