#include "sweep_backward.h"

template diffvbd::ReverseKernel<double> diffvbd::reverse_kernel<double>(int);
