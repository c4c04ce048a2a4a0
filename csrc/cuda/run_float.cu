#include "run.cuh"

DIFFVBD_INSTANTIATE_RUN(float)
