#include "reverse.cuh"

DIFFVBD_INSTANTIATE_REVERSE(double, diffvbd::kState, kManyLanes)
DIFFVBD_INSTANTIATE_REVERSE(double, diffvbd::kState, kSpillLanes)
