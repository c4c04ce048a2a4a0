#include "../contact/rigid_reverse.h"
#include "bodies.h"
#include "contact_rigid.h"

namespace diffvbd {

using namespace contact;
using rigid::Body;

template <class T>
void rigid_end_backward(const RigidInputs<T>& in, const double* motions, const double* shares, const T* end_bar,
                        double* motion_bar, T* x, T* mass) {
  for_bodies(in.scene, [&](const Body<T>& b, const Threads& team) {
    const int64_t place = b.scene * in.bodies() + b.body;
    reverse_end(b, team, motions + kUnknowns * place, shares[place], end_bar, motion_bar + kUnknowns * place, x, mass);
  });
}

template <class T>
void rigid_virtual_motions(const RigidInputs<T>& in, const double* motions, double* solutions, T* p, T* q) {
  for_bodies(in.scene, [&](const Body<T>& b, const Threads& team) {
    const int64_t at = kUnknowns * (b.scene * in.bodies() + b.body);
    virtual_motion(in, b, team, motions + at, solutions + at, p, q);
  });
}

template <class T>
void rigid_vertices_backward(const RigidInputs<T>& in, const double* motions, const double* solutions, const T* way,
                             const PointWork<T>& sent, const CorrectionAdjoints<T>& out) {
  for_bodies(in.scene, [&](const Body<T>& b, const Threads& team) {
    const int64_t at = kUnknowns * (b.scene * in.bodies() + b.body);
    reverse_vertices(in, b, team, motions + at, solutions + at, way, sent, out);
  });
  for (int64_t s = 0; s < in.scene.scenes; ++s) {
    for (int32_t j = 0; j < in.gate.corners - in.gate.vertices; ++j) reverse_collider(in, s, j, sent, out);
  }
}

#define DIFFVBD_INSTANTIATE(T)                                                                                         \
  template void rigid_end_backward<T>(const RigidInputs<T>&, const double*, const double*, const T*, double*, T*, T*); \
  template void rigid_virtual_motions<T>(const RigidInputs<T>&, const double*, double*, T*, T*);                       \
  template void rigid_vertices_backward<T>(const RigidInputs<T>&, const double*, const double*, const T*,              \
                                           const PointWork<T>&, const CorrectionAdjoints<T>&);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd
