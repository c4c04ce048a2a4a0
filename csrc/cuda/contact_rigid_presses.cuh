// What pairs press in a rigid correction, for whoever adds it up: barriers as they were stored, friction as bodies go.
#pragma once

#include "../contact/rigid_slip.h"
#include "contact_rigid.cuh"

namespace diffvbd::cuda {
namespace {

// A list of pairs, and where the sides of its first one are.
struct Sides {
  const PairList& list;
  const int32_t* bodies;
};

// The barriers of listed pairs.
template <class T>
struct Barriers {
  const RigidInputs<T>& in;
  const int32_t* sides;
  const double* presses;
  __device__ Sides pairs() const { return {in.gate.listed, sides}; }
  __device__ PairPress operator()(int64_t pair, int) const {
    return load_press(presses + kPressDoubles * pair, sides + 2 * pair);
  }
};
// Friction and damping of lagged ones, for a side that may be solved for alone.
template <class T>
struct Rubs {
  const RigidInputs<T>& in;
  const int32_t* sides;
  Slid slid;
  __device__ Sides pairs() const { return {in.lagged, sides}; }
  __device__ PairPress operator()(int64_t pair, int side) const {
    PairPress a;
    lagged_press(in, pair, CornerPoints<T>{in, false}, slid, a, side);
    return a;
  }
};

}  // namespace
}  // namespace diffvbd::cuda
