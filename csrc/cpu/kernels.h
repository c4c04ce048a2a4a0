// The two hot loops of the CPU backend, chosen by a scene's energies and by what the processor can do.
#pragma once

#include "contact_kernels.h"
#include "scene.h"

namespace diffvbd {

// One color (blocks [begin, end)) of one sweep; `tape` is the policy.
template <class T>
using SweepKernel = void (*)(const Plan&, const SceneView<T>&, const StepParameters<T>&, int sweep, int tape,
                             int64_t begin, int64_t end);

template <class T>
SweepKernel<T> forward_kernel(int energies);
template <class T>
SweepKernel<T> reverse_kernel(int energies);

// The loops of coarse corrections (coarse.h): the gradient of the blocks [begin, end), and its transpose.
template <class T>
using GradientKernel = void (*)(const Plan&, const SceneView<T>&, const StepParameters<T>&, int64_t begin, int64_t end);
template <class T>
struct CoarseKernels {
  GradientKernel<T> gradient, reverse;
  // to[row] = sum of weight[e] from[of[e]] for e of the rows [begin, end); rows of four scalars
  void (*gather)(const int32_t* ptr, const int32_t* of, const T* weight, const T* from, T* to, int64_t begin,
                 int64_t end);
  // to [3, 3, n] := r k r^T of n blocks, whose entries are a plane apart
  void (*rotate)(const T* k, int64_t plane, const T* r, int64_t n, T* to);
  // From a positive definite matrix n x n, small or with n a multiple of kLanes, to L with L L^T = matrix, in its
  // place; above the diagonal anything. panel: n x kLanes to work with
  void (*factor)(int64_t n, T* panel, T* factor);
  // rows [begin, end) of n x n: to := -sum over i < count of q_i a_i^T, one after another in q and a, a stride apart
  void (*outer)(const T* q, int64_t q_stride, const T* a, int64_t a_stride, int count, int64_t n, int64_t begin,
                int64_t end, T* to);
  // x := (L L^T)^-1 x
  void (*solve)(const T* factor, int64_t n, T* x);
  // adds the coefficients of the tets' potential along `displacement`, blocks [begin, end) of the coarse plan
  void (*line)(const int32_t* corner, const T* rest, const T* material, const T* x, const T* displacement,
               int64_t begin, int64_t end, double* coefficients);
};
template <class T>
CoarseKernels<T> coarse_kernels(int energies);
template <class T>
PairKernels<T> pair_kernels();
OverlapKernel overlap_kernel();

// The loops of one instruction set: each is compiled by itself (setup.py).
template <class T>
struct Kernels {
  SweepKernel<T> (*forward)(int energies), (*reverse)(int energies);
  CoarseKernels<T> (*coarse)(int energies);
  PairKernels<T> pairs;
  OverlapKernel meet;
};
namespace baseline {
template <class T>
Kernels<T> sweep_kernels();
}
#ifdef DIFFVBD_HAS_SETS
namespace v3 {
template <class T>
Kernels<T> sweep_kernels();
}
namespace v4 {
template <class T>
Kernels<T> sweep_kernels();
}
#endif

}  // namespace diffvbd
