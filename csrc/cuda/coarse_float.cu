#include "coarse_gradient.cuh"

using namespace diffvbd;
DIFFVBD_INSTANTIATE_GRADIENT(float, cuda::kForward)
DIFFVBD_INSTANTIATE_GRADIENT(float, kState)
DIFFVBD_INSTANTIATE_GRADIENT(float, kMaterial)
DIFFVBD_INSTANTIATE_GRADIENT(float, kMaterial | kRest)
