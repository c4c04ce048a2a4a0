#include <torch/csrc/stable/ops.h>

#include "../contact/rigid_backward.h"
#include "contact_rigid.h"

namespace diffvbd {

using namespace contact;

template <class T>
void rigid_backward(const RigidInputs<T>& in, const VirtualMotions<T>& given, const RigidWork<T>& out) {
  torch::stable::parallel_for(0, out.listed, 64, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      const BarrierWork<T> work(in, given, i);
      for (int part = 0; part < kWorkParts; ++part) {
        work.store(part, out.barrier + 4 * kWorkScalars * i, out.by_kappa + i);
      }
    }
  });
  torch::stable::parallel_for(0, out.lagged, 64, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      const LaggedWork<T> work(in, given, i);
      T *rows = out.friction + 4 * kWorkScalars * i, *by_lag = out.by_lag + kLagScalars * i;
      work.acts ? work.store(rows, by_lag) : work.store_none(rows, by_lag);
    }
  });
}

#define DIFFVBD_INSTANTIATE(T) \
  template void rigid_backward<T>(const RigidInputs<T>&, const VirtualMotions<T>&, const RigidWork<T>&);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd
