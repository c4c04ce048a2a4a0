// Small scenes, each for one block or for the blocks of a cluster. These synchronize in less time than a launch takes,
// and see each other's shared memory. Before compute capability 9 a cluster is one block.
#pragma once

#include <cooperative_groups.h>

#include <cstdint>

namespace diffvbd::cuda {

constexpr int64_t kSmallScene = 4096;  // vertices of a scene
constexpr int64_t kFewPairs = 131072;  // capacity of pairs per scene; most of it is unused
constexpr int64_t kManyScenes = 64;    // scenes that fill the device

inline bool has_block_each(int64_t vertices, int64_t scenes, int64_t pairs) {
  return vertices <= kSmallScene && (pairs <= kFewPairs * scenes || kManyScenes <= scenes);
}

constexpr int kMostBlocks = 8;           // of a cluster, on every device that has them
constexpr int64_t kPairsOfBlock = 1024;  // pairs that one more block pays for
constexpr int64_t kBlocksAtOnce = 128;   // of all scenes: more do not run concurrently

constexpr int64_t kItemsAlone =
    1536;  // vertices and pairs below which one block is faster than a cluster that synchronizes

struct Cluster {
  int rank, size;
  // Whether this block leaves: a scene of few items is left to the first block, which then stops synchronizing with
  // others. The number of blocks follows from capacities, and lists may be much shorter.
  __device__ bool leaves(int64_t items) {
    if (items > kItemsAlone) return false;
    size = 1;
    return rank > 0;
  }
#if __CUDA_ARCH__ >= 900
  __device__ static Cluster all() {
    const auto cluster = cooperative_groups::this_cluster();
    return {static_cast<int>(cluster.block_rank()), static_cast<int>(cluster.num_blocks())};
  }
  // Barrier of the cluster; earlier writes are visible after it.
  __device__ void meet() const {
    if (size == 1) {
      __syncthreads();
    } else {
      cooperative_groups::this_cluster().sync();
    }
  }
  // Address in another block of what is at `own` in this one's shared memory.
  template <class U>
  __device__ static U* of(U* own, int block) {
    return cooperative_groups::this_cluster().map_shared_rank(own, block);
  }
#else
  __device__ static Cluster all() { return {0, 1}; }
  __device__ void meet() const { __syncthreads(); }
  template <class U>
  __device__ static U* of(U* own, int) {
    return own;
  }
#endif
};

// Votes of the blocks of a cluster, double-buffered: one barrier for each vote. In shared memory.
struct Answers {
  int of[2][kMostBlocks];
};
// Vote of all threads of a cluster. turn: 0 at first, the same for all threads.
__device__ inline bool any_of_cluster(const Cluster& cluster, Answers& answers, int& turn, bool own) {
  const int here = __syncthreads_or(own), size = cluster.size;
  if (size == 1) return here != 0;
  const auto block = static_cast<int>(threadIdx.x);
  if (block < size) Cluster::of(&answers, block)->of[turn][cluster.rank] = here;
  cluster.meet();
  bool out = false;
  for (int b = 0; b < size; ++b) out = out || answers.of[turn][b] != 0;
  turn = 1 - turn;
  return out;
}

// Blocks for each scene, a power of two. The architecture that the kernel was compiled for decides, not the device.
inline int blocks_of_scene(const void* kernel, int64_t scenes, int64_t pairs) {
  cudaFuncAttributes of{};
  if (cudaFuncGetAttributes(&of, kernel) != cudaSuccess || of.ptxVersion < 90) return 1;
  int blocks = 1;
  while (blocks < kMostBlocks && blocks * kPairsOfBlock * scenes < pairs && 2 * blocks * scenes <= kBlocksAtOnce) {
    blocks *= 2;
  }
  return blocks;
}

// A cluster for each scene; pairs: capacity of the lists.
template <class... P, class... A>
cudaError_t launch_clusters(void (*kernel)(P...), int64_t scenes, int64_t pairs, int threads, cudaStream_t stream,
                            A... arguments) {
  const int blocks = blocks_of_scene(reinterpret_cast<const void*>(kernel), scenes, pairs);
  cudaLaunchAttribute attribute{};
  attribute.id = cudaLaunchAttributeClusterDimension;
  attribute.val.clusterDim.x = static_cast<unsigned>(blocks);
  attribute.val.clusterDim.y = attribute.val.clusterDim.z = 1;
  cudaLaunchConfig_t config{};
  config.gridDim = dim3(static_cast<unsigned>(scenes * blocks));
  config.blockDim = dim3(static_cast<unsigned>(threads));
  config.stream = stream;
  config.attrs = &attribute;
  config.numAttrs = blocks > 1 ? 1 : 0;
  return cudaLaunchKernelEx(&config, kernel, static_cast<P>(arguments)...);
}

}  // namespace diffvbd::cuda
