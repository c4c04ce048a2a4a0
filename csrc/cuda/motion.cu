#include "cluster.cuh"
#include "common.cuh"
#include "contact.h"
#include "islands.cuh"

namespace diffvbd::cuda {
namespace {

constexpr int32_t kMostOfBlock = 16;  // bodies of a scene up to which one block takes all of them

// A block for each body of each scene.
template <class T, class Act>
__global__ void __launch_bounds__(kThreads)
    each_body(const __grid_constant__ MotionInputs<T> in, const __grid_constant__ Act act) {
  __shared__ double part[kWarps][kMostSums];
  const int64_t place = blockIdx.x;
  act(MovingBody<T>{in, place / in.bodies, static_cast<int32_t>(place % in.bodies)}, BlockTeam{part});
}
template <class T, class Act>
cudaError_t for_bodies(const MotionInputs<T>& in, const Act& act, cudaStream_t stream) {
  const auto blocks = static_cast<unsigned>(in.scenes * in.bodies);
  if (blocks > 0) each_body<T><<<blocks, kThreads, 0, stream>>>(in, act);
  return cudaGetLastError();
}

template <class T>
struct Find {
  T *rigid, *displacements, *sums;
  __device__ void operator()(const MovingBody<T>& b, const BlockTeam& team) const {
    contact::find_motion(b, team, rigid, displacements, sums);
  }
};
template <class T>
struct IslandRadius {
  RadiusInputs<T> in;
  RadiusWork<T> work;
  __device__ void operator()(const MovingBody<T>& b, const BlockTeam& team) const {
    radius_beside_island(in, b, team, work);
  }
};

template <class T>
struct IslandTranslation {
  RadiusInputs<T> in;
  RadiusWork<T> work;
  __device__ void operator()(const MovingBody<T>& b, const BlockTeam& team) const {
    write_translation(in, b, team, work);
  }
};

// A block for each scene.
template <class T, bool first>
__global__ void __launch_bounds__(kThreads)
    each_scene(const __grid_constant__ RadiusInputs<T> in, const __grid_constant__ RadiusWork<T> work) {
  __shared__ double part[kWarps][kMostSums];
  if constexpr (first) {
    prepare_scene(in, blockIdx.x, BlockTeam{part}, work);
  } else {
    finish_radii(in, blockIdx.x, BlockTeam{part}, work);
  }
}

// A thread for each body.
template <class T>
__global__ void __launch_bounds__(kThreads)
    radii_alone(const __grid_constant__ RadiusInputs<T> in, const __grid_constant__ RadiusWork<T> work) {
  const int64_t place = own_item(kThreads), bodies = in.motion.bodies;
  if (place >= in.motion.scenes * bodies) return;
  radius_alone(in, place / bodies, static_cast<int32_t>(place % bodies), work);
}

// All radii of a small scene, by a block with a warp for each of its bodies in turn.
template <class T>
__global__ void __launch_bounds__(kThreads)
    radii_of_scene(const __grid_constant__ RadiusInputs<T> in, const __grid_constant__ RadiusWork<T> work,
                   const __grid_constant__ IslandWork<T> of_islands) {
  __shared__ double part[kWarps][kMostSums];
  const SceneIslands<T> islands{in.islands, of_islands, blockIdx.x, islands_memory<T>()};
  const BlockTeam team{part};
  const int64_t scene = blockIdx.x;
  const auto for_each_body = [&](const auto& f) {
    const auto body = [&](int32_t b) { return MovingBody<T>{in.motion, scene, b}; };
    each_body_of(
        in.motion.bodies, team, [&](int32_t b) { return body(b).size(); },
        [&](int32_t b, const auto& by) { f(body(b), by); });
    __syncthreads();
  };
  prepare_scene(in, scene, team, work);
  __syncthreads();
  islands.each(in.motion.bodies, [&](int32_t body) { radius_alone(in, scene, body, work); });
  __syncthreads();
  islands.bound();
  islands.find(work.island);
  for_each_body([&](const MovingBody<T>& b, const auto& by) { radius_beside_island(in, b, by, work); });
  islands.find(work.island);
  for_each_body([&](const MovingBody<T>& b, const auto& by) { write_translation(in, b, by, work); });
  finish_radii(in, scene, team, work);
}

}  // namespace

template <class T>
cudaError_t find_motion(const MotionInputs<T>& in, T* rigid, T* displacements, T* sums, cudaStream_t stream) {
  return for_bodies(in, Find<T>{rigid, displacements, sums}, stream);
}

template <class T>
cudaError_t find_trust_radii(RadiusInputs<T> in, const RadiusWork<T>& work, void* islands, cudaStream_t stream) {
  const auto scenes = static_cast<unsigned>(in.motion.scenes);
  const int64_t bodies = in.motion.scenes * in.motion.bodies;
  if (scenes == 0) return cudaSuccess;
  in.islands.trust_radius = work.trust_radius;
  const int64_t of_scene = in.motion.bodies;
  if (0 < of_scene && of_scene <= kMostOfBlock && in.motion.vertices <= kSmallScene &&
      in.islands.colliders() <= kSmallScene) {
    radii_of_scene<T><<<scenes, kThreads, 0, stream>>>(in, work, IslandWork<T>(in.islands, islands));
    return cudaGetLastError();
  }
  each_scene<T, true><<<scenes, kThreads, 0, stream>>>(in, work);
  if (bodies > 0) {
    radii_alone<T><<<blocks_for(bodies, kThreads), kThreads, 0, stream>>>(in, work);
    if (const auto error = find_islands(in.islands, work.island, islands, stream)) return error;
    if (const auto error = for_bodies(in.motion, IslandRadius<T>{in, work}, stream)) return error;
    if (const auto error = find_islands(in.islands, work.island, islands, stream, true)) return error;
    if (const auto error = for_bodies(in.motion, IslandTranslation<T>{in, work}, stream)) return error;
  }
  each_scene<T, false><<<scenes, kThreads, 0, stream>>>(in, work);
  return cudaGetLastError();
}

DIFFVBD_INSTANTIATE(find_motion)
DIFFVBD_INSTANTIATE(find_trust_radii)

}  // namespace diffvbd::cuda
