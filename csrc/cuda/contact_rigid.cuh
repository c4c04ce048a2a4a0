// Shared definitions of the kernels of the rigid correction of bodies that touch.
#pragma once

#include "bodies.cuh"
#include "contact_rigid.h"

namespace diffvbd::cuda {

using namespace contact;
using rigid::Body;

constexpr int kOne = 128;  // threads of a block with one item each

__device__ __forceinline__ Vector vector_of(const double* a) { return {a[0], a[1], a[2]}; }

// Scalars of a lagged pair in memory: its load, its tangential motion, and the nonzero parts of its force.
enum FrictionScalar : int {
  kNormal = 0,
  kTangentialBefore = 3,
  kLoad = 6,
  kDamping,
  kApproach,
  kTangential,
  kAt = 12,
  kWeight = 18,
  kForce = 20,
  kStiffness = 23,
  kFrictionScalars = 29
};
// Memory of a correction. Rows: first the listed pairs, then the lagged ones.
struct GroupMemory {
  int32_t* sides;          // [rows, 2]: bodies, -1 where nothing moves
  double *forces, *steps;  // [listed, kForceDoubles], [B, bodies, 6]
  double* friction;        // [kFrictionScalars, lagged]: neighbouring threads read neighbouring pairs
  double* bases;           // like the factors
  // Twice the row of a pair that acts plus the side of the body, for all bodies of a group in a row: first listed
  // pairs, then lagged ones.
  int32_t *found, *rows;                      // [2 rows] each: unordered, ordered
  int32_t *counts, *filled, *begins, *taken;  // [B, bodies, 2] each, [B, bodies], one number
  int32_t* floors;                            // [B, V, planes]: contacts with planes, body after body
};

// Whether a list has a row; capacities are larger than lists.
template <class T>
__device__ bool is_row(const RigidInputs<T>& in, const PairCapacity& capacity, int64_t row) {
  return row < capacity.listed ? row < in.first_listed(in.scene.scenes)
                               : row - capacity.listed < in.first_lagged(in.scene.scenes) && row < capacity.rows();
}

// Motions of bodies and factors of groups of up to kFew bodies, and of larger groups, which are ordered for elimination
// first. lists: scenes are one group each, whose rows are not listed yet.
template <class T>
cudaError_t solve_few(const RigidInputs<T>& in, const PairCapacity& capacity, const GroupMemory& memory, bool lists,
                      double* center, double* motion, double* factors, cudaStream_t stream);
template <class T>
cudaError_t solve_groups_of_many(const RigidInputs<T>& in, const PairCapacity& capacity, const GroupMemory& memory,
                                 int32_t* ordered, double* center, double* motion, double* factors,
                                 cudaStream_t stream);

// Groups of scenes with many bodies [B, 4, bodies], from the sides of GroupMemory; and x = factor^-T factor^-1 x.
int64_t groups_bytes(int64_t scenes, int64_t bodies);
template <class T>
cudaError_t find_groups(const RigidInputs<T>& in, const PairCapacity& capacity, const int32_t* sides, int32_t* groups,
                        void* workspace, cudaStream_t stream);
template <class T>
cudaError_t solve_groups(const RigidInputs<T>& in, const double* factor, double* x, cudaStream_t stream);

}  // namespace diffvbd::cuda
