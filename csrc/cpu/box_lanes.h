// Boxes of triangles compared with that of an edge, a pack at a time.
#pragma once

#include "lanes.h"

namespace diffvbd {

constexpr int kBoxLanes = 16;

// Rows of `stride` numbers, one for each box: lower corners x, y, z and upper ones; the triangles' vertices. They are
// filled up to whole packs.
struct BoxRows {
  const float* sides;
  const int32_t* corners;
  int64_t stride;
  int count;
};
// Numbers of the boxes that overlap another [lower, upper corner] and share no vertex with an edge; returns how many.
using MeetKernel = int (*)(const BoxRows&, const float* box, const int32_t* ends, int32_t* out);

inline namespace DIFFVBD_SET {

inline int meet_boxes(const BoxRows& in, const float* box, const int32_t* ends, int32_t* out) {
  using Floats = float __attribute__((vector_size(4 * kBoxLanes)));
  using Bits = int32_t __attribute__((vector_size(4 * kBoxLanes)));
  using Bytes = int8_t __attribute__((vector_size(kBoxLanes)));
  int found = 0;
  for (int first = 0; first < in.count; first += kBoxLanes) {
    Bits apart{};
    for (int k = 0; k < 3; ++k) {
      Floats lower, upper;
      Bits corner;
      std::memcpy(&lower, in.sides + k * in.stride + first, sizeof lower);
      std::memcpy(&upper, in.sides + (3 + k) * in.stride + first, sizeof upper);
      std::memcpy(&corner, in.corners + k * in.stride + first, sizeof corner);
      apart |= (lower > box[3 + k]) | (box[k] > upper) | (corner == ends[0]) | (corner == ends[1]);
    }
    const Bytes bytes = __builtin_convertvector(apart, Bytes);
    uint64_t halves[2];
    std::memcpy(halves, &bytes, sizeof halves);
    for (int half = 0; half < 2; ++half) {
      constexpr uint64_t each = 0x0101010101010101;
      for (uint64_t near = ~halves[half] & each; near != 0; near &= near - 1) {
        out[found++] = first + 8 * half + __builtin_ctzll(near) / 8;
      }
    }
  }
  return found;
}

}  // namespace DIFFVBD_SET
}  // namespace diffvbd
