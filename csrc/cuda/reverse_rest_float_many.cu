#include "reverse.cuh"

DIFFVBD_INSTANTIATE_REVERSE(float, diffvbd::kMaterial | diffvbd::kRest, kManyLanes)
DIFFVBD_INSTANTIATE_REVERSE(float, diffvbd::kMaterial | diffvbd::kRest, kSpillLanes)
