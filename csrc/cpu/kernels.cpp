// Which instruction set the sweeps run: the newest that the processor has, or an older one that DIFFVBD_ISA names.
#include "kernels.h"

#include <cstdlib>
#include <cstring>
#include <stdexcept>

namespace diffvbd {
namespace {

enum InstructionSet { kBaseline, kV3, kV4 };

InstructionSet newest() {
#ifdef DIFFVBD_HAS_SETS
  __builtin_cpu_init();
  const bool v3 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi") &&
                  __builtin_cpu_supports("bmi2");
  const bool v4 = v3 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
                  __builtin_cpu_supports("avx512cd") && __builtin_cpu_supports("avx512dq") &&
                  __builtin_cpu_supports("avx512vl");
  return v4 ? kV4 : v3 ? kV3 : kBaseline;
#else
  return kBaseline;
#endif
}

InstructionSet chosen() {
  const InstructionSet best = newest();
  const char* name = std::getenv("DIFFVBD_ISA");
  if (!name) return best;
  const char* names[] = {"baseline", "v3", "v4"};
  for (int i = 0; i <= best; ++i) {
    if (std::strcmp(name, names[i]) == 0) return static_cast<InstructionSet>(i);
  }
  throw std::invalid_argument("DIFFVBD_ISA: expected baseline, v3 or v4, as the processor and the build have it");
}

template <class T>
Kernels<T> kernels() {
#ifdef DIFFVBD_HAS_SETS
  static const InstructionSet set = chosen();
  if (set == kV4) return v4::sweep_kernels<T>();
  if (set == kV3) return v3::sweep_kernels<T>();
#endif
  return baseline::sweep_kernels<T>();
}

template <class T>
SweepKernel<T> compiled(SweepKernel<T> kernel) {
  if (!kernel) throw std::invalid_argument("block: expected \"exact\" in a quick build, which lacks the paper's block");
  return kernel;
}

}  // namespace

template <class T>
SweepKernel<T> forward_kernel(int energies) {
  return compiled(kernels<T>().forward(energies));
}
template <class T>
SweepKernel<T> reverse_kernel(int energies) {
  return compiled(kernels<T>().reverse(energies));
}

template SweepKernel<float> forward_kernel<float>(int);
template SweepKernel<double> forward_kernel<double>(int);
template SweepKernel<float> reverse_kernel<float>(int);
template SweepKernel<double> reverse_kernel<double>(int);

}  // namespace diffvbd
