#include "reverse.cuh"

DIFFVBD_INSTANTIATE_REVERSE(float, diffvbd::kMaterial | diffvbd::kRest, kFewLanes)
DIFFVBD_INSTANTIATE_REVERSE(float, diffvbd::kMaterial | diffvbd::kRest, kSomeReverseLanes)
