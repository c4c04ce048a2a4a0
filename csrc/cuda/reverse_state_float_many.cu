#include "reverse.cuh"

DIFFVBD_INSTANTIATE_REVERSE(float, diffvbd::kState, kManyLanes)
DIFFVBD_INSTANTIATE_REVERSE(float, diffvbd::kState, kSpillLanes)
