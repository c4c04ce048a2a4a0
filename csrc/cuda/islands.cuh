// Islands of the bodies of a scene: parts of the kernels, and all of it by one block.
#pragma once

#include "atomics.cuh"
#include "bodies.cuh"
#include "contact.h"
#include "warp_reduce.cuh"

namespace diffvbd::cuda {
namespace {

using namespace contact;

constexpr int32_t kFewBodies = 512;  // bodies of a scene up to which one block finds all islands

// Parts of the workspace; without memory, its size.
template <class T>
struct IslandWork {
  BodySum<T>*bodies, *islands;  // [B, bodies]; of islands, at their smallest body
  Bounds<T>* boxes;             // [B, bodies] swept
  int32_t* label;               // [B, bodies] toward the smallest body of the island
  bool* stays;                  // [B, bodies] bodies that must stay, with the current radii
  int32_t* unsettled;           // [B]
  Ordered<T> (*colliders)[6];   // [B, Vc] boxes of collider objects, as ordered bits
  int32_t* objects;             // [B] number of collider objects
  size_t bytes = 0;

  IslandWork(const IslandInputs<T>& in, void* memory) {
    Parts<> take(memory);
    const int64_t n = in.scenes * in.mesh_bodies;
    take(bodies, n), take(islands, n), take(boxes, n), take(label, n), take(stays, n);
    take(unsettled, in.scenes);
    take(colliders, in.scenes * in.colliders()), take(objects, in.scenes);
    bytes = take.bytes;
  }
};

// Makes the i-th box of a scene's collider objects empty.
template <class T>
__device__ void bound_nothing(const IslandWork<T>& work, int64_t i) {
  const T far = std::numeric_limits<T>::infinity();
  for (int k = 0; k < 6; ++k) work.colliders[i][k] = ordered(k < 3 ? far : -far);
}

// Adds the j-th point of a scene's colliders to the box of its object.
template <class T>
__device__ void bound_collider(const IslandInputs<T>& in, const IslandWork<T>& work, int64_t scene, int32_t j) {
  const int32_t object = in.body[in.vertices + j] - in.mesh_bodies;
  raise(work.objects + scene, object + 1);
  const Bounds<T> box = collider_bounds(in, scene, j);
  Ordered<T>* bits = work.colliders[scene * in.colliders() + object];
  lower(bits, ordered(box.lo.x)), lower(bits + 1, ordered(box.lo.y)), lower(bits + 2, ordered(box.lo.z));
  raise(bits + 3, ordered(box.hi.x)), raise(bits + 4, ordered(box.hi.y)), raise(bits + 5, ordered(box.hi.z));
}

// Planes have no box: their points only span them.
template <class T>
__device__ void unbound_plane(const IslandInputs<T>& in, const IslandWork<T>& work, int64_t scene, int32_t plane) {
  const int32_t object = in.body[in.planes[3 * plane]] - in.mesh_bodies;
  bound_nothing(work, scene * in.colliders() + object);
}

template <class T>
__device__ BodySum<T> body_of(const IslandWork<T>& work, int64_t i) {
  BodySum<T> out = work.bodies[i];
  out.blocked = out.blocked || work.stays[i];
  return out;
}

// Swept box of a body, and whether the body must stay from now on.
template <class T>
__device__ void sweep_body(const IslandInputs<T>& in, const IslandWork<T>& work, int64_t i, int32_t label) {
  const int64_t scene = i / in.mesh_bodies, first = scene * in.mesh_bodies;
  const Bounds<T> box = swept(work.bodies[i].bounds, translation(work.islands[first + label]),
                              in.margin(scene, static_cast<int32_t>(i - first)));
  work.boxes[i] = box;
  bool blocked = false;
  for (int32_t object = 0; object < work.objects[scene] && !blocked; ++object) {
    const Ordered<T>* bits = work.colliders[scene * in.colliders() + object];
    const auto at = [&](int k) { return value_of<T>(bits[k]); };
    blocked = overlap(box, Bounds<T>{{at(0), at(1), at(2)}, {at(3), at(4), at(5)}});
  }
  blocked = blocked || reaches_any_plane(in, scene, box);
  if (blocked) work.stays[i] = true;
}

// Islands of a scene of few bodies, by the threads of a block.
template <class T>
struct SceneIslands {
  // sums of islands; later swept boxes
  static constexpr size_t kBytes = kThreads * sizeof(BodySum<T>), kBoxes = kFewBodies * sizeof(Bounds<T>);
  struct Memory {
    int32_t label[kFewBodies];
    alignas(16) unsigned char bytes[kBytes < kBoxes ? kBoxes : kBytes];
  };

  const IslandInputs<T>& in;
  const IslandWork<T>& work;
  int64_t scene;
  Memory& memory;

  __device__ int64_t first() const { return scene * in.mesh_bodies; }
  __device__ BodySum<T>* part() const { return reinterpret_cast<BodySum<T>*>(memory.bytes); }
  template <class F>
  __device__ void each(int32_t count, const F& f) const {
    for (auto i = static_cast<int32_t>(threadIdx.x); i < count; i += kThreads) f(i);
    __syncthreads();
  }
  // Sum over the lanes of a warp; the first lane has it.
  __device__ BodySum<T> sum_of_warp(const BodySum<T>& own) const {
    const auto lane = static_cast<int32_t>(threadIdx.x % 32);
    BodySum<T>* const all = part() + threadIdx.x;
    *all = own;
    for (int32_t half = 16; half > 0; half /= 2) {
      __syncwarp();
      if (lane < half) all->add(all[half]);
    }
    return *all;
  }
  __device__ BodySum<T> sum_of(const Tile<32>&, const BodySum<T>& own) const { return sum_of_warp(own); }
  __device__ BodySum<T> sum_of(const BlockTeam&, const BodySum<T>& own) const {
    return block_sum(own, part(), [](BodySum<T>& to, const BodySum<T>& of) { to.add(of); });
  }
  // Bounds of bodies and colliders, which do not depend on radii: a warp for each body, or the block for large ones.
  __device__ void bound() const {
    each(in.colliders(), [&](int32_t j) { bound_nothing(work, scene * in.colliders() + j); });
    if (threadIdx.x == 0) work.objects[scene] = 0;
    __syncthreads();
    each(in.colliders(), [&](int32_t j) { bound_collider(in, work, scene, j); });
    each(in.num_planes, [&](int32_t k) { unbound_plane(in, work, scene, k); });
    const auto size = [&](int32_t b) { return in.body_ptr[b + 1] - in.body_ptr[b]; };
    each_body_of(in.mesh_bodies, BlockTeam{nullptr}, size, [&](int32_t b, const auto& by) {
      BodySum<T> own = nothing<T>();
      by.each(size(b), [&](int32_t k) { own.add(vertex_sum(in, scene, in.body_order[in.body_ptr[b] + k])); });
      const BodySum<T> sum = sum_of(by, own);
      if (by.leads()) work.bodies[first() + b] = sum;
      by.meet();
    });
    __syncthreads();
  }
  __device__ void sum() const {  // a warp for each island
    const auto lane = static_cast<int32_t>(threadIdx.x % 32);
    for (auto i = static_cast<int32_t>(threadIdx.x / 32); i < in.mesh_bodies; i += kWarps) {
      if (memory.label[i] != i) continue;
      BodySum<T> own = nothing<T>();
      for (int32_t j = i + lane; j < in.mesh_bodies; j += 32) {
        if (memory.label[j] == i) own.add(body_of(work, first() + j));
      }
      const BodySum<T> sum = sum_of_warp(own);
      if (lane == 0) work.islands[first() + i] = sum;
      __syncwarp();
    }
    __syncthreads();
  }
  // Whether a body of this thread stays that did not before.
  __device__ bool sweep() const {
    bool changes = false;
    each(in.mesh_bodies, [&](int32_t i) {
      const bool stayed = work.stays[first() + i];
      sweep_body(in, work, first() + i, memory.label[i]);
      changes = changes || work.stays[first() + i] != stayed;
    });
    return changes;
  }

  __device__ void find(int32_t* island) const {
    const int32_t n = in.mesh_bodies;
    int32_t* const label = memory.label;
    auto* const boxes = reinterpret_cast<Bounds<T>*>(memory.bytes);
    bool unsettled = false;  // of this thread
    each(n, [&](int32_t i) { label[i] = i, work.stays[first() + i] = false; });
    for (int round = 0; round <= kJoins; ++round) {
      sum();
      bool changes = sweep();
      each(n, [&](int32_t i) { boxes[i] = work.boxes[first() + i]; });
      for (auto i = static_cast<int32_t>(threadIdx.x / 32); i < n; i += kWarps) {
        for (int32_t j = i + 1 + static_cast<int32_t>(threadIdx.x % 32); j < n; j += 32) {
          if (!overlap(boxes[i], boxes[j]) || root_of(label, i) == root_of(label, j)) continue;
          changes = true;
          if (round < kJoins) {
            unite(label, i, j);
          } else {
            unsettled = true;
          }
        }
      }
      if (!__syncthreads_or(changes)) break;  // the next round would change nothing
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
    each(n, [&](int32_t i) { island[first() + i] = work.islands[first() + label[i]].blocked ? -1 : label[i]; });
  }
};

template <class T>
__device__ __forceinline__ typename SceneIslands<T>::Memory& islands_memory() {
  __shared__ typename SceneIslands<T>::Memory memory;
  return memory;
}

}  // namespace
}  // namespace diffvbd::cuda
