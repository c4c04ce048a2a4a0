#include "reverse.cuh"

DIFFVBD_INSTANTIATE_REVERSE(double, diffvbd::kMaterial | diffvbd::kRest, kFewLanes)
DIFFVBD_INSTANTIATE_REVERSE(double, diffvbd::kMaterial | diffvbd::kRest, kSomeReverseLanes)
