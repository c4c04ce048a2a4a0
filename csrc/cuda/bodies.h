// Bodies of a scene as kernels take them.
#pragma once

#include <cstdint>

namespace diffvbd::cuda {

// How many of the bodies, smallest first, are worked on by a thread (where there are many), by a part of a warp, by a
// block, and by the whole device, unless there are so many that a block each is faster.
struct BodyGroups {
  int32_t tiny, small, medium, large;
};

// Doubles of memory that the sums of the whole device go through; 0 where no body needs it.
int64_t bodies_workspace(const BodyGroups& groups, int64_t scenes, int64_t vertices);

}  // namespace diffvbd::cuda
