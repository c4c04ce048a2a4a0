// What pairs press in a rigid correction, for whoever adds it up: barriers as they were stored, friction as bodies go;
// and how Newton's method goes on.
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

// Where Newton's method is with a system: on its way, at the motion it has settled at but not with the matrix there,
// and done.
enum Settling : uint8_t { kOnItsWay, kSettledAt, kDone };

// The share of a step that is taken. fall, whole: twice what the step and the motion after it are worth in potential.
template <class Share>
__device__ double settle(Settling& state, bool rubs, double fall, double whole, const Share& share) {
  if (!rubs || state == kSettledAt) {
    state = kDone;
    return 1;
  }
  if (fall <= kSettled * kSettled * whole) {
    state = kSettledAt;
    return 1;
  }
  return share(fall);
}

}  // namespace
}  // namespace diffvbd::cuda
