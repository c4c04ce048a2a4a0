#include "sweep_kernels.h"

template diffvbd::Kernels<double> diffvbd::baseline::sweep_kernels<double>();
