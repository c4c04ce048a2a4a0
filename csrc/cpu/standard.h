// Every header of the standard library that the sweeps include, and whether there are sets beside the baseline: GCC 12
// knows both the pragma that compiles for one and the test of a processor.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <limits>
#include <memory>
#include <new>
#include <type_traits>
#include <utility>

#if defined(__x86_64__) && defined(__GNUC__) && __GNUC__ >= 12 && !defined(__clang__) && !defined(DIFFVBD_NO_CLONES)
#define DIFFVBD_HAS_SETS
#endif
// for lambdas in loops that a compiler may think cold
#define DIFFVBD_INLINE __attribute__((always_inline))
