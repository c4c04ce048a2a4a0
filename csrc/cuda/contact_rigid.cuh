// What the kernels of the rigid correction of bodies that touch share.
#pragma once

#include "bodies.cuh"
#include "contact_rigid.h"

namespace diffvbd::cuda {

using namespace contact;
using rigid::Body;

constexpr int kFew = 3;    // bodies that are solved for together, up to which one block is fastest
constexpr int kOne = 128;  // threads of a block where each has an item of its own

inline unsigned blocks_for(int64_t items) { return static_cast<unsigned>((items + kOne - 1) / kOne); }
__device__ __forceinline__ int64_t own_item() { return static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x; }
__device__ __forceinline__ Vector vector_of(const double* a) { return {a[0], a[1], a[2]}; }

// Bytes of a part of a workspace, rounded up to what any type needs.
constexpr int64_t aligned(int64_t bytes) { return (bytes + 15) / 16 * 16; }

// Where Newton's method is with a system: on its way, at the motion it has settled at but not with the matrix there,
// and done. What is done is left alone: to find out on the host would mean to wait, which a capture cannot.
enum Settling : uint8_t { kOnItsWay, kSettledAt, kDone };
__device__ __forceinline__ bool is_done(const uint8_t* state, int64_t system) {
  return state && state[system] == kDone;
}

// Of a scene, what `slid` has of all.
__device__ __forceinline__ Slid of_scene(const Slid& slid, int64_t scene, int64_t bodies) {
  if (!slid.motion) return slid;
  return {slid.center + 3 * scene * bodies, slid.motion + kUnknowns * scene * bodies};
}

// What the pairs of all scenes press: bodies [rows, 2], -1 where nothing moves, and the rest, unless null. The listed
// come first.
template <class T>
__global__ void __launch_bounds__(kOne) press_kernel(const __grid_constant__ RigidInputs<T> in, PairRoom room,
                                                     Slid slid, const uint8_t* state, int32_t* sides, double* press) {
  const int64_t row = own_item();
  if (row >= room.listed + room.lagged) return;
  if (slid.motion && row < room.listed) return;  // barriers press as before
  const CornerPoints<T> at{in, false};
  PairPress a;
  a.body[0] = a.body[1] = -1;
  bool acts = false;
  if (row < room.listed) {
    acts = row < in.first_listed(in.scene.scenes) && barrier_press(in, row, at, a);
  } else {
    const int64_t pair = row - room.listed;
    if (pair < in.first_lagged(in.scene.scenes)) {
      const int64_t scene = in.lagged.pairs[kPairRow * pair + 5];
      if (is_done(state, scene)) return;
      acts = lagged_press(in, pair, at, of_scene(slid, scene, in.bodies()), a, -1);
    }
  }
  sides[2 * row] = acts ? a.body[0] : -1;
  sides[2 * row + 1] = acts ? a.body[1] : -1;
  if (acts && press) store_press(a, press + kPressDoubles * row);
}

// The side that a body has of an entry's pair, which acts, at the first corner of that side; or -1. bodies: of the
// sides of the list, as press_kernel() has them.
__device__ __forceinline__ int side_of(const PairList& list, const int32_t* bodies, int32_t entry, int32_t body) {
  const int corner = entry & 3;
  const int64_t pair = entry >> 2;
  if (corner == 3) return -1;
  const int side = corner == 0 ? 0 : 1;
  if (bodies[2 * pair + side] != body) return -1;
  return side == 0 || corner == sides(list.pairs[kPairRow * pair + 4]) ? side : -1;
}

// Motions of bodies and factors of systems, where none is larger than kFew bodies. sides and presses as of
// press_kernel().
template <class T>
cudaError_t solve_few(const RigidInputs<T>& in, const PairRoom& room, const int32_t* sides, const double* presses,
                      double* center, double* motion, double* factor, cudaStream_t stream);

}  // namespace diffvbd::cuda
