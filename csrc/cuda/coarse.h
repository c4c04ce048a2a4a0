// Coarse corrections on the device (docs/method.md, section 15): what run.cuh launches between sweeps, and the matrices
// of a step. No torch here.
#pragma once

#include "../subspace/coarse.h"
#include "../subspace/coarse_matrix.h"
#include "step.h"

namespace diffvbd::cuda {

// What the inverses are made in.
struct MatrixWork {
  double* turn;    // [scenes, groups, kTurn]; only where the matrices are made
  double* matrix;  // [scenes, 9 cells]
  double* panel;   // [scenes, 2, 3 functions, kEdge]
  double* block;   // [scenes, bodies, kEdge, kEdge]
};

// Where the corrections of a chunk of scenes work; per scene.
template <class T>
struct CoarseWork {
  T *gradient, *way;  // [positions, 4]; the first has the adjoint of every vertex in the reverse
  T* restricted;      // [functions, 3]  P' gradient
  T* solved;          // [corrections, functions, 3]  of the reverse: q of each correction
  T* wanted;          // [positions, 4]  of the reverse, if pressed: how a correction wanted to move the vertices
  T* inverse;         // [9 cells]  if pressed: of the matrices with the blocks of vertex energies
  double* press;      // [positions, 6]  these blocks
  MatrixWork matrix;
  double* sums;       // [parts, kDegree]
  int32_t* failures;  // [bodies]  lengths of 0 so far
};

// The corrections of a step, of the chunk of scenes that a StepView is of.
template <class T>
struct Corrections {
  const HostPlan& host;
  const Choice& choice;
  const StepView<T>& s;
  const StepInputs<T>& in;
  CoarseWork<T> w;
  unsigned* barrier;  // of the next cooperative launch: set to zero
  cudaStream_t stream;

  // The correction of number k: moves s.w.x and records what it did.
  cudaError_t correct(int k) const;
  // Its transpose. wanted: as of the sweeps.
  cudaError_t reverse(int k, int wanted) const;
  // After all of them: the adjoint of the matrices.
  cudaError_t matrix_bars() const;
  // wanted: kForward for the gradient
  cudaError_t gradients(int wanted) const;
  // If pressed: the inverses at s.w.x.
  cudaError_t press() const;
};

template <class T>
using GradientKernel = void (*)(StepView<T>, CoarseWork<T>);
// The gradient of the potential at all vertices, into `gradient`; or, where adjoints are wanted, that of its product
// with `way`.
constexpr int kForward = -1;
// scalars of shared memory that a warp needs for it: no more than for a sweep
DIFFVBD_FN constexpr int gradient_scalars(int degree, int lanes, bool reverse) {
  return kSlice / threads_of(lanes) * 3 * degree * (reverse ? 2 : 1);
}
template <class T, int wanted>
GradientKernel<T> gradient_kernel_of(int energies, int lanes);

constexpr int kEdge = coarse::kTile;  // of the tiles of a matrix
constexpr int kTurn = 19;             // deformation of a group, its rotation, and 1 where that is determined

// inverse [scenes, 9 cells], or the matrices themselves
template <class T>
cudaError_t coarse_inverse(const coarse::MatrixInputs<T>& in, const MatrixWork& work, T* inverse, bool inverts,
                           cudaStream_t stream);
// Of the matrices of scenes from `base` on with what presses [scenes, positions, 6].
template <class T>
cudaError_t pressed_inverse(const coarse::Inputs<T>& c, int64_t base, int64_t scenes, int64_t positions,
                            const double* press, const MatrixWork& work, T* inverse, cudaStream_t stream);
// Adjoints of x_prev [scenes, vertices, 3], stiffness (of as many scenes as there are) and mass [scenes, cells]
template <class T>
cudaError_t coarse_inverse_vjp(const coarse::MatrixInputs<T>& in, const T* bar, double* turn, T* x_bar,
                               T* stiffness_bar, T* mass_bar, cudaStream_t stream);

}  // namespace diffvbd::cuda
