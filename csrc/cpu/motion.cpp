#include "motion.h"

#include <torch/csrc/stable/ops.h>

#include <algorithm>
#include <numeric>
#include <vector>

#include "threads.h"

namespace diffvbd {

namespace {

using namespace contact;

constexpr int64_t kPairwise = 32;  // rows up to which a sum is a loop

// Islands of one scene after the other, with the same memory.
template <class T>
class SceneIslands {
 public:
  explicit SceneIslands(const IslandInputs<T>& in)
      : in_(in), bodies_(in.mesh_bodies), islands_(in.mesh_bodies), box_(in.mesh_bodies), label_(in.mesh_bodies) {}

  void run(int64_t scene, int32_t* island) {
    scene_ = scene;
    std::iota(label_.begin(), label_.end(), 0);
    sum_bodies();
    bound_colliders();
    for (int round = 0; round < kJoins; ++round) {
      sweep();
      join();
    }
    sweep();
    if (join()) {  // not settled
      std::fill(label_.begin(), label_.end(), 0);
      sweep();
    }
    for (int32_t i = 0; i < in_.mesh_bodies; ++i) island[i] = islands_[label_[i]].blocked ? -1 : label_[i];
  }

 private:
  void sum_bodies() {
    for (int32_t i = 0; i < in_.mesh_bodies; ++i) {
      bodies_[i] = nothing<T>();
      for (int32_t k = in_.body_ptr[i]; k < in_.body_ptr[i + 1]; ++k) {
        bodies_[i].add(vertex_sum(in_, scene_, in_.body_order[k]));
      }
    }
  }

  void bound_colliders() {
    colliders_.clear();
    for (int32_t j = 0; j < in_.colliders(); ++j) {
      const size_t object = in_.body[in_.vertices + j] - in_.mesh_bodies;
      if (colliders_.size() <= object) colliders_.resize(object + 1, no_bounds<T>());
      include(colliders_[object], collider_bounds(in_, scene_, j));
    }
    // The points of a plane span it; they bound nothing.
    for (int32_t l = 0; l < in_.num_planes; ++l) {
      colliders_[in_.body[in_.planes[3 * l]] - in_.mesh_bodies] = no_bounds<T>();
    }
  }

  // Sums of the islands, what their bodies sweep, and which of them must stay from now on.
  void sweep() {
    std::fill(islands_.begin(), islands_.end(), nothing<T>());
    for (int32_t i = 0; i < in_.mesh_bodies; ++i) islands_[label_[i]].add(bodies_[i]);
    for (int32_t i = 0; i < in_.mesh_bodies; ++i) {
      box_[i] = swept(bodies_[i].bounds, translation(islands_[label_[i]]), in_.margin(scene_, i));
    }
    for (int32_t i = 0; i < in_.mesh_bodies; ++i) {
      bool blocked = false;
      for (const Bounds<T>& collider : colliders_) blocked = blocked || overlap(box_[i], collider);
      blocked = blocked || reaches_any_plane(in_, scene_, box_[i]);
      if (blocked) bodies_[i].blocked = islands_[label_[i]].blocked = true;
    }
  }

  // Joins islands whose bodies' boxes overlap, found along x; whether there were any.
  bool join() {
    sorted_.clear();
    for (int32_t i = 0; i < in_.mesh_bodies; ++i) {
      if (box_[i].lo.x <= box_[i].hi.x) sorted_.push_back(i);
    }
    std::sort(sorted_.begin(), sorted_.end(),
              [&](int32_t i, int32_t j) { return box_[i].lo.x != box_[j].lo.x ? box_[i].lo.x < box_[j].lo.x : i < j; });
    bool joined = false;
    for (auto i = sorted_.begin(); i != sorted_.end(); ++i) {
      for (auto j = i + 1; j != sorted_.end() && box_[*j].lo.x <= box_[*i].hi.x; ++j) {
        if (!overlap(box_[*i], box_[*j])) continue;
        const int32_t a = root(*i), b = root(*j);
        if (a == b) continue;
        label_[std::max(a, b)] = std::min(a, b);
        joined = true;
      }
    }
    for (int32_t i = 0; i < in_.mesh_bodies; ++i) label_[i] = root(i);
    return joined;
  }

  int32_t root(int32_t i) {
    while (label_[i] != i) i = label_[i] = label_[label_[i]];
    return i;
  }

  const IslandInputs<T>& in_;
  int64_t scene_ = 0;
  std::vector<BodySum<T>> bodies_, islands_;  // islands: at their smallest body
  std::vector<Bounds<T>> box_, colliders_;
  std::vector<int32_t> label_, sorted_;
};

template <class T>
void add_rows(const T* values, const int32_t* order, int64_t n, int64_t c, T* sum) {
  if (n > kPairwise) {
    std::vector<T> half(c);
    add_rows(values, order, n / 2, c, sum);
    add_rows(values, order + n / 2, n - n / 2, c, half.data());
    for (int64_t k = 0; k < c; ++k) sum[k] += half[k];
    return;
  }
  std::fill(sum, sum + c, T(0));
  for (int64_t e = 0; e < n; ++e) {
    for (int64_t k = 0; k < c; ++k) sum[k] += values[order[e] * c + k];
  }
}

}  // namespace

template <class T>
void find_islands(const IslandInputs<T>& in, int32_t* island) {
  torch::stable::parallel_for(0, in.scenes, pieces_per_thread(in.vertices), [&](int64_t begin, int64_t end) {
    SceneIslands<T> islands(in);
    for (int64_t b = begin; b < end; ++b) islands.run(b, island + b * in.mesh_bodies);
  });
}

template <class T>
void segment_sum(const T* values, const int32_t* order, const int32_t* ptr, int64_t scenes, int64_t items,
                 int64_t segments, int64_t c, T* out) {
  const int64_t grain = pieces_per_thread(segments > 0 ? items / segments : 0);
  const auto sum = [&](int64_t i) {
    const int64_t scene = i / segments, s = i - scene * segments;
    add_rows(values + scene * items * c, order + ptr[s], ptr[s + 1] - ptr[s], c, out + i * c);
  };
  for_each(scenes * segments, sum, grain);
}

using namespace contact;

template <class T>
void find_motion(const MotionInputs<T>& in, T* rigid, T* displacements, T* sums) {
  for_bodies<MovingBody>(in, [&](const MovingBody<T>& b, const Threads& team) {
    contact::find_motion(b, team, rigid, displacements, sums);
  });
}

template <class T>
void find_trust_radii(RadiusInputs<T> in, const RadiusWork<T>& work) {
  const int64_t scenes = in.motion.scenes;
  const Threads one(false);
  in.islands.trust_radius = work.trust_radius;
  for (int64_t scene = 0; scene < scenes; ++scene) prepare_scene(in, scene, one, work);
  for (int64_t i = 0; i < scenes * in.motion.bodies; ++i) {
    radius_alone(in, i / in.motion.bodies, static_cast<int32_t>(i % in.motion.bodies), work);
  }
  find_islands(in.islands, work.island);
  for_bodies<MovingBody>(in.motion,
                         [&](const MovingBody<T>& b, const Threads& team) { radius_beside_island(in, b, team, work); });
  find_islands(in.islands, work.island);
  for_bodies<MovingBody>(in.motion,
                         [&](const MovingBody<T>& b, const Threads& team) { write_translation(in, b, team, work); });
  for (int64_t scene = 0; scene < scenes; ++scene) finish_radii(in, scene, one, work);
}

#define DIFFVBD_INSTANTIATE(T)                                                                                    \
  template void find_islands<T>(const IslandInputs<T>&, int32_t*);                                                \
  template void segment_sum<T>(const T*, const int32_t*, const int32_t*, int64_t, int64_t, int64_t, int64_t, T*); \
  template void find_motion<T>(const MotionInputs<T>&, T*, T*, T*);                                               \
  template void find_trust_radii<T>(RadiusInputs<T>, const RadiusWork<T>&);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)

}  // namespace diffvbd
