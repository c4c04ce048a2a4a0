#include "sweep_backward.h"

template diffvbd::ReverseKernel<float> diffvbd::reverse_kernel<float>(int);
