// The adjoint of the rigid correction of bodies that touch, on the CPU.
#include "contact_rigid.h"
#include "threads.h"

namespace diffvbd {

using namespace contact;
using rigid::Body;

template <class T>
void rigid_backward(const RigidInputs<T>& in, const VirtualMotions<T>& given, const RigidWork<T>& out,
                    const PointWork<T>& sums) {
  const auto listed = [&](int64_t i) {
    const BarrierWork<T> work(in, given, i);
    out.pushes[i] = work.acts;
    for (int part = 0; work.acts && part < kWorkParts; ++part) {
      work.store(part, out.barrier + 4 * kWorkScalars * i, out.by_kappa + i);
    }
  };
  const auto lagged = [&](int64_t i) {
    const LaggedWork<T> work(in, given, i);
    T *rows = out.friction + 4 * kWorkScalars * i, *lag_bar = out.lag_bar + kLagScalars * i;
    work.acts ? work.store(rows, lag_bar) : work.store_none(rows);
  };
  const auto at_point = [&](int64_t point) {
    double sum[kPointScalars] = {};
    add_at_point(in, out, point, 0, 1, sum);
    store_at_point(sum, point, sums);
  };
  for_each(out.listed, listed, 64);
  for_each(out.lagged, lagged, 64);
  for_each(in.scene.scenes * in.gate.corners, at_point, 256);
}

template <class T>
void rigid_end_backward(const RigidInputs<T>& in, const double* motions, const double* fractions, const T* end_bar,
                        double* motion_bar, T* x, T* mass) {
  for_bodies(in.scene, [&](const Body<T>& b, const Threads& team) {
    const int64_t place = b.scene * in.bodies() + b.body;
    reverse_end(b, team, motions + kUnknowns * place, fractions[place], end_bar, motion_bar + kUnknowns * place, x,
                mass);
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
void rigid_vertices_backward(const RigidInputs<T>& in, const double* motions, const double* solutions,
                             const T* displacement, const PointWork<T>& scattered, const CorrectionAdjoints<T>& out) {
  for_bodies(in.scene, [&](const Body<T>& b, const Threads& team) {
    const int64_t at = kUnknowns * (b.scene * in.bodies() + b.body);
    reverse_vertices(in, b, team, motions + at, solutions + at, displacement, scattered, out);
  });
  for (int64_t s = 0; s < in.scene.scenes; ++s) {
    for (int32_t j = 0; j < in.gate.corners - in.gate.vertices; ++j) reverse_collider(in, s, j, scattered, out);
  }
}

#define DIFFVBD_INSTANTIATE(T)                                                                                         \
  template void rigid_backward<T>(const RigidInputs<T>&, const VirtualMotions<T>&, const RigidWork<T>&,                \
                                  const PointWork<T>&);                                                                \
  template void rigid_end_backward<T>(const RigidInputs<T>&, const double*, const double*, const T*, double*, T*, T*); \
  template void rigid_virtual_motions<T>(const RigidInputs<T>&, const double*, double*, T*, T*);                       \
  template void rigid_vertices_backward<T>(const RigidInputs<T>&, const double*, const double*, const T*,              \
                                           const PointWork<T>&, const CorrectionAdjoints<T>&);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)

}  // namespace diffvbd
