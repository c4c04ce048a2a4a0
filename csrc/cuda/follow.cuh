// Kernels that follow one another closely: the next comes onto the device while the one before it ends, and waits there
// until it sees all that this one has written. Needs compute capability 9.
#pragma once

#include <cuda_runtime.h>

namespace diffvbd::cuda {

// To be called by all threads, before they read what an earlier kernel may write and before any of them ends. Then two
// kernels at most are on the device at once: what was written before the one before is there in any case.
__device__ __forceinline__ void wait_for_previous() {
#if __CUDA_ARCH__ >= 900
  asm volatile("griddepcontrol.wait;" ::: "memory");
  asm volatile("griddepcontrol.launch_dependents;" ::: "memory");
#endif
}

// Whether a kernel that calls it may follow another: it waits where it was compiled for such a device, as are then all
// kernels that were compiled with it. Older drivers cannot capture such launches.
inline bool can_follow(const void* kernel) {
  constexpr int kCaptured = 12030;  // CUDA 12.3
  cudaFuncAttributes of{};
  int driver = 0;
  return cudaFuncGetAttributes(&of, kernel) == cudaSuccess && of.ptxVersion >= 90 &&
         cudaDriverGetVersion(&driver) == cudaSuccess && driver >= kCaptured;
}

inline cudaError_t launch(const void* kernel, unsigned blocks, dim3 threads, void** arguments, size_t shared,
                          cudaStream_t stream, bool follows) {
  cudaLaunchAttribute attribute{};
  attribute.id = cudaLaunchAttributeProgrammaticStreamSerialization;
  attribute.val.programmaticStreamSerializationAllowed = 1;
  cudaLaunchConfig_t config{};
  config.gridDim = dim3(blocks), config.blockDim = threads;
  config.dynamicSmemBytes = shared, config.stream = stream;
  config.attrs = &attribute, config.numAttrs = follows ? 1 : 0;
  return cudaLaunchKernelExC(&config, kernel, arguments);
}

}  // namespace diffvbd::cuda
