// The coarse corrections of a step on the CPU (docs/method.md, section 15), between the sweeps of run.cpp.
#pragma once

#include <vector>

#include "../subspace/coarse.h"
#include "kernels.h"
#include "run.h"
#include "threads.h"

namespace diffvbd {

// One scene's corrections. All members of a team call each method; it ends with a barrier.
template <class T>
class CoarseScene {
 public:
  CoarseScene(const Plan& plan, const StepInputs<T>& in, int64_t scene, SceneView<T>& s);

  // The correction of number k: moves s.x, and records what it did.
  void correct(int k, Team::Member& member);
  // Its transpose, from the state after it; `s` has the adjoints of what the sweeps after it have left.
  void reverse(int k, Team::Member& member);
  // After all of them: the adjoint of the matrix.
  void finish(Team::Member& member);

 private:
  T* tape(int k) const { return c_.tape + (scene_ * c_.corrections + k) * c_.tape_size(); }
  // The matrices with the blocks of vertex energies at s.x, factored.
  void add_vertex_blocks(Team::Member& member);
  void solve(T* x, Team::Member& member) const;
  // q of the correction of number k
  T* turn(int k) const { return turns_.get() + (c_.matrix_bar ? k : 0) * int64_t{3} * c_.plan.functions; }
  int32_t body_of(int64_t function) const;
  void prolong(const T* a, T sign, T* to, Team::Member& member);
  void decide(int32_t body, T* a, T* length);
  void flush(Team::Member& member);

  const Plan& plan_;
  const StepInputs<T>& in_;
  const coarse::Inputs<T>& c_;
  const int64_t scene_;
  SceneView<T>& s_;
  const CoarseKernels<T> kernels_;
  std::vector<int> failures_;
  std::vector<char> plain_;  // bodies on whose vertices no energy acts, and whose matrix is factored
  Buffer<T> gradient_, displacement_, wanted_, material_, coarse_, rows_, turns_, matrix_;
  Buffer<double> sums_;
  bool over_ = false;
};

}  // namespace diffvbd
