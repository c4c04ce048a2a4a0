// Runs of subspace/contact_coarse.h and subspace/rigid_step.h on CUDA: a launch for each loop, or a block for each
// scene.
#pragma once

#include "../subspace/rigid_step.h"
#include "atomics.cuh"
#include "bodies.cuh"
#include "common.cuh"

namespace diffvbd::cuda {

using namespace contact;
using rigid::Body;

constexpr int kItems = 128;        // threads of a block with one item each
constexpr int kPartsApart = 16;    // threads of a row, one for each part
constexpr int32_t kFewBodies = 8;  // of a group that a warp solves for
static_assert(kWorkParts <= kPartsApart);

// What both have: sets of bodies by atomics.
struct Sets {
  DIFFVBD_FN static int32_t root_of(const int32_t* label, int32_t i) {
#ifdef __CUDA_ARCH__
    return cuda::root_of(label, i);
#else
    return label[i];  // not called
#endif
  }
  DIFFVBD_FN static void unite(int32_t* label, int32_t a, int32_t b) {
#ifdef __CUDA_ARCH__
    cuda::unite(label, a, b);
#endif
  }
  DIFFVBD_FN static void set_bit(uint64_t* bits, int32_t k) {
#ifdef __CUDA_ARCH__
    atomicOr(reinterpret_cast<unsigned long long*>(bits), 1ull << k);
#endif
  }
};

template <class F>
__global__ void __launch_bounds__(kItems) each_kernel(int64_t n, const __grid_constant__ F f) {
  const int64_t i = own_item(kItems);
  if (i < n) f(i);
}

// A warp that shares the items of one.
struct Warp {
  int lane;
  __device__ bool leads() const { return lane == 0; }
  __device__ void meet() const { __syncwarp(); }
  template <class F>
  __device__ void each(int64_t count, const F& f) const {
    for (int64_t i = lane; i < count; i += 32) f(i);
  }
};
template <class F>
__global__ void __launch_bounds__(kItems) lanes_kernel(int64_t n, const __grid_constant__ F f) {
  const int64_t i = own_item(kItems) / 32;
  if (i < n) f(i, Warp{static_cast<int>(threadIdx.x % 32)});
}

template <class F>
__global__ void __launch_bounds__(kThreads) teams_kernel(const __grid_constant__ F f) {
  __shared__ double part[kWarps][kMostSums];
  f(int64_t{blockIdx.x}, BlockTeam{part});
}

template <class Phase, class Step>
__global__ void __launch_bounds__(kItems) items_kernel(Phase phase, const __grid_constant__ Step s, int64_t n) {
  const int64_t i = own_item(kItems);
  if (i < s.inputs().scene.scenes * n) phase(s, i / n, i % n);
}
template <class Phase, class Step>
__global__ void __launch_bounds__(kItems) rows_kernel(Phase phase, const __grid_constant__ Step s) {
  const int64_t row = own_item(kItems);
  if (row < s.listed() + s.lagged()) phase(s, row);
}
template <class Phase, class Step>
__global__ void __launch_bounds__(kItems) parts_kernel(Phase phase, const __grid_constant__ Step s, int count) {
  const int64_t item = own_item(kItems), row = item / kPartsApart;
  const int part = static_cast<int>(item % kPartsApart);
  if (row < s.listed() && part < count) phase(s, row, part);
}
template <class Phase, class Step>
__global__ void __launch_bounds__(kItems) small_bodies_kernel(Phase phase, const __grid_constant__ Step s) {
  const auto& in = s.inputs();
  const int64_t unit = own_item(kItems) / 32, n = in.bodies();
  using Scene = std::decay_t<decltype(in.scene)>;
  if (unit >= in.scene.scenes * n) return;
  const Body<typename Scene::Scalar> body{in.scene, unit / n, static_cast<int32_t>(unit % n)};
  if (body.size() <= kOfWarp) phase(s, body, Tile<32>());
}
template <class Phase, class Step>
__global__ void __launch_bounds__(kThreads) large_bodies_kernel(Phase phase, const __grid_constant__ Step s) {
  __shared__ double part[kWarps][kMostSums];
  const auto& in = s.inputs();
  const int64_t unit = blockIdx.x, n = in.bodies();
  using Scene = std::decay_t<decltype(in.scene)>;
  const Body<typename Scene::Scalar> body{in.scene, unit / n, static_cast<int32_t>(unit % n)};
  if (body.size() > kOfWarp) phase(s, body, BlockTeam{part});
}
template <class Phase, class Step>
__global__ void __launch_bounds__(kItems) small_groups_kernel(Phase phase, const __grid_constant__ Step s) {
  const auto& in = s.inputs();
  const int64_t unit = own_item(kItems) / 32, n = in.bodies();
  if (unit >= in.scene.scenes * n) return;
  const auto place = static_cast<int32_t>(unit % n);
  if (in.groups_of(unit / n).count(place) <= kFewBodies) phase(s, unit / n, place, Tile<32>());
}
template <class Phase, class Step>
__global__ void __launch_bounds__(kThreads) large_groups_kernel(Phase phase, const __grid_constant__ Step s) {
  __shared__ double part[kWarps][kMostSums];
  const auto& in = s.inputs();
  const int64_t unit = blockIdx.x, n = in.bodies();
  const auto place = static_cast<int32_t>(unit % n);
  if (in.groups_of(unit / n).count(place) > kFewBodies) phase(s, unit / n, place, BlockTeam{part});
}
template <class Phase, class Step>
__global__ void __launch_bounds__(kItems) points_kernel(Phase phase, const __grid_constant__ Step s) {
  const int64_t point = own_item(kItems) / 32;
  if (point < s.inputs().scene.scenes * s.inputs().gate.corners) phase(s, point, Tile<32>());
}

// A launch for each loop.
struct Launches : Sets {
  using Team = BlockTeam;
  using Lane = Warp;
  cudaStream_t stream;
  explicit Launches(cudaStream_t on) : stream(on) {}

  template <class F>
  void each(int64_t n, const F& f) const {
    if (n > 0) each_kernel<<<blocks_for(n, kItems), kItems, 0, stream>>>(n, f);
  }
  template <class F>
  void lanes(int64_t n, const F& f) const {
    if (n > 0) lanes_kernel<<<blocks_for(32 * n, kItems), kItems, 0, stream>>>(n, f);
  }
  template <class F>
  void teams(int64_t n, const F& f) const {
    if (n > 0) teams_kernel<<<static_cast<unsigned>(n), kThreads, 0, stream>>>(f);
  }

  template <class Phase, class Step>
  void each(const Phase& phase, const Step& s, int64_t n) const {
    const int64_t items = s.inputs().scene.scenes * n;
    if (items > 0) items_kernel<<<blocks_for(items, kItems), kItems, 0, stream>>>(phase, s, n);
  }
  template <class Phase, class Step>
  void rows(const Phase& phase, const Step& s) const {
    const int64_t items = s.listed() + s.lagged();
    if (items > 0) rows_kernel<<<blocks_for(items, kItems), kItems, 0, stream>>>(phase, s);
  }
  template <class Phase, class Step>
  void parts(const Phase& phase, const Step& s, int count) const {
    const int64_t items = s.listed() * kPartsApart;
    if (items > 0) parts_kernel<<<blocks_for(items, kItems), kItems, 0, stream>>>(phase, s, count);
  }
  template <class Phase, class Step>
  void bodies(const Phase& phase, const Step& s) const {
    const auto& in = s.inputs();
    const int64_t units = in.scene.scenes * in.bodies();
    if (units == 0) return;
    small_bodies_kernel<<<blocks_for(32 * units, kItems), kItems, 0, stream>>>(phase, s);
    if (in.scene.vertices > kOfWarp) {
      large_bodies_kernel<<<static_cast<unsigned>(units), kThreads, 0, stream>>>(phase, s);
    }
  }
  template <class Phase, class Step>
  void groups(const Phase& phase, const Step& s) const {
    const auto& in = s.inputs();
    const int64_t units = in.scene.scenes * in.bodies();
    if (units == 0) return;
    small_groups_kernel<<<blocks_for(32 * units, kItems), kItems, 0, stream>>>(phase, s);
    if (most_grouped(in.bodies()) > kFewBodies) {
      large_groups_kernel<<<static_cast<unsigned>(units), kThreads, 0, stream>>>(phase, s);
    }
  }
  template <class Phase, class Step>
  void points(const Phase& phase, const Step& s) const {
    const int64_t items = s.inputs().scene.scenes * s.inputs().gate.corners;
    if (items > 0) points_kernel<<<blocks_for(32 * items, kItems), kItems, 0, stream>>>(phase, s);
  }
  bool all(const uint8_t*, int64_t) const { return false; }  // the host would wait
  bool none(const uint8_t*, int64_t) const { return false; }
};

// A block for a scene.
struct InBlock : Sets {
  int64_t scene;
  BlockTeam team;
  __device__ InBlock(int64_t of, const BlockTeam& by) : scene(of), team(by) {}

  // Calls f(i) for the items of a thread from `begin` on.
  template <class F>
  __device__ void own(int64_t begin, int64_t end, const F& f) const {
    for (int64_t i = begin + threadIdx.x; i < end; i += kThreads) f(i);
  }
  template <class F>
  __device__ void by_warp(int64_t count, const F& f) const {
    for (int64_t i = threadIdx.x / 32; i < count; i += kWarps) f(i);
    __syncthreads();
  }

  template <class Phase, class Step>
  __device__ void each(const Phase& phase, const Step& s, int64_t n) const {
    own(0, n, [&](int64_t i) { phase(s, scene, i); });
    __syncthreads();
  }
  template <class Phase, class Step>
  __device__ void rows(const Phase& phase, const Step& s) const {
    const auto& in = s.inputs();
    if (s.listed() > 0) own(in.first_listed(scene), in.first_listed(scene + 1), [&](int64_t i) { phase(s, i); });
    if (s.lagged() > 0) {
      own(in.first_lagged(scene), in.first_lagged(scene + 1), [&](int64_t i) { phase(s, s.listed() + i); });
    }
    __syncthreads();
  }
  template <class Phase, class Step>
  __device__ void parts(const Phase& phase, const Step& s, int count) const {
    const auto& in = s.inputs();
    if (s.listed() > 0) {
      own(kPartsApart * in.first_listed(scene), kPartsApart * in.first_listed(scene + 1), [&](int64_t i) {
        if (i % kPartsApart < count) phase(s, i / kPartsApart, static_cast<int>(i % kPartsApart));
      });
    }
    __syncthreads();
  }
  template <class Phase, class Step>
  __device__ void bodies(const Phase& phase, const Step& s) const {
    const auto& in = s.inputs();
    using Scene = std::decay_t<decltype(in.scene)>;
    const auto body = [&](int64_t k) { return Body<typename Scene::Scalar>{in.scene, scene, static_cast<int32_t>(k)}; };
    by_warp(in.bodies(), [&](int64_t k) {
      if (body(k).size() <= kOfWarp) phase(s, body(k), Tile<32>());
    });
    if (in.scene.vertices <= kOfWarp) return;
    for (int64_t k = 0; k < in.bodies(); ++k) {
      if (body(k).size() > kOfWarp) phase(s, body(k), team);
      __syncthreads();
    }
  }
  template <class Phase, class Step>
  __device__ void groups(const Phase& phase, const Step& s) const {
    const auto& in = s.inputs();
    const Groups g = in.groups_of(scene);
    by_warp(in.bodies(), [&](int64_t k) {
      const auto place = static_cast<int32_t>(k);
      if (g.count(place) <= kFewBodies) phase(s, scene, place, Tile<32>());
    });
    if (in.bodies() <= kFewBodies) return;
    for (int32_t place = 0; place < in.bodies(); ++place) {
      if (g.count(place) > kFewBodies) phase(s, scene, place, team);
    }
    __syncthreads();
  }
  template <class Phase, class Step>
  __device__ void points(const Phase& phase, const Step& s) const {
    const int64_t corners = s.inputs().gate.corners;
    by_warp(corners, [&](int64_t k) { phase(s, scene * corners + k, Tile<32>()); });
  }
  // flags: of all scenes, of which there is a block each
  __device__ bool all(const uint8_t* flags, int64_t n) const {
    return holds(n, [&](int64_t i) { return flags[i] != 0; });
  }
  __device__ bool none(const uint8_t* flags, int64_t n) const {
    return holds(n, [&](int64_t i) { return flags[i] == 0; });
  }
  template <class F>
  __device__ bool holds(int64_t n, const F& f) const {
    const int64_t count = n / gridDim.x;
    bool all = true;
    own(scene * count, (scene + 1) * count, [&](int64_t i) { all = all && f(i); });
    return __syncthreads_and(all) != 0;
  }
};

}  // namespace diffvbd::cuda
