#include "sweep_backward.h"

namespace diffvbd {
template ReverseKernel<double> reverse_kernel<double>(int, int);
}  // namespace diffvbd
