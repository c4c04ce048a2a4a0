// Which scenes are decided by a block or a cluster each (cluster.cuh), where otherwise the whole device works on one
// question after another.
#pragma once

#include <cstdint>

namespace diffvbd::cuda {

constexpr int64_t kSmallScene = 4096;  // vertices of a scene
constexpr int64_t kFewPairs = 131072;  // pairs that each scene has room for, most of it unused, unless there are
constexpr int64_t kManyScenes = 64;    // scenes enough to fill the device

inline bool has_block_each(int64_t vertices, int64_t scenes, int64_t pairs) {
  return vertices <= kSmallScene && (pairs <= kFewPairs * scenes || kManyScenes <= scenes);
}

}  // namespace diffvbd::cuda
