#include "reverse.cuh"

DIFFVBD_INSTANTIATE_REVERSE(float, diffvbd::kMaterial, kFewLanes)
DIFFVBD_INSTANTIATE_REVERSE(float, diffvbd::kMaterial, kSomeReverseLanes)
