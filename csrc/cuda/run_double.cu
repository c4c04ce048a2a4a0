#include "run.cuh"

DIFFVBD_INSTANTIATE_RUN(double)
