#include "coarse_gradient.cuh"

DIFFVBD_INSTANTIATE_GRADIENT(float)
