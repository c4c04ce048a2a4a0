#include <torch/csrc/stable/ops.h>

#include "../contact/rigid_backward.h"
#include "contact_rigid.h"

namespace diffvbd {

using namespace contact;

template <class T>
void rigid_backward(const RigidInputs<T>& in, const VirtualMotions<T>& given, const RigidWork<T>& out,
                    const PointWork<T>& sums) {
  torch::stable::parallel_for(0, out.listed, 64, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      const BarrierWork<T> work(in, given, i);
      out.pushes[i] = work.acts;
      for (int part = 0; work.acts && part < kWorkParts; ++part) {
        work.store(part, out.barrier + 4 * kWorkScalars * i, out.by_kappa + i);
      }
    }
  });
  torch::stable::parallel_for(0, out.lagged, 64, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      const LaggedWork<T> work(in, given, i);
      T *rows = out.friction + 4 * kWorkScalars * i, *lag_bar = out.lag_bar + kLagScalars * i;
      work.acts ? work.store(rows, lag_bar) : work.store_none(rows);
    }
  });
  torch::stable::parallel_for(0, in.scene.scenes * in.gate.corners, 256, [&](int64_t begin, int64_t end) {
    for (int64_t point = begin; point < end; ++point) {
      double sum[kPointScalars] = {};
      add_at_point(in, out, point, 0, 1, sum);
      store_at_point(sum, point, sums);
    }
  });
}

#define DIFFVBD_INSTANTIATE(T)                                                                          \
  template void rigid_backward<T>(const RigidInputs<T>&, const VirtualMotions<T>&, const RigidWork<T>&, \
                                  const PointWork<T>&);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd
