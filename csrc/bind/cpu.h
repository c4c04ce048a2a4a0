// Where entries run that are compiled for the CPU: its memory, and its loops, which have the names and arguments of the
// launches in csrc/cuda.
#pragma once

#include <algorithm>
#include <vector>

#include "../cpu/advance.h"
#include "../cpu/contact_coarse.h"
#include "../cpu/contact_rigid.h"
#include "../cpu/detect.h"
#include "../cpu/loops.h"
#include "../cpu/motion.h"
#include "../cpu/neighbors.h"
#include "../cpu/reductions.h"
#include "../cpu/run.h"
#include "arguments.h"

// A call with what only launches take, and without.
#define DIFFVBD_RUN(device, kernel, ...) ::diffvbd::kernel(__VA_ARGS__)
#define DIFFVBD_ON_CUDA(...)

namespace diffvbd {

constexpr bool kOnCuda = false;

class Device {
 public:
  explicit Device(const Tensor& like) : like_(like) {}

  Tensor empty(Ints sizes) const { return torch::stable::new_empty(like_, sizes); }
  Tensor empty(Ints sizes, ScalarType dtype) const { return torch::stable::empty(sizes, dtype); }
  Tensor zeros(Ints sizes) const { return torch::stable::new_zeros(like_, sizes); }
  Tensor zeros(Ints sizes, ScalarType dtype) const {
    return torch::stable::new_zeros(like_, sizes, std::make_optional(dtype));
  }
  Tensor operator()(Ints sizes, bool zeroed) const { return zeroed ? zeros(sizes) : empty(sizes); }
  Tensor like_x() const { return torch::stable::empty_like(like_); }

 private:
  const Tensor& like_;
};

}  // namespace diffvbd
