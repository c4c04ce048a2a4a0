// Contact on the CPU: the passes of contact/passes.h over the blocks of a color.
#pragma once

#include "kernels.h"
#include "near.h"
#include "threads.h"

namespace diffvbd {

// Contact of one scene in a step.
template <class T>
class ContactScene {
 public:
  // `reverse`: null in the forward. The records of `s` must be allocated.
  ContactScene(const Plan& plan, const contact::ContactInputs<T>& in, const int32_t* position, int64_t scene,
               SceneView<T>& s, T time_step, const contact::ContactAdjoints<T>* reverse);

  // The pairs' part of the blocks [begin, end).
  void assemble(int64_t begin, int64_t end) const;
  // Before and after the updates of the color that is the blocks [first, last): remembers where its vertices were; says
  // where they want to go, so that search() finds what comes near; and takes back what planes do not let pass of their
  // motion; limits [V] receives the exponents.
  void remember(int64_t begin, int64_t end) const;
  void propose(int64_t first, int64_t last, int64_t begin, int64_t end, uint8_t* limits) const;
  void search(int64_t begin, int64_t end) const;
  void limit(int64_t first, int64_t last, int64_t begin, int64_t end, uint8_t* limits) const;
  // After the first sweep, which goes farthest: near pairs by the displacements that are left.
  void settle(Team::Member& member) const;
  // Reverse, before a color's turn: its vertices go back to the positions before their update, which the tape of `rows`
  // scalars for each vertex has, and gather what pairs have scattered to them since their last turn.
  void prepare(int sweep, int64_t rows, int64_t begin, int64_t end, const uint8_t* limits) const;
  // Reverse, after the turn: the adjoint of assemble().
  void reverse(int64_t begin, int64_t end) const;
  // After the last turn: what is left for vertices, into the rows of x_bar, and for colliders [Vc, 3].
  void finish(T* collider_bar) const;

 private:
  struct Positions {
    const T* rows;
    const int32_t* position;
    const PairRows<T>* colors;
    Vec3<T> operator()(int v) const { return vector_at(rows + int64_t{4} * position[v]); }
    bool together(int v, int u) const { return colors->are_together(v, u); }
  };
  // Positions before the updates of a color.
  struct Before {
    const T *rows, *before;
    const int32_t* position;
    int64_t first, last;  // of the color
    bool goes(int v) const { return first <= position[v] && position[v] < last; }
    Vec3<T> operator()(int v) const { return vector_at((goes(v) ? before : rows) + int64_t{4} * position[v]); }
  };
  template <class F>
  void each_vertex(int64_t begin, int64_t end, const F& f) const;
  template <class F>
  void each_pair(int32_t v, const F& look) const;
  int limit_by_near(const contact::Source<T, Before>& source, int32_t v, const Vec3<T>& d, int exponent) const;
  T* record(int64_t block, int lane, int scalar) const;
  T kappa() const { return in_.kappa.data[scene_ * in_.kappa.scene]; }

  const Plan& plan_;
  const contact::ContactInputs<T>& given_;
  contact::ContactInputs<T> in_;  // the same with what is near
  const contact::ContactAdjoints<T>* reverse_;
  const int64_t scene_;
  SceneView<T>& s_;
  const T h_;
  const PairKernels<T> kernels_;
  const Buffer<T> before_;  // [blocks kLanes, 4]  where the vertices of a color were before it moved
  const Positions positions_;
  const PairRows<T> rows_;
  mutable NearPairs<T> near_;
  const contact::Source<T, Positions> source_;
};

}  // namespace diffvbd
