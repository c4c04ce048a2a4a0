// Entries are compiled once for each backend.
#pragma once

#ifdef USE_CUDA
#include "cuda.h"
#else
#include "cpu.h"
#endif
