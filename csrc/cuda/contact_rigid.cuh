// What the kernels of the rigid correction of bodies that touch share.
#pragma once

#include "bodies.cuh"
#include "contact_rigid.h"

namespace diffvbd::cuda {

using namespace contact;
using rigid::Body;

constexpr int kOne = 128;  // threads of a block where each has an item of its own

inline unsigned blocks_for(int64_t items) { return static_cast<unsigned>((items + kOne - 1) / kOne); }
__device__ __forceinline__ int64_t own_item() { return static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x; }
__device__ __forceinline__ Vector vector_of(const double* a) { return {a[0], a[1], a[2]}; }

// Bytes of a part of a workspace, rounded up to what any type needs.
constexpr int64_t aligned(int64_t bytes) { return (bytes + 15) / 16 * 16; }

// Scalars of a lagged pair in the memory of a correction: a LaggedFriction, the slip, and of a PairForce what is not zero.
enum RubScalar : int {
  kNormal = 0,
  kSlipBefore = 3,
  kLoad = 6,
  kDamping,
  kApproach,
  kSlip,
  kAt = 12,
  kWeight = 18,
  kForce = 20,
  kStiffness = 23,
  kRubScalars = 29
};
// Memory of a correction. Of rows the listed pairs are the first, then the lagged.
struct GroupMemory {
  int32_t* sides;         // [rows, 2]: bodies, -1 where nothing moves
  double *press, *steps;  // [listed, kForceDoubles], [B, bodies, 6]
  double* rubbing;        // [kRubScalars, lagged]: threads next to each other read pairs that are
  double* bases;          // as the factors
  // twice the row of a pair that acts, and the side that a body has of it, for all bodies of a group in a row: those of
  // listed pairs, then those of lagged
  int32_t *found, *rows;                      // [2 rows] twice: as they come, and in order
  int32_t *counts, *filled, *begins, *taken;  // [B, bodies, 2] twice, [B, bodies], one number
  int32_t* floors;                            // [B, V, planes]: where the vertices of bodies are borne, body after body
};

// Whether a list has a row: most have room for many more, whose memory nobody reads.
template <class T>
__device__ bool is_row(const RigidInputs<T>& in, const PairRoom& room, int64_t row) {
  return row < room.listed ? row < in.first_listed(in.scene.scenes)
                           : row - room.listed < in.first_lagged(in.scene.scenes) && row < room.rows();
}

// Motions of bodies and factors of groups: of those with up to kFew bodies, and of larger ones, which are put into the
// order of their elimination first. lists: whether scenes are one group each, whose rows are yet to be listed.
template <class T>
cudaError_t solve_few(const RigidInputs<T>& in, const PairRoom& room, const GroupMemory& memory, bool lists,
                      double* center, double* motion, double* factors, cudaStream_t stream);
template <class T>
cudaError_t solve_groups_of_many(const RigidInputs<T>& in, const PairRoom& room, const GroupMemory& memory,
                                 int32_t* ordered, double* center, double* motion, double* factors,
                                 cudaStream_t stream);

// The groups of scenes of many bodies [B, 4, bodies], by sides as of GroupMemory; and x = factor^-T factor^-1 x.
int64_t groups_bytes(int64_t scenes, int64_t bodies);
template <class T>
cudaError_t find_groups(const RigidInputs<T>& in, const PairRoom& room, const int32_t* sides, int32_t* groups,
                        void* workspace, cudaStream_t stream);
template <class T>
cudaError_t solve_groups(const RigidInputs<T>& in, const double* factor, double* x, cudaStream_t stream);

}  // namespace diffvbd::cuda
