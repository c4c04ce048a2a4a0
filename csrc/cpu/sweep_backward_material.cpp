#include "sweep_backward.h"

DIFFVBD_INSTANTIATE_REVERSE(diffvbd::kMaterial)
