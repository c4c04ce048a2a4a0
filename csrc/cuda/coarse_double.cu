#include "coarse_gradient.cuh"

using namespace diffvbd;
DIFFVBD_INSTANTIATE_GRADIENT(double, cuda::kForward)
DIFFVBD_INSTANTIATE_GRADIENT(double, kState)
DIFFVBD_INSTANTIATE_GRADIENT(double, kMaterial)
DIFFVBD_INSTANTIATE_GRADIENT(double, kMaterial | kRest)
