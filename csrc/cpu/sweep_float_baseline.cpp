#include "sweep_kernels.h"

template diffvbd::Kernels<float> diffvbd::baseline::sweep_kernels<float>();
