// Schedule of the sweeps: launches that depend on one another, loops over sweeps and colors inside a launch, barriers.
#pragma once

#include <cuda_runtime.h>

#include <cstddef>
#include <type_traits>

#include "group.cuh"

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

// All threads of a cooperative launch wait for each other; `turn` counts the meetings. The arrival releases what the
// block wrote; no acquire follows, which would empty the L1 cache of the mesh's data too: what other blocks write is
// read from the L2 cache alone (load_state).
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

// Calls visit(scene, sweep, block, part, begin, end) for the warps' share of each color, whose blocks are [begin, end),
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

// The same where a block has a vertex at a time: visit(scene, sweep, block, part, begin, end) of all of a color, and
// then(...) of all, unless `twice` is false. All threads of a block call them together. Where launches have a color
// each, then() has one to itself.
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
