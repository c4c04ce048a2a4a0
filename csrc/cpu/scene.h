// One scene in sweep order, and the loads that turn its arrays into the algorithm's blocks and stars.
#pragma once

#include <cstdlib>
#include <memory>
#include <new>

#include "../sweep/vertex.h"
#include "lanes.h"

namespace diffvbd {

template <class T>
class Buffer {
 public:
  Buffer() = default;
  explicit Buffer(size_t size, bool zeroed = false) {
    const size_t bytes = (size * sizeof(T) + 63) / 64 * 64;
    if (bytes == 0) return;
    data_.reset(static_cast<T*>(std::aligned_alloc(64, bytes)));
    if (!data_) throw std::bad_alloc();
    if (zeroed) std::memset(data_.get(), 0, bytes);
  }
  T* get() const { return data_.get(); }

 private:
  struct Free {
    void operator()(T* p) const { std::free(p); }
  };
  std::unique_ptr<T[], Free> data_;
};

template <class T>
struct SceneView {
  T* x;               // [blocks kLanes, 4]  positions, rows of one cache half-line, so that a gather touches one line
  const T* y;         // [blocks, 3, kLanes]
  const T* x_prev;    // [blocks, 3, kLanes] or null
  const T* origin;    // [blocks, 3, kLanes] or null
  const T* mass;      // [blocks, kLanes]
  const T* material;  // [slots, kMaterialScalars, kLanes]: gathered once a step, read in every sweep; null: no tets
  const T* rest;      // [slots, kPairRest, kLanes]
  const T* data;      // energies: per-scene ones (count), per-vertex ones (vertices, stride), in the order of the list
  int64_t data_start[kVertexEnergies];
  int data_count[kVertexEnergies];
  T* tape;          // [sweeps, rows, active]
  T* contact;       // [blocks, kContactScalars, kLanes] or null: what contact adds to the blocks
  T* gradient;      // [blocks kLanes, 4] of the potential, for a coarse correction
  T* displacement;  // [blocks kLanes, 4] along which one goes; in the reverse what the gradient is multiplied with,
  T* wanted;        // and along which one wanted to go

  // reverse only
  T* x_bar;         // [blocks kLanes, 4]
  T* y_bar;         // [blocks, 3, kLanes]
  T* x_prev_bar;    // [blocks, 3, kLanes] or null
  T* mass_bar;      // [blocks, kLanes]
  T* rows;          // [edge_slots kLanes + 1, 4]  what the latest reversed update of a vertex adds to a neighbour
  T* material_bar;  // [slots, kMaterialScalars, kLanes] or null
  T* rest_bar;      // [slots, kPairRest, kLanes] or null
  T* data_bar;      // [kMaxEnergyData, blocks kLanes] or null
  T* limit;         // [blocks, kLanes] or null: what limits let through of the update that is reversed
  T* turn;          // [blocks, 6, kLanes]: p and d_raw of the latest reversed update; or null
};

template <class T>
DIFFVBD_FN Vec3<Lanes<T>> load3(const T* p, int64_t block) {
  const T* a = p + block * 3 * kLanes;
  return {Lanes<T>::load(a), Lanes<T>::load(a + kLanes), Lanes<T>::load(a + 2 * kLanes)};
}
template <class T>
DIFFVBD_FN void add3(T* p, int64_t block, const Vec3<Lanes<T>>& v) {
  T* a = p + block * 3 * kLanes;
  (Lanes<T>::load(a) + v.x).store(a);
  (Lanes<T>::load(a + kLanes) + v.y).store(a + kLanes);
  (Lanes<T>::load(a + 2 * kLanes) + v.z).store(a + 2 * kLanes);
}
template <class T>
DIFFVBD_FN Vec3<Lanes<T>> gather3(const T* rows, const int32_t* index) {
  Row<T> r[kLanes];
  for (int l = 0; l < kLanes; ++l) r[l] = Row<T>::load(rows + index[l]);
  return to_lanes(r);
}
template <class T>
DIFFVBD_FN Vec3<Lanes<T>> load_rows(const T* rows, int64_t block) {
  Row<T> r[kLanes];
  for (int l = 0; l < kLanes; ++l) r[l] = Row<T>::load(rows + 4 * (block * kLanes + l));
  return to_lanes(r);
}
template <class T>
DIFFVBD_FN void store_rows(T* rows, int64_t block, const Vec3<Lanes<T>>& v) {
  Row<T> r[kLanes];
  to_rows(v, r);
  for (int l = 0; l < kLanes; ++l) r[l].store(rows + 4 * (block * kLanes + l));
}

// The incident tets of the kLanes vertices of a block.
template <class T>
struct LaneStar {
  const Plan& plan;
  const SceneView<T>& s;
  int64_t first;
  int count;
  T* edges;    // [edges of the block, kLanes, 4], reverse only
  int wishes;  // Wanted: of the adjoints that every variant has, those to be stored

  DIFFVBD_FN LaneStar(const Plan& p, const SceneView<T>& scene, int64_t block, T* edge_rows = nullptr)
      : plan(p),
        s(scene),
        first(p.block_slot[block]),
        count(scene.material ? p.block_slot[block + 1] - p.block_slot[block] : 0),
        edges(edge_rows),
        wishes((scene.material_bar ? kMaterial : 0) | (scene.rest_bar ? kRest : 0)) {}
  DIFFVBD_FN int size() const { return count; }
  template <class... R>
  DIFFVBD_FN void total(R&...) const {}  // one lane visits the whole star
  template <class M>
  DIFFVBD_FN bool any(const M& condition) const {
    return diffvbd::any(condition);
  }
  DIFFVBD_FN void rewind() const {}
  DIFFVBD_FN void adopt(const LaneStar&) const {}
  DIFFVBD_FN const Vec3<Lanes<T>>& predictor(const Block<Lanes<T>>& b) const { return b.y; }
  DIFFVBD_FN const ContactTerm<Lanes<T>>& contact(const Block<Lanes<T>>& b) const { return b.contact; }

  DIFFVBD_FN TetPair<Lanes<T>> pair(int e) const {
    const int64_t slot = first + e;
    const int32_t* j = plan.neighbors + slot * 3 * kLanes;
    const T* r = s.rest + slot * kPairRest * kLanes;
    const T* m = s.material + slot * kMaterialScalars * kLanes;
    TetPair<Lanes<T>> out;
    out.xj = gather3(s.x, j);
    out.xk = gather3(s.x, j + kLanes);
    out.xl = gather3(s.x, j + 2 * kLanes);
    each_below<kPairRest>([&](auto i)
                              DIFFVBD_INLINE { out.rest[decltype(i)::value] = Lanes<T>::load(r + i * kLanes); });
    if constexpr (TetLayout::reads_material) {
      each_below<kMaterialScalars>(
          [&](auto i) DIFFVBD_INLINE { out.material[decltype(i)::value] = Lanes<T>::load(m + i * kLanes); });
    }
    return out;
  }

  // Adds to the rows of the edges to one neighbour of each lane. The tets of a vertex share neighbours, so a row is
  // summed in the nearest cache and leaves it once; it has one writer, the lane's vertex.
  DIFFVBD_FN void scatter(const int32_t* edge, const Vec3<Lanes<T>>& v) const {
    Row<T> r[kLanes];
    to_rows(v, r);
    for (int l = 0; l < kLanes; ++l) {
      T* a = edges + edge[l];
      r[l].v += Row<T>::load(a).v;
      r[l].store(a);
    }
  }
  DIFFVBD_FN LaneStar local() const { return *this; }
  // A loop for each wish; the rest of a variant serves them all.
  template <class Law, int>
  DIFFVBD_FN Vec3<Lanes<T>> reverse_tets(const Reversed<Lanes<T>>& update) const {
    if (wishes & kRest) return diffvbd::reverse_tets<Law, kMaterial | kRest>(*this, update);
    if (wishes & kMaterial) return diffvbd::reverse_tets<Law, kMaterial>(*this, update);
    return diffvbd::reverse_tets<Law, kState>(*this, update);
  }
  template <class Law, int>
  DIFFVBD_FN Vec3<Lanes<T>> multiply_tets(const Vec3<Lanes<T>>& x, const Vec3<Lanes<T>>& w,
                                          const Lanes<T>& minus_h2) const {
    if (wishes & kRest) return diffvbd::multiply_tets<Law, kMaterial | kRest>(*this, x, w, minus_h2);
    if (wishes & kMaterial) return diffvbd::multiply_tets<Law, kMaterial>(*this, x, w, minus_h2);
    return diffvbd::multiply_tets<Law, kState>(*this, x, w, minus_h2);
  }
  DIFFVBD_FN PairDisplacement<Lanes<T>> displacement(int e) const {
    const int32_t* j = plan.neighbors + (first + e) * 3 * kLanes;
    return {gather3(s.displacement, j), gather3(s.displacement, j + kLanes), gather3(s.displacement, j + 2 * kLanes)};
  }
  template <int wanted>
  DIFFVBD_FN bool wants(int what) const {
    return (wanted & wishes & what) != 0;
  }
  DIFFVBD_FN static void accumulate(T* p, const Lanes<T>& v) { (Lanes<T>::load(p) + v).store(p); }

  DIFFVBD_FN void add(int e, const TetAdjoint<Lanes<T>>& a) const {
    const int32_t* edge = plan.edge + (first + e) * 3 * kLanes;
    scatter(edge, a.xj);
    scatter(edge + kLanes, a.xk);
    scatter(edge + 2 * kLanes, a.xl);
  }
  DIFFVBD_FN void add_material(int e, const Lanes<T>* bar) const {
    T* to = s.material_bar + (first + e) * kMaterialScalars * kLanes;
    each_below<kMaterialScalars>([&](auto i) DIFFVBD_INLINE { accumulate(to + i * kLanes, bar[decltype(i)::value]); });
  }
  DIFFVBD_FN void add_rest(int e, const Lanes<T>* bar) const {
    T* to = s.rest_bar + (first + e) * kPairRest * kLanes;
    each_below<kPairRest>([&](auto i) DIFFVBD_INLINE { accumulate(to + i * kLanes, bar[decltype(i)::value]); });
  }
};

// What the neighbours' updates have added to the block's vertices since their last turn (reverse). Every neighbour is
// updated once between two turns and rewrites its rows, so nothing is left over.
template <class T>
DIFFVBD_FN Vec3<Lanes<T>> pull_rows(const Plan& plan, const T* rows, int64_t block) {
  Row<T> sum[kLanes] = {};
  for (int64_t e = plan.block_incoming[block]; e < plan.block_incoming[block + 1]; ++e) {
    for (int l = 0; l < kLanes; ++l) {
      sum[l].v += Row<T>::load(rows + plan.incoming[e * kLanes + l]).v;
    }
  }
  return to_lanes(sum);
}

// Zeroes and returns the rows that the block's own updates are about to write.
template <class T>
DIFFVBD_FN T* fresh_rows(const Plan& plan, T* rows, int64_t block) {
  const int64_t first = plan.block_edge[block], count = plan.block_edge[block + 1] - first;
  T* out = rows + first * kLanes * 4;
  std::memset(out, 0, static_cast<size_t>(count) * kLanes * 4 * sizeof(T));
  return out;
}

// `values` holds the energies' data for as long as the block is used.
template <class Set, class T>
DIFFVBD_FN Block<Lanes<T>> load_block(const Plan& plan, const SceneView<T>& s, int64_t block,
                                      const StepParameters<T>& q, Lanes<T>* values) {
  using R = Lanes<T>;
  Block<R> out;
  out.state.x = load_rows(s.x, block);
  out.state.x_prev = zero3<R>();
  out.state.origin = zero3<R>();
  if constexpr (Set::reads_x_prev) out.state.x_prev = load3(s.x_prev, block);
  if constexpr (Set::of_vertices) {
    if (s.origin) out.state.origin = load3(s.origin, block);
  }
  out.state.h = R(q.time_step);
  out.y = load3(s.y, block);
  out.mass = R::load(s.mass + block * kLanes);
  Set::for_each([&](auto energy, int k) {
    using E = decltype(energy);
    out.data[k] = values;
    out.data_count[k] = s.data_count[k];
    const T* data = s.data + s.data_start[k];
    for (int i = 0; i < out.data_count[k]; ++i) {
      R& value = *values++;
      if constexpr (E::per_vertex) {
        for (int l = 0; l < kLanes; ++l) {
          const int32_t vertex = plan.order[block * kLanes + l];
          value.v[l] = vertex < 0 ? T(0) : data[static_cast<int64_t>(vertex) * E::stride + i];
        }
      } else {
        value = R(data[i]);
      }
    }
  });
  if constexpr (Set::contact) {
    const T* at = s.contact + block * kContactScalars * kLanes;
    const auto get = [&] {
      const R value = R::load(at);
      at += kLanes;
      return value;
    };
    ContactTerm<R>& c = out.contact;
    c.g = {get(), get(), get()};
    c.H = {get(), get(), get(), get(), get(), get()};
  }
  return out;
}

}  // namespace diffvbd
