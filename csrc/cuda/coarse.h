// Coarse corrections (docs/method.md, section 15): what run.cuh launches between sweeps, and the matrices of a step.
#pragma once

#include "../subspace/coarse.h"
#include "../subspace/coarse_matrix.h"
#include "step.h"

namespace diffvbd::cuda {

// Workspace of the inverses.
struct MatrixWork {
  double* states;  // [scenes, groups, kGroupScalars]; only where the matrices are made
  double* matrix;  // [scenes, 9 cells]
  double* panel;   // [scenes, 2, 3 functions, kEdge]
  double* block;   // [scenes, bodies, kEdge, kEdge]
};

// Workspace of the corrections of a chunk of scenes; sizes per scene.
template <class T>
struct CoarseWork {
  T *gradient, *displacement;  // [positions, 4]; the first has the adjoint of every vertex in the reverse
  T* restricted;               // [functions, 3]  P' gradient
  T* solved;                   // [corrections, functions, 3]  reverse: q of each correction
  T* wanted;                   // [positions, 4]  reverse with vertex blocks: full displacement of a correction
  T* inverse;                  // [9 cells]  inverses of the matrices with vertex blocks
  double* vertex_blocks;       // [positions, 6]  Hessian blocks of vertex energies
  MatrixWork matrix;
  double* sums;       // [parts, kDegree]
  int32_t* failures;  // [bodies]  lengths of 0 so far
};

// Corrections of a step for the chunk of scenes of a StepView.
template <class T>
struct Corrections {
  const HostPlan& host;
  const Choice& choice;
  const StepView<T>& s;
  const StepInputs<T>& in;
  CoarseWork<T> w;
  unsigned* barrier;  // of the next cooperative launch: set to zero
  cudaStream_t stream;

  // Correction k: moves s.w.x and records it.
  cudaError_t correct(int k) const;
  // Its transpose. wanted: as of the sweeps.
  cudaError_t reverse(int k, int wanted) const;
  // After all of them: the adjoint of the matrices.
  cudaError_t matrix_bars() const;
  // wanted: kForward for the gradient
  cudaError_t gradients(int wanted) const;
  // With vertex blocks: the inverses at s.w.x.
  cudaError_t invert_with_vertex_blocks() const;
};

template <class T>
using GradientKernel = void (*)(StepView<T>, CoarseWork<T>);
// Gradient of the potential at all vertices, into `gradient`; where adjoints are wanted, the gradient of its product
// with `displacement`.
constexpr int kForward = -1;
// Scalars of shared memory for a warp, no more than for a sweep.
DIFFVBD_FN constexpr int gradient_scalars(int degree, int lanes, bool reverse) {
  return kSlice / threads_of(lanes) * 3 * degree * (reverse ? 2 : 1);
}
template <class T, int wanted>
GradientKernel<T> gradient_kernel_of(int energies, int lanes);

constexpr int kEdge = coarse::kTile;  // of the tiles of a matrix
constexpr int kGroupScalars = 19;     // deformation of a group, its rotation, and 1 where that is determined

// inverse [scenes, 9 cells], or the matrices themselves
template <class T>
cudaError_t coarse_inverse(const coarse::MatrixInputs<T>& in, const MatrixWork& work, T* inverse, bool inverts,
                           cudaStream_t stream);
// Inverses for the scenes from `base` on, with vertex_blocks [scenes, positions, 6] added to the matrices.
template <class T>
cudaError_t inverse_with_vertex_blocks(const coarse::Inputs<T>& c, int64_t base, int64_t scenes, int64_t positions,
                                       const double* vertex_blocks, const MatrixWork& work, T* inverse,
                                       cudaStream_t stream);
// Adjoints of x_prev [scenes, vertices, 3], stiffness (for its own number of scenes) and mass [scenes, cells].
template <class T>
cudaError_t coarse_inverse_vjp(const coarse::MatrixInputs<T>& in, const T* bar, double* states, T* x_bar,
                               T* stiffness_bar, T* mass_bar, cudaStream_t stream);

}  // namespace diffvbd::cuda
