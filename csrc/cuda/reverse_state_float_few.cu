#include "reverse.cuh"

DIFFVBD_INSTANTIATE_REVERSE(float, diffvbd::kState, kFewLanes)
DIFFVBD_INSTANTIATE_REVERSE(float, diffvbd::kState, kSomeReverseLanes)
