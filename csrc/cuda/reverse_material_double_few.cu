#include "reverse.cuh"

DIFFVBD_INSTANTIATE_REVERSE(double, diffvbd::kMaterial, kFewLanes)
DIFFVBD_INSTANTIATE_REVERSE(double, diffvbd::kMaterial, kSomeReverseLanes)
