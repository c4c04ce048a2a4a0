#include "forward.cuh"

DIFFVBD_INSTANTIATE_FORWARD(double)
