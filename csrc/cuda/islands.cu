#include <cstring>
#include <type_traits>

#include "block_sum.cuh"
#include "islands.h"
#include "ordered.cuh"
#include "union.cuh"

namespace diffvbd::cuda {
namespace {

using namespace contact;

constexpr int kThreads = 256;
constexpr int kWarp = 32, kLongSegment = 512;  // threads for a sum of fewer terms on average; above, kThreads
constexpr int32_t kTile = 32;                  // bodies that one thread compares with one
constexpr int32_t kFewBodies = 512;            // of a scene, up to which a block finds all its islands
constexpr size_t kAlignment = 256;

unsigned blocks_for(int64_t items) { return static_cast<unsigned>((items + kThreads - 1) / kThreads); }
int threads_for(int64_t items, int64_t segments) { return items > kLongSegment * segments ? kThreads : kWarp; }

__device__ __forceinline__ int64_t own_item() { return static_cast<int64_t>(blockIdx.x) * blockDim.x + threadIdx.x; }

// Views of the workspace; without memory, its size.
template <class T>
struct Workspace {
  BodySum<T>*bodies, *islands;  // [B, bodies]; of islands, at their smallest body
  Bounds<T>* boxes;             // [B, bodies] swept
  int32_t* label;               // [B, bodies] toward the smallest body of the island
  bool* stays;                  // [B, bodies] bodies that must, as the rooms are
  int32_t* unsettled;           // [B]
  Ordered<T> (*colliders)[6];   // [B, Vc] boxes of collider objects, as ordered bits
  int32_t* objects;             // how many of those there are
  size_t bytes = 0;

  Workspace(const IslandInputs<T>& in, void* memory) {
    auto* at = static_cast<unsigned char*>(memory);
    const auto take = [&](auto*& pointer, int64_t items) {
      pointer = reinterpret_cast<std::remove_reference_t<decltype(pointer)>>(at + bytes);
      bytes += (items * sizeof(*pointer) + kAlignment - 1) / kAlignment * kAlignment;
    };
    const int64_t n = in.scenes * in.mesh_bodies;
    take(bodies, n), take(islands, n), take(boxes, n), take(label, n), take(stays, n);
    take(unsettled, in.scenes);
    take(colliders, in.scenes * in.colliders()), take(objects, 1);
  }
};

template <class T>
__global__ void start_kernel(const IslandInputs<T> in, Workspace<T> work) {
  const int64_t i = own_item();
  if (i < in.scenes * in.colliders()) {
    const T far = std::numeric_limits<T>::infinity();
    for (int k = 0; k < 6; ++k) work.colliders[i][k] = ordered(k < 3 ? far : -far);
  }
  if (i == 0) *work.objects = 0;
}

// Each body is an island.
template <class T>
__global__ void apart_kernel(const IslandInputs<T> in, Workspace<T> work) {
  const int64_t i = own_item();
  if (i < in.scenes * in.mesh_bodies) {
    work.label[i] = static_cast<int32_t>(i % in.mesh_bodies);
    work.stays[i] = false;
  }
  if (i < in.scenes) work.unsettled[i] = 0;
}

template <class T>
__global__ void colliders_kernel(const IslandInputs<T> in, Workspace<T> work) {
  const int64_t i = own_item();
  if (i >= in.scenes * in.colliders()) return;
  const int64_t scene = i / in.colliders();
  const auto j = static_cast<int32_t>(i - scene * in.colliders());
  const int32_t object = in.body[in.vertices + j] - in.mesh_bodies;
  raise(work.objects, object + 1);
  const Bounds<T> box = collider_bounds(in, scene, j);
  Ordered<T>* bits = work.colliders[scene * in.colliders() + object];
  lower(bits, ordered(box.lo.x)), lower(bits + 1, ordered(box.lo.y)), lower(bits + 2, ordered(box.lo.z));
  raise(bits + 3, ordered(box.hi.x)), raise(bits + 4, ordered(box.hi.y)), raise(bits + 5, ordered(box.hi.z));
}

// The points of a plane span it; they bound nothing.
template <class T>
__global__ void planes_kernel(const IslandInputs<T> in, Workspace<T> work) {
  const int64_t i = own_item();
  if (i >= in.scenes * in.num_planes) return;
  const int64_t scene = i / in.num_planes;
  const int32_t object = in.body[in.planes[3 * (i - scene * in.num_planes)]] - in.mesh_bodies;
  const T far = std::numeric_limits<T>::infinity();
  for (int k = 0; k < 6; ++k) work.colliders[scene * in.colliders() + object][k] = ordered(k < 3 ? far : -far);
}

// A block for each body.
template <class T>
__global__ void bodies_sync_kernel(const IslandInputs<T> in, Workspace<T> work) {
  __shared__ BodySum<T> part[kThreads];
  const int64_t scene = blockIdx.x / in.mesh_bodies;
  const auto body = static_cast<int32_t>(blockIdx.x - scene * in.mesh_bodies);
  BodySum<T> own = nothing<T>();
  for (int32_t k = in.body_ptr[body] + static_cast<int32_t>(threadIdx.x); k < in.body_ptr[body + 1];
       k += static_cast<int32_t>(blockDim.x)) {
    own.add(vertex_share(in, scene, in.body_order[k]));
  }
  const BodySum<T> sum = block_sum(own, part, [](BodySum<T>& a, const BodySum<T>& b) { a.add(b); });
  if (threadIdx.x == 0) work.bodies[blockIdx.x] = sum;
}

template <class T>
__device__ BodySum<T> body_of(const Workspace<T>& work, int64_t i) {
  BodySum<T> out = work.bodies[i];
  out.blocked = out.blocked || work.stays[i];
  return out;
}

// A block for each island, those of other bodies have nothing to do.
template <class T>
__global__ void islands_sync_kernel(const IslandInputs<T> in, Workspace<T> work) {
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

// What a body sweeps, and whether it must stay from now on.
template <class T>
__device__ void sweep_body(const IslandInputs<T>& in, const Workspace<T>& work, int64_t i, int32_t label) {
  const int64_t scene = i / in.mesh_bodies, first = scene * in.mesh_bodies;
  const Bounds<T> box = swept(in, work.bodies[i].bounds, translation(work.islands[first + label]),
                              in.margin(scene, static_cast<int32_t>(i - first)));
  work.boxes[i] = box;
  bool blocked = false;
  for (int32_t object = 0; object < *work.objects && !blocked; ++object) {
    const Ordered<T>* bits = work.colliders[scene * in.colliders() + object];
    const auto at = [&](int k) { return value_of<T>(bits[k]); };
    blocked = overlap(box, Bounds<T>{{at(0), at(1), at(2)}, {at(3), at(4), at(5)}});
  }
  for (int32_t l = 0; l < in.num_planes && !blocked; ++l) blocked = reaches_plane(in, scene, l, box);
  if (blocked) work.stays[i] = true;
}

template <class T>
__global__ void sweep_kernel(const IslandInputs<T> in, Workspace<T> work) {
  const int64_t i = own_item();
  if (i < in.scenes * in.mesh_bodies) sweep_body(in, work, i, work.label[i]);
}

// A thread for each body and each tile of others: joins their islands, or says in the end that they would have to be.
template <class T>
__global__ void join_kernel(const IslandInputs<T> in, Workspace<T> work, bool joins) {
  const int32_t n = in.mesh_bodies;
  const int64_t tiles = (n + kTile - 1) / kTile, item = own_item();
  if (item >= in.scenes * tiles * n) return;
  const int64_t row = item / n, scene = row / tiles, first = scene * n;
  const auto i = static_cast<int32_t>(item - row * n), tile = static_cast<int32_t>(row - scene * tiles) * kTile;
  const Bounds<T> box = work.boxes[first + i];
  int32_t* label = work.label + first;
  for (int32_t j = tile > i ? tile : i + 1; j < n && j < tile + kTile; ++j) {
    if (!overlap(box, work.boxes[first + j]) || root_of(label, i) == root_of(label, j)) continue;
    if (joins) {
      unite(label, i, j);
    } else {
      work.unsettled[scene] = 1;
    }
  }
}

template <class T>
__global__ void label_kernel(const IslandInputs<T> in, Workspace<T> work) {
  const int64_t i = own_item();
  if (i >= in.scenes * in.mesh_bodies) return;
  const int64_t scene = i / in.mesh_bodies, first = scene * in.mesh_bodies;
  work.label[i] = work.unsettled[scene] ? 0 : root_of(work.label + first, static_cast<int32_t>(i - first));
}

template <class T>
__global__ void finish_kernel(const IslandInputs<T> in, Workspace<T> work, int32_t* island) {
  const int64_t i = own_item();
  if (i >= in.scenes * in.mesh_bodies) return;
  const int64_t first = i / in.mesh_bodies * in.mesh_bodies;
  island[i] = work.islands[first + work.label[i]].blocked ? -1 : work.label[i];
}

// All of it for a scene of few bodies: a block.
template <class T>
__global__ void __launch_bounds__(kThreads)
    scene_sync_kernel(const IslandInputs<T> in, Workspace<T> work, int32_t* island) {
  __shared__ int32_t label[kFewBodies];
  // of islands; then what bodies sweep
  constexpr size_t kBytes = kThreads * sizeof(BodySum<T>), kBoxes = kFewBodies * sizeof(Bounds<T>);
  __shared__ __align__(16) unsigned char memory[kBytes < kBoxes ? kBoxes : kBytes];
  auto* part = reinterpret_cast<BodySum<T>*>(memory);
  auto* boxes = reinterpret_cast<Bounds<T>*>(memory);
  const int32_t n = in.mesh_bodies;
  const int64_t first = int64_t{blockIdx.x} * n;
  const auto each = [&](int32_t count, const auto& f) {
    for (auto i = static_cast<int32_t>(threadIdx.x); i < count; i += kThreads) f(i);
    __syncthreads();
  };
  const auto sum = [&] {  // a warp for each island
    const auto lane = static_cast<int32_t>(threadIdx.x % kWarp);
    for (auto i = static_cast<int32_t>(threadIdx.x / kWarp); i < n; i += kThreads / kWarp) {
      if (label[i] != i) continue;
      BodySum<T> own = nothing<T>();
      for (int32_t j = i + lane; j < n; j += kWarp) {
        if (label[j] == i) own.add(body_of(work, first + j));
      }
      part[threadIdx.x] = own;
      for (int32_t half = kWarp / 2; half > 0; half /= 2) {
        __syncwarp();
        if (lane < half) part[threadIdx.x].add(part[threadIdx.x + half]);
      }
      if (lane == 0) work.islands[first + i] = part[threadIdx.x];
      __syncwarp();
    }
    __syncthreads();
  };
  bool changes = false, unsettled = false;  // as a thread sees it
  const auto sweep = [&] {
    each(n, [&](int32_t i) {
      const bool stayed = work.stays[first + i];
      sweep_body(in, work, first + i, label[i]);
      changes = changes || work.stays[first + i] != stayed;
    });
  };
  each(n, [&](int32_t i) { label[i] = i, work.stays[first + i] = false; });
  for (int round = 0; round <= kJoins; ++round) {
    changes = false;
    sum(), sweep();
    each(n, [&](int32_t i) { boxes[i] = work.boxes[first + i]; });
    for (auto i = static_cast<int32_t>(threadIdx.x / kWarp); i < n; i += kThreads / kWarp) {
      for (int32_t j = i + 1 + static_cast<int32_t>(threadIdx.x % kWarp); j < n; j += kWarp) {
        if (!overlap(boxes[i], boxes[j]) || root_of(label, i) == root_of(label, j)) continue;
        changes = true;
        if (round < kJoins) {
          unite(label, i, j);
        } else {
          unsettled = true;
        }
      }
    }
    if (!__syncthreads_or(changes)) break;  // nor will the next round
    const bool one = __syncthreads_or(unsettled);
    static_assert(kFewBodies % kThreads == 0);
    int32_t root[kFewBodies / kThreads];  // all are read before any is written
    for (int k = 0; k < kFewBodies / kThreads; ++k) {
      const auto i = static_cast<int32_t>(threadIdx.x) + k * kThreads;
      root[k] = one || n <= i ? 0 : root_of(label, i);
    }
    __syncthreads();
    for (int k = 0; k < kFewBodies / kThreads; ++k) {
      const auto i = static_cast<int32_t>(threadIdx.x) + k * kThreads;
      if (i < n) label[i] = root[k];
    }
    __syncthreads();
  }
  sum(), sweep(), sum();
  each(n, [&](int32_t i) { island[first + i] = work.islands[first + label[i]].blocked ? -1 : label[i]; });
}

}  // namespace

template <class T>
size_t islands_workspace_bytes(const IslandInputs<T>& in) {
  return Workspace<T>(in, nullptr).bytes;
}

template <class T>
cudaError_t find_islands(const IslandInputs<T>& in, int32_t* island, void* memory, cudaStream_t stream, bool again) {
  const Workspace<T> work(in, memory);
  const int64_t n = in.scenes * in.mesh_bodies, points = in.scenes * in.colliders();
  if (n == 0) return cudaSuccess;
  const auto blocks = static_cast<unsigned>(n);
  if (!again) {
    start_kernel<<<blocks_for(points > 0 ? points : 1), kThreads, 0, stream>>>(in, work);
    if (points > 0) colliders_kernel<<<blocks_for(points), kThreads, 0, stream>>>(in, work);
    if (in.num_planes > 0) planes_kernel<<<blocks_for(in.scenes * in.num_planes), kThreads, 0, stream>>>(in, work);
    bodies_sync_kernel<<<blocks, threads_for(in.vertices, in.mesh_bodies), 0, stream>>>(in, work);
  }
  if (in.mesh_bodies <= kFewBodies) {
    scene_sync_kernel<<<static_cast<unsigned>(in.scenes), kThreads, 0, stream>>>(in, work, island);
    return cudaGetLastError();
  }
  apart_kernel<<<blocks_for(n), kThreads, 0, stream>>>(in, work);
  const int64_t comparisons = n * ((in.mesh_bodies + kTile - 1) / kTile);
  // One round more than the joins: it finds out whether they have settled, and if not makes one island of the scene.
  for (int round = 0; round <= kJoins; ++round) {
    islands_sync_kernel<<<blocks, kWarp, 0, stream>>>(in, work);
    sweep_kernel<<<blocks_for(n), kThreads, 0, stream>>>(in, work);
    join_kernel<<<blocks_for(comparisons), kThreads, 0, stream>>>(in, work, round < kJoins);
    label_kernel<<<blocks_for(n), kThreads, 0, stream>>>(in, work);
  }
  islands_sync_kernel<<<blocks, kWarp, 0, stream>>>(in, work);
  sweep_kernel<<<blocks_for(n), kThreads, 0, stream>>>(in, work);
  islands_sync_kernel<<<blocks, kWarp, 0, stream>>>(in, work);
  finish_kernel<<<blocks_for(n), kThreads, 0, stream>>>(in, work, island);
  return cudaGetLastError();
}

#define DIFFVBD_INSTANTIATE(T)                                        \
  template size_t islands_workspace_bytes<T>(const IslandInputs<T>&); \
  template cudaError_t find_islands<T>(const IslandInputs<T>&, int32_t*, void*, cudaStream_t, bool);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd::cuda
