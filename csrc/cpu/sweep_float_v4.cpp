// The standard library comes first: what it has inline is compiled for every processor.
#include "standard.h"
#ifdef DIFFVBD_HAS_SETS
#pragma GCC target("arch=x86-64-v4")
#define DIFFVBD_SET v4
#define DIFFVBD_UPPER_HALVES
#include "sweep_kernels.h"

template diffvbd::Kernels<float> diffvbd::v4::sweep_kernels<float>();
#endif
