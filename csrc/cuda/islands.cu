#include <algorithm>

#include "common.cuh"
#include "islands.cuh"

namespace diffvbd::cuda {
namespace {

constexpr int kWarp = 32, kLongSegment = 512;  // threads for a sum of fewer terms on average; otherwise kThreads
constexpr int32_t kCompared = 32;              // bodies that a thread compares with one

int threads_for(int64_t items, int64_t segments) { return items > kLongSegment * segments ? kThreads : kWarp; }

template <class T>
__global__ void start_kernel(const IslandInputs<T> in, IslandWork<T> work) {
  const int64_t i = own_item();
  if (i < in.scenes * in.colliders()) bound_nothing(work, i);
  if (i < in.scenes) work.objects[i] = 0;
}

// Each body is an island.
template <class T>
__global__ void apart_kernel(const IslandInputs<T> in, IslandWork<T> work) {
  const int64_t i = own_item();
  if (i < in.scenes * in.mesh_bodies) {
    work.label[i] = static_cast<int32_t>(i % in.mesh_bodies);
    work.stays[i] = false;
  }
  if (i < in.scenes) work.unsettled[i] = 0;
}

template <class T>
__global__ void colliders_kernel(const IslandInputs<T> in, IslandWork<T> work) {
  const int64_t i = own_item();
  if (i >= in.scenes * in.colliders()) return;
  const int64_t scene = i / in.colliders();
  bound_collider(in, work, scene, static_cast<int32_t>(i - scene * in.colliders()));
}

template <class T>
__global__ void planes_kernel(const IslandInputs<T> in, IslandWork<T> work) {
  const int64_t i = own_item();
  if (i >= in.scenes * in.num_planes) return;
  const int64_t scene = i / in.num_planes;
  unbound_plane(in, work, scene, static_cast<int32_t>(i - scene * in.num_planes));
}

// A block for each body.
template <class T>
__global__ void bodies_sync_kernel(const IslandInputs<T> in, IslandWork<T> work) {
  __shared__ BodySum<T> part[kThreads];
  const int64_t scene = blockIdx.x / in.mesh_bodies;
  const auto body = static_cast<int32_t>(blockIdx.x - scene * in.mesh_bodies);
  BodySum<T> own = nothing<T>();
  for (int32_t k = in.body_ptr[body] + static_cast<int32_t>(threadIdx.x); k < in.body_ptr[body + 1];
       k += static_cast<int32_t>(blockDim.x)) {
    own.add(vertex_sum(in, scene, in.body_order[k]));
  }
  const BodySum<T> sum = block_sum(own, part, [](BodySum<T>& a, const BodySum<T>& b) { a.add(b); });
  if (threadIdx.x == 0) work.bodies[blockIdx.x] = sum;
}

// A block for each island; blocks of other bodies do nothing.
template <class T>
__global__ void islands_sync_kernel(const IslandInputs<T> in, IslandWork<T> work) {
  __shared__ BodySum<T> part[kThreads];
  const int64_t first = blockIdx.x / in.mesh_bodies * in.mesh_bodies;
  const auto body = static_cast<int32_t>(blockIdx.x - first);
  if (work.label[blockIdx.x] != body) return;
  BodySum<T> own = nothing<T>();
  for (auto k = static_cast<int32_t>(threadIdx.x); k < in.mesh_bodies; k += static_cast<int32_t>(blockDim.x)) {
    if (work.label[first + k] == body) own.add(body_of(work, first + k));
  }
  const BodySum<T> sum = block_sum(own, part, [](BodySum<T>& a, const BodySum<T>& b) { a.add(b); });
  if (threadIdx.x == 0) work.islands[blockIdx.x] = sum;
}

template <class T>
__global__ void sweep_kernel(const IslandInputs<T> in, IslandWork<T> work) {
  const int64_t i = own_item();
  if (i < in.scenes * in.mesh_bodies) sweep_body(in, work, i, work.label[i]);
}

// A thread for each body and tile of other bodies: joins islands that overlap; the last round only reports them.
template <class T>
__global__ void join_kernel(const IslandInputs<T> in, IslandWork<T> work, bool joins) {
  const int32_t n = in.mesh_bodies;
  const int64_t tiles = (n + kCompared - 1) / kCompared, item = own_item();
  if (item >= in.scenes * tiles * n) return;
  const int64_t row = item / n, scene = row / tiles, first = scene * n;
  const auto i = static_cast<int32_t>(item - row * n), tile = static_cast<int32_t>(row - scene * tiles) * kCompared;
  const Bounds<T> box = work.boxes[first + i];
  int32_t* label = work.label + first;
  for (int32_t j = tile > i ? tile : i + 1; j < n && j < tile + kCompared; ++j) {
    if (!overlap(box, work.boxes[first + j]) || root_of(label, i) == root_of(label, j)) continue;
    if (joins) {
      unite(label, i, j);
    } else {
      work.unsettled[scene] = 1;
    }
  }
}

template <class T>
__global__ void label_kernel(const IslandInputs<T> in, IslandWork<T> work) {
  const int64_t i = own_item();
  if (i >= in.scenes * in.mesh_bodies) return;
  const int64_t scene = i / in.mesh_bodies, first = scene * in.mesh_bodies;
  work.label[i] = work.unsettled[scene] ? 0 : root_of(work.label + first, static_cast<int32_t>(i - first));
}

template <class T>
__global__ void finish_kernel(const IslandInputs<T> in, IslandWork<T> work, int32_t* island) {
  const int64_t i = own_item();
  if (i >= in.scenes * in.mesh_bodies) return;
  const int64_t first = i / in.mesh_bodies * in.mesh_bodies;
  island[i] = work.islands[first + work.label[i]].blocked ? -1 : work.label[i];
}

// All islands of a scene of few bodies, by a block.
template <class T>
__global__ void __launch_bounds__(kThreads)
    scene_sync_kernel(const __grid_constant__ IslandInputs<T> in, const __grid_constant__ IslandWork<T> work,
                      int32_t* island) {
  SceneIslands<T>{in, work, blockIdx.x, islands_memory<T>()}.find(island);
}

}  // namespace

template <class T>
size_t islands_workspace_bytes(const IslandInputs<T>& in) {
  return IslandWork<T>(in, nullptr).bytes;
}

template <class T>
cudaError_t find_islands(const IslandInputs<T>& in, int32_t* island, void* memory, cudaStream_t stream, bool again) {
  const IslandWork<T> work(in, memory);
  const int64_t n = in.scenes * in.mesh_bodies, points = in.scenes * in.colliders();
  if (n == 0) return cudaSuccess;
  const auto blocks = static_cast<unsigned>(n);
  if (!again) {
    start_kernel<<<blocks_for(std::max(points, in.scenes), kThreads), kThreads, 0, stream>>>(in, work);
    if (points > 0) colliders_kernel<<<blocks_for(points, kThreads), kThreads, 0, stream>>>(in, work);
    if (in.num_planes > 0)
      planes_kernel<<<blocks_for(in.scenes * in.num_planes, kThreads), kThreads, 0, stream>>>(in, work);
    bodies_sync_kernel<<<blocks, threads_for(in.vertices, in.mesh_bodies), 0, stream>>>(in, work);
  }
  if (in.mesh_bodies <= kFewBodies) {
    scene_sync_kernel<<<static_cast<unsigned>(in.scenes), kThreads, 0, stream>>>(in, work, island);
    return cudaGetLastError();
  }
  apart_kernel<<<blocks_for(n, kThreads), kThreads, 0, stream>>>(in, work);
  const int64_t comparisons = n * ((in.mesh_bodies + kCompared - 1) / kCompared);
  // One round more than the joins: it detects that they have not settled, and then makes the scene one island.
  for (int round = 0; round <= kJoins; ++round) {
    islands_sync_kernel<<<blocks, kWarp, 0, stream>>>(in, work);
    sweep_kernel<<<blocks_for(n, kThreads), kThreads, 0, stream>>>(in, work);
    join_kernel<<<blocks_for(comparisons, kThreads), kThreads, 0, stream>>>(in, work, round < kJoins);
    label_kernel<<<blocks_for(n, kThreads), kThreads, 0, stream>>>(in, work);
  }
  islands_sync_kernel<<<blocks, kWarp, 0, stream>>>(in, work);
  sweep_kernel<<<blocks_for(n, kThreads), kThreads, 0, stream>>>(in, work);
  islands_sync_kernel<<<blocks, kWarp, 0, stream>>>(in, work);
  finish_kernel<<<blocks_for(n, kThreads), kThreads, 0, stream>>>(in, work, island);
  return cudaGetLastError();
}

DIFFVBD_INSTANTIATE(islands_workspace_bytes)
DIFFVBD_INSTANTIATE(find_islands)

}  // namespace diffvbd::cuda
