// The rigid correction of bodies that touch (subspace/contact_rigid.h), on the CPU.
#pragma once

#include "../subspace/contact_rigid.h"
#include "../subspace/contact_rigid_reverse.h"

namespace diffvbd {

// The Newton systems of each scene, their factors and solutions: center of mass [B, bodies, 3], motion [B, bodies, 6]
// and factor [B, RigidInputs::matrix_size()] over a turn and a shift of each body. groups: those of `in`, to be
// written, or null.
template <class T>
void rigid_system(const contact::RigidInputs<T>& in, double* center, double* motion, double* factor, int32_t* groups);
// x [B, bodies, 6] = factor^-T factor^-1 x
template <class T>
void rigid_solve(const contact::RigidInputs<T>& in, const double* factor, double* x);

// Trial fractions of the motion [B, bodies, 6] of each body: nothing crosses and the potential of no scene increases;
// and where that leads, x [B, V, 3]. move [B, V, 3] is that of `in`, to be written.
template <class T>
void rigid_move(const contact::RigidInputs<T>& in, const double* center, const double* motion, T* move,
                const contact::RigidOutcome<T>& out, T* x);

// The derivatives that the adjoint needs of pairs, and their sums.
template <class T>
void rigid_backward(const contact::RigidInputs<T>& in, const contact::VirtualMotions<T>& given,
                    const contact::RigidWork<T>& out, const contact::PointWork<T>& sums);

// The parts of the adjoint of a correction for all bodies (subspace/contact_rigid_reverse.h).
template <class T>
void rigid_end_backward(const contact::RigidInputs<T>& in, const double* motions, const double* fractions,
                        const T* end_bar, double* motion_bar, T* x, T* mass);
template <class T>
void rigid_virtual_motions(const contact::RigidInputs<T>& in, const double* motions, double* solutions, T* p, T* q);
template <class T>
void rigid_vertices_backward(const contact::RigidInputs<T>& in, const double* motions, const double* solutions,
                             const T* displacement, const contact::PointWork<T>& scattered,
                             const contact::CorrectionAdjoints<T>& out);

}  // namespace diffvbd
