// What contact brings to a block update: the part that pairs add to the block, computed color by color before the color
// moves (contact/passes.h). What keeps surfaces apart comes after the update (contact/limit.h).
#pragma once

#include "../core/vec.h"

namespace diffvbd {

template <class R>
struct ContactTerm {
  Vec3<R> g;
  Sym3<R> H;
};
constexpr int kContactScalars = 9;

}  // namespace diffvbd
