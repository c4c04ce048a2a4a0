#include "reverse.cuh"

DIFFVBD_INSTANTIATE_REVERSE(double, diffvbd::kMaterial | diffvbd::kRest, kManyLanes)
DIFFVBD_INSTANTIATE_REVERSE(double, diffvbd::kMaterial | diffvbd::kRest, kSpillLanes)
