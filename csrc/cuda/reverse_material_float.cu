#include "reverse.cuh"

DIFFVBD_INSTANTIATE_REVERSE(float, diffvbd::kMaterial)
