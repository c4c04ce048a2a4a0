#include "reverse.cuh"

DIFFVBD_INSTANTIATE_REVERSE(double, diffvbd::kState, kFewLanes)
DIFFVBD_INSTANTIATE_REVERSE(double, diffvbd::kState, kSomeReverseLanes)
