// Records of the pairs of a vertex, prefetched: a warp that waited for each would wait most of the time.
#pragma once

#include "lane_layout.cuh"

namespace diffvbd::cuda {

// Record of a (vertex, tet) pair.
template <class T>
struct PairRecord {
  int where;  // indices of the other corners among the vertex's neighbours
  T rest[kRestRow], material[kMaterialScalars];
};

// Records of a vertex: each thread has lane, lane + lanes, ... One record is prefetched in registers; in the reverse
// with few threads, one or three in the warp's shared memory, which saves registers.
template <class T, int lanes_, bool reverse>
class Records {
 public:
  static constexpr int lanes = threads_of(lanes_);
  static constexpr bool staged = has_stages(lanes_, reverse);
  using P = LaneLayout<lanes_>;

  const StepView<T>& s;
  const P& at;
  bool repeats = false;  // whether the star is visited again

  // slots: of the vertex's block; stages: shared memory of the warp
  __device__ __forceinline__ Records(const StepView<T>& s, const P& at, const Span& slots, T* stages)
      : s(s), at(at), stages_(stages), first_(slots.begin), count_(s.has_tets ? slots.end - slots.begin : 0) {
    if (s.one_material) {
#pragma unroll
      for (int m = 0; m < kMaterialScalars; ++m) {
        next_.material[m] = __ldg(s.material[m].data + at.scene * s.material[m].scene);
      }
    }
    begin();
  }

  // Scalars of the stages.
  __device__ __forceinline__ int shared_scalars() const { return staged ? s.stages * stage_scalars<T>() : 0; }
  __device__ __forceinline__ int count() const { return count_; }
  __device__ __forceinline__ int size() const { return (count_ + lanes - 1) / lanes; }
  __device__ __forceinline__ bool real(int e) const { return e * lanes + at.lane < count_; }
  // A thread without a pair takes the slot of padding.
  __device__ __forceinline__ int64_t slot(int e) const {
    const int own = e * lanes + at.lane;
    return static_cast<int64_t>(own < count_ ? first_ + own : s.plan.slots - 1) * kSlice;
  }

  // Starts a visit. A copy has the same stages: it must make whole visits with the same `repeats`, which restore them.
  __device__ __forceinline__ void begin() const {
    if (!s.has_tets) return;
    if constexpr (staged) {
      wait<0>();
      asked_ = taken_ = 0;
      for (int e = 0; e < s.stages - 1; ++e) {
        if (e < size()) ask(e);
        commit();
      }
    } else {
      fetch(0);
    }
  }
  // Called for e = 0, 1, ..., size() - 1 in each visit.
  __device__ __forceinline__ PairRecord<T> take(int e) const {
    if constexpr (staged) {
      if (s.stages == kManyStages && size() >= kManyStages - 1) {
        wait<kManyStages - 2>();
      } else {
        wait<0>();
      }
      const PairRecord<T> now = read(taken_++);
      const int ahead = e + min(s.stages - 1, size());
      if (ahead < size()) {
        ask(ahead);
      } else if (repeats) {
        ask(ahead - size());
      }
      commit();
      return now;
    } else {
      const PairRecord<T> now = next_;
      if (e + 1 < size()) {
        fetch(e + 1);
      } else if (repeats) {
        fetch(0);
      }
      return now;
    }
  }

 private:
  static constexpr int width = Pack<T>::size;
  // A material is copied in packs if it is a whole number of them.
  struct One {
    T v[1];
  };
  using Part = std::conditional_t<kMaterialScalars % width == 0, Pack<T>, One>;
  static constexpr int kParts = kMaterialScalars / (sizeof(Part) / sizeof(T));

  __device__ __forceinline__ const T* rest_of(int64_t base) const {
    return s.rest.data + at.scene * s.rest.scene + base * kRestRow + at.v * width;
  }
  __device__ __forceinline__ const T* material_of(int64_t base) const {
    return s.w.material + at.scene * s.material_scene + (base + at.v) * kMaterialScalars;
  }
  __device__ __forceinline__ void fetch(int e) const {
    const int64_t base = slot(e);
    next_.where = __ldg(s.plan.local + base + at.v);
    const T* rest = rest_of(base);
#pragma unroll
    for (int i = 0; i < kRestRow; i += width) {
      const Pack<T> part = load_constant(rest + i * kSlice);
#pragma unroll
      for (int k = 0; k < width; ++k) next_.rest[i + k] = part.v[k];
    }
    if (s.one_material) return;
    const T* m = material_of(base);
#pragma unroll
    for (int i = 0; i < kMaterialScalars; ++i) next_.material[i] = __ldg(m + i);
  }

  // Stage: rest row in packs, material, and where, of all threads.
  __device__ __forceinline__ T* stage(int number) const {
    return stages_ + (number & (s.stages - 1)) * stage_scalars<T>();
  }
  template <class U>
  __device__ __forceinline__ static void copy(U* to, const U* from) {
    const auto shared = static_cast<unsigned>(__cvta_generic_to_shared(to));
    asm volatile("cp.async.ca.shared.global [%0], [%1], %2;" ::"r"(shared), "l"(from), "n"(sizeof(U)) : "memory");
  }
  __device__ __forceinline__ static void commit() { asm volatile("cp.async.commit_group;" ::: "memory"); }
  template <int left>
  __device__ __forceinline__ static void wait() {
    asm volatile("cp.async.wait_group %0;" ::"n"(left) : "memory");
  }
  __device__ __forceinline__ void ask(int e) const {
    const auto thread = static_cast<int>(threadIdx.x % kSlice);
    T* to = stage(asked_++);
    const int64_t base = slot(e);
    const T* rest = rest_of(base);
#pragma unroll
    for (int i = 0; i < kRestRow; i += width) {
      copy(reinterpret_cast<Pack<T>*>(to + i * kSlice + thread * width),
           reinterpret_cast<const Pack<T>*>(rest + i * kSlice));
    }
    to += kRestRow * kSlice;
    if (!s.one_material) {
      const auto* m = reinterpret_cast<const Part*>(material_of(base));
#pragma unroll
      for (int i = 0; i < kParts; ++i) copy(reinterpret_cast<Part*>(to) + i * kSlice + thread, m + i);
    }
    copy(reinterpret_cast<int32_t*>(to + kMaterialScalars * kSlice) + thread, s.plan.local + base + at.v);
  }
  __device__ __forceinline__ PairRecord<T> read(int number) const {
    const auto thread = static_cast<int>(threadIdx.x % kSlice);
    const T* from = stage(number);
    PairRecord<T> out;
#pragma unroll
    for (int i = 0; i < kRestRow; i += width) {
      const Pack<T> part = *reinterpret_cast<const Pack<T>*>(from + i * kSlice + thread * width);
#pragma unroll
      for (int k = 0; k < width; ++k) out.rest[i + k] = part.v[k];
    }
    from += kRestRow * kSlice;
    const auto* parts = reinterpret_cast<const Part*>(from) + thread;
#pragma unroll
    for (int i = 0; i < kMaterialScalars; ++i) {
      if (s.one_material) {
        out.material[i] = next_.material[i];
      } else {
        out.material[i] = parts[i * kParts / kMaterialScalars * kSlice].v[i % (kMaterialScalars / kParts)];
      }
    }
    out.where = reinterpret_cast<const int32_t*>(from + kMaterialScalars * kSlice)[thread];
    return out;
  }

  T* stages_;
  int first_, count_;
  mutable int asked_ = 0, taken_ = 0;  // stages
  mutable PairRecord<T> next_;         // the next pair; its material in a scene with one material
};

}  // namespace diffvbd::cuda
