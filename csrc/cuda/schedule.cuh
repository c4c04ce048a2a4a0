// Schedule of the sweeps: launches that depend on one another, loops over sweeps and colors inside a launch, barriers.
#pragma once

#include <cuda_runtime.h>

#include <cstddef>
#include <type_traits>

#include "group.cuh"

namespace diffvbd::cuda {

// Waits for the previous kernel. All threads must call it before they read what an earlier kernel may write and before
// any of them ends. At most two kernels are then on the device, so the writes of earlier ones are visible.
__device__ __forceinline__ void wait_for_previous() {
#if __CUDA_ARCH__ >= 900
  asm volatile("griddepcontrol.wait;" ::: "memory");
  asm volatile("griddepcontrol.launch_dependents;" ::: "memory");
#endif
}

// Whether a kernel that calls it may be a dependent launch: it waits where it was compiled for such a device, and so do
// all kernels compiled with it. Older drivers cannot capture such launches.
inline bool can_depend(const void* kernel) {
  constexpr int kCaptured = 12030;  // CUDA 12.3
  cudaFuncAttributes of{};
  int driver = 0;
  return cudaFuncGetAttributes(&of, kernel) == cudaSuccess && of.ptxVersion >= 90 &&
         cudaDriverGetVersion(&driver) == cudaSuccess && driver >= kCaptured;
}

inline cudaError_t launch(const void* kernel, unsigned blocks, dim3 threads, void** arguments, size_t shared,
                          cudaStream_t stream, bool dependent) {
  cudaLaunchAttribute attribute{};
  attribute.id = cudaLaunchAttributeProgrammaticStreamSerialization;
  attribute.val.programmaticStreamSerializationAllowed = 1;
  cudaLaunchConfig_t config{};
  config.gridDim = dim3(blocks), config.blockDim = threads;
  config.dynamicSmemBytes = shared, config.stream = stream;
  config.attrs = &attribute, config.numAttrs = dependent ? 1 : 0;
  return cudaLaunchKernelExC(&config, kernel, arguments);
}

// Barrier of a cooperative launch; `turn` counts arrivals. The arrival releases the block's writes. No acquire follows,
// which would flush mesh data from the L1 cache: values of other blocks are read from the L2 cache only (load_state).
__device__ __forceinline__ void grid_barrier(unsigned* counter, unsigned& turn) {
  __syncthreads();
  turn += gridDim.x;
  if (threadIdx.x == 0) {
    asm volatile("red.release.gpu.global.add.u32 [%0], 1;" ::"l"(counter) : "memory");
    unsigned seen;
    do {
      asm volatile("ld.relaxed.gpu.global.u32 %0, [%1];" : "=r"(seen) : "l"(counter) : "memory");
    } while (static_cast<int>(seen - turn) < 0);
  }
  __syncthreads();
}

// Calls visit(scene, sweep, block, part, begin, end) for the warps' part of each color, whose blocks are [begin, end),
// with barriers between colors.
template <class T, int lanes_, class Visit>
__device__ __forceinline__ void each_color(const StepView<T>& s, const Range& range, bool backward, Visit&& visit) {
  constexpr int lanes = threads_of(lanes_);
  const bool own = range.regime == kBlock;
  const int64_t scenes_at_once = own ? 1 : s.scenes;
  const unsigned warp = static_cast<unsigned>(warp_of_block()), warps_of_block = blockDim.x / kSlice;
  const unsigned first = own ? warp : blockIdx.x * warps_of_block + warp;
  const unsigned stride = own ? warps_of_block : gridDim.x * warps_of_block;
  unsigned turn = 0;
  for (int64_t own_scene = own ? blockIdx.x : 0; own_scene < (own ? s.scenes : 1); own_scene += gridDim.x) {
    for (int k = range.first_sweep; k < range.end_sweep; ++k) {
      for (int c = range.first_color; c < range.end_color; ++c) {
        const int color = backward ? s.plan.colors - 1 - c : c;
        const int begin = __ldg(s.plan.color_block + color), end = __ldg(s.plan.color_block + color + 1);
        const unsigned parts = static_cast<unsigned>(end - begin) * lanes;
        for (unsigned i = first; i < parts * static_cast<unsigned>(scenes_at_once); i += stride) {
          const unsigned scene = scenes_at_once == 1 ? 0 : i / parts, part = i - scene * parts;
          visit(own_scene + scene, k, begin + static_cast<int>(part / lanes), static_cast<int>(part % lanes), begin,
                end);
        }
        if (own) {
          __syncthreads();
        } else if (range.regime == kGrid) {
          grid_barrier(range.barrier, turn);
        }
      }
    }
  }
}

// The same for a block per vertex: visit(...) of all of a color, then then(...) of all unless `twice` is false. All
// threads of a block call them together. Launches of one color leave then() to a launch of its own.
template <class T, class Visit, class Then>
__device__ __forceinline__ void each_color_by_blocks(const StepView<T>& s, const Range& range, bool backward,
                                                     const Visit& visit, const Then& then, bool twice = true) {
  unsigned turn = 0;
  for (int k = range.first_sweep; k < range.end_sweep; ++k) {
    for (int c = range.first_color; c < range.end_color; ++c) {
      const int color = backward ? s.plan.colors - 1 - c : c;
      const int begin = __ldg(s.plan.color_block + color), end = __ldg(s.plan.color_block + color + 1);
      const unsigned parts = static_cast<unsigned>(end - begin) * kSlice;
      const auto each = [&](const auto& f) {
        for (unsigned i = blockIdx.x; i < parts * static_cast<unsigned>(s.scenes); i += gridDim.x) {
          const unsigned scene = i / parts, part = i - scene * parts;
          f(scene, k, begin + static_cast<int>(part / kSlice), static_cast<int>(part % kSlice), begin, end);
        }
      };
      each(visit);
      if (range.regime != kGrid) continue;
      grid_barrier(range.barrier, turn);
      if constexpr (!std::is_same_v<Then, std::nullptr_t>) {
        if (!twice) continue;
        each(then);
        grid_barrier(range.barrier, turn);
      }
    }
  }
}

}  // namespace diffvbd::cuda
