#include "reverse.cuh"

DIFFVBD_INSTANTIATE_REVERSE(double, diffvbd::kMaterial, kManyLanes)
DIFFVBD_INSTANTIATE_REVERSE(double, diffvbd::kMaterial, kSpillLanes)
