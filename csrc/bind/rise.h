// The tensors of potential_rise, as all backends take them.
#pragma once

#include <vector>

#include "../subspace/coarse.h"
#include "rigid.h"

namespace diffvbd {

template <class T>
coarse::IncreaseInputs<T> rise_inputs(const RigidFields& f, const Tensor& to, const Tensor& material, const Tensor& rest,
                                  const Tensor& corner, const Tensor& block_ptr, const std::vector<int64_t>& data_count,
                                  double time_step) {
  coarse::IncreaseInputs<T> in{};
  in.bodies = rigid_inputs<T>(f, data_count, time_step, false);
  require_like("to", to, f.x, f.x.numel());
  require(is_index(corner, f.x) && corner.dim() == 3 && corner.size(1) == 4 && corner.size(2) == coarse::kBlockTets &&
              is_index(block_ptr, f.x) && block_ptr.numel() == in.bodies.bodies + 1,
          "diffvbd::potential_rise: expected corner [blocks, 4, lanes] and block_ptr [bodies + 1], int32");
  const int64_t b = in.bodies.scenes, blocks = corner.size(0);
  in.to = data<const T>(to), in.corner = data<const int32_t>(corner), in.block_ptr = data<const int32_t>(block_ptr);
  in.rest = batched<T>("rest", rest, f.x, b, blocks * kRestScalars * coarse::kBlockTets);
  in.material = batched<T>("material", material, f.x, b, blocks * kTetScalars * coarse::kBlockTets);
  in.blocks = blocks, in.listed = f.order.numel();
  return in;
}

}  // namespace diffvbd
