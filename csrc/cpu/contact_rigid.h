// The rigid correction of bodies that touch (contact/rigid.h), on the CPU.
#pragma once

#include <vector>

#include "../subspace/contact_rigid.h"
#include "../subspace/contact_rigid_reverse.h"

namespace diffvbd {

inline rigid::Vector vector_of(const double* a) { return {a[0], a[1], a[2]}; }

// The Newton systems of each scene, their factors and solutions: center of mass [B, bodies, 3], motion [B, bodies, 6]
// and factor [B, RigidInputs::matrix_size()] over a turn and a shift of each body. groups: those of `in`, to be
// written, or null.
template <class T>
void rigid_system(const contact::RigidInputs<T>& in, double* center, double* motion, double* factor, int32_t* groups);
// Calls f(a, b) for the bodies that pairs of a scene press or rub.
template <class T, class F>
void each_touching(const contact::RigidInputs<T>& in, int64_t scene, const std::vector<contact::PairPress>& presses,
                   const F& f) {
  const auto touch = [&](int32_t a, int32_t b) {
    if (0 <= a && 0 <= b && a != b) f(a, b);
  };
  for (const contact::PairPress& press : presses) touch(press.body[0], press.body[1]);
  for (int64_t i = in.first_lagged(scene); i < in.first_lagged(scene + 1); ++i) {
    if (!contact::Lag<T>(in.lag + contact::kLagScalars * i).active()) continue;
    const int32_t* record = in.lagged.pairs + contact::kPairRow * i;
    touch(contact::moving_body(in, record[0]), contact::moving_body(in, record[contact::sides(record[4])]));
  }
}

// The groups of a scene, by what presses its bodies; rows [4, bodies].
template <class T>
void find_groups(const contact::RigidInputs<T>& in, int64_t scene, const std::vector<contact::PairPress>& presses,
                 int32_t* rows);
// x [B, bodies, 6] = factor^-T factor^-1 x
template <class T>
void rigid_solve(const contact::RigidInputs<T>& in, const double* factor, double* x);

// What comes of the motion [B, bodies, 6] of each body, so that nothing crosses and the potential of no scene rises;
// and where that leads, x [B, V, 3]. move [B, V, 3] is that of `in`, to be written.
template <class T>
void rigid_move(const contact::RigidInputs<T>& in, const double* center, const double* motion, T* move,
                const contact::RigidOutcome<T>& out, T* x);

// The derivatives that the adjoint needs of pairs, and their sums.
template <class T>
void rigid_backward(const contact::RigidInputs<T>& in, const contact::VirtualMotions<T>& given,
                    const contact::RigidWork<T>& out, const contact::PointWork<T>& sums);

// The parts of the adjoint of a correction for all bodies (contact/rigid_reverse.h).
template <class T>
void rigid_end_backward(const contact::RigidInputs<T>& in, const double* motions, const double* shares,
                        const T* end_bar, double* motion_bar, T* x, T* mass);
template <class T>
void rigid_virtual_motions(const contact::RigidInputs<T>& in, const double* motions, double* solutions, T* p, T* q);
template <class T>
void rigid_vertices_backward(const contact::RigidInputs<T>& in, const double* motions, const double* solutions,
                             const T* way, const contact::PointWork<T>& sent,
                             const contact::CorrectionAdjoints<T>& out);

}  // namespace diffvbd
