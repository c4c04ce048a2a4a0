// The instruction set of the sweeps: the newest that the processor has, or an older one that DIFFVBD_ISA names.
#include "kernels.h"

#include <cstdlib>
#include <cstring>
#include <stdexcept>
#include <string>

namespace diffvbd {
namespace {

enum InstructionSet { kBaseline, kV3, kV4 };

InstructionSet newest() {
#ifdef DIFFVBD_HAS_SETS
  __builtin_cpu_init();
  if (__builtin_cpu_supports("x86-64-v4")) return kV4;
  if (__builtin_cpu_supports("x86-64-v3")) return kV3;
#endif
  return kBaseline;
}

InstructionSet find() {
  const InstructionSet best = newest();
  const char* name = std::getenv("DIFFVBD_ISA");
  if (!name || !*name) return best;
  const char* names[] = {"baseline", "v3", "v4"};
  for (int i = 0; i <= best; ++i) {
    if (std::strcmp(name, names[i]) == 0) return static_cast<InstructionSet>(i);
  }
  throw std::invalid_argument(std::string("DIFFVBD_ISA: expected one of baseline, v3, v4 that this processor and this "
                                          "build have, got ") +
                              name);
}
// for the life of the process
InstructionSet chosen() {
  static const InstructionSet set = find();
  return set;
}

template <class T>
Kernels<T> kernels() {
  [[maybe_unused]] const InstructionSet set = chosen();
#ifdef DIFFVBD_HAS_SETS
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

template <class T>
CoarseKernels<T> coarse_kernels(int energies) {
  const CoarseKernels<T> out = kernels<T>().coarse(energies);
  if (!out.gradient) throw std::invalid_argument("coarse: expected the exact block");
  return out;
}

template <class T>
PairKernels<T> pair_kernels() {
  return kernels<T>().pairs;
}

#define DIFFVBD_INSTANTIATE(T)                      \
  template SweepKernel<T> forward_kernel<T>(int);   \
  template SweepKernel<T> reverse_kernel<T>(int);   \
  template CoarseKernels<T> coarse_kernels<T>(int); \
  template PairKernels<T> pair_kernels<T>();
#ifdef DIFFVBD_SCALAR
DIFFVBD_INSTANTIATE(DIFFVBD_SCALAR)
#else
OverlapKernel overlap_kernel() { return kernels<float>().meet; }
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#endif

}  // namespace diffvbd
