// The standard library comes first: what it has inline is compiled for every processor.
#include "standard.h"
#ifdef DIFFVBD_HAS_SETS
#pragma GCC target("arch=x86-64-v3")
#define DIFFVBD_SET v3
#define DIFFVBD_UPPER_HALVES
#include "sweep_kernels.h"

template diffvbd::Kernels<double> diffvbd::v3::sweep_kernels<double>();
#endif
