#include "reverse.cuh"

DIFFVBD_INSTANTIATE_REVERSE(float, diffvbd::kMaterial, kManyLanes)
DIFFVBD_INSTANTIATE_REVERSE(float, diffvbd::kMaterial, kSpillLanes)
