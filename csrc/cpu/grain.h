// When work is worth one more thread.
#pragma once

#include <cstdint>

namespace diffvbd {

// Cheap items (tens of nanoseconds each) that a thread must be given: waking it takes as long as a thousand of them.
constexpr int64_t kGrain = 4096;

// Pieces of this many cheap items each that a thread must be given.
constexpr int64_t pieces_per_thread(int64_t items) { return items < kGrain ? kGrain / (items > 0 ? items : 1) : 1; }

}  // namespace diffvbd
