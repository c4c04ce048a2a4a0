#include "sweep_backward.h"

namespace diffvbd {
template ReverseKernel<float> reverse_kernel<float>(int, int);
}  // namespace diffvbd
