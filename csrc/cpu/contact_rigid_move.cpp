#include <torch/csrc/stable/ops.h>

#include <algorithm>
#include <utility>
#include <vector>

#include "../contact/rigid_slip.h"
#include "contact_rigid.h"

namespace diffvbd {

using namespace contact;
using rigid::Body, rigid::Vector;

namespace {

// Calls f(press, pair, whether it is a lagged one) for each pair of a scene that acts.
template <class T, class F>
void each_press(const RigidInputs<T>& in, int64_t scene, bool moved, const F& f) {
  const CornerPoints<T> at{in, moved};
  PairPress press;
  for (int64_t i = in.first_listed(scene); i < in.first_listed(scene + 1); ++i) {
    if (barrier_press(in, i, at, press)) f(press, false);
  }
  for (int64_t i = in.first_lagged(scene); i < in.first_lagged(scene + 1); ++i) {
    if (lagged_press(in, i, at, Slid{}, press, -1)) f(press, true);
  }
}

template <class T>
double potential_of(const RigidInputs<T>& in, int64_t scene, bool moved) {
  double value = 0;
  for (int32_t k = 0; k < in.bodies(); ++k) {
    const Body<T> body{in.scene, scene, k};
    double own = 0;
    for (int32_t i = 0; in.free[k] && i < body.size(); ++i) own += vertex_value(in, body, body.vertex(i), moved);
    value += own;
  }
  each_press(in, scene, moved, [&](const PairPress& a, bool) { value += a.value; });
  return value;
}

template <class T>
class Tries {
 public:
  Tries(const RigidInputs<T>& in, int64_t scene, const double* center, const double* motion, T* move, double* share)
      : in_(in),
        scene_(scene),
        center_(center),
        motion_(motion),
        move_(move),
        share_(share),
        low_(in.bodies()),
        blocked_(in.bodies()) {
    each_press(in, scene, false, [&](const PairPress& a, bool lagged) {
      before_ += a.value;
      if (!lagged && a.body[0] >= 0 && a.body[1] >= 0) touching_.emplace_back(a.body[0], a.body[1]);
    });
  }

  // T shares and flags of all units, as the test of a pair takes them
  void run(const AdvanceState<T>& state) {
    const int32_t n = in_.bodies();
    for (int32_t k = 0; k < n; ++k) {
      const Body<T> body{in_.scene, scene_, k};
      double own = 0;
      for (int32_t i = 0; in_.free[k] && i < body.size(); ++i) own += vertex_value(in_, body, body.vertex(i), false);
      before_ += own;
    }
    std::fill_n(share_, n, 1.0);
    for (int attempt = 0; attempt < kTries; ++attempt) {
      displace();
      const bool fits = test(state);
      const double after = fits ? potential_of(in_, scene_, true) : 0;
      if (is_safe(before_, after, fits)) return;
      for (int32_t k = 0; k < n; ++k) low_[k] = shortened(blocked_[k], fits, attempt);
      for (int spread = 0; spread < kSpreads; ++spread) {
        std::vector<double> next = low_;  // from one to the next only, whatever their order
        for (const auto& [a, b] : touching_) {
          const double both = std::min(low_[a], low_[b]);
          next[a] = std::min(next[a], both), next[b] = std::min(next[b], both);
        }
        low_ = next;
      }
      for (int32_t k = 0; k < n; ++k) share_[k] *= low_[k];
    }
    std::fill_n(share_, n, 0.0);
    displace();
  }

 private:
  void displace() const {
    for (int32_t k = 0; k < in_.bodies(); ++k) {
      const Body<T> body{in_.scene, scene_, k};
      const Vector center = vector_of(center_ + 3 * k);
      for (int32_t i = 0; i < body.size(); ++i) {
        const int32_t v = body.vertex(i);
        const Vector d = displaced(motion_ + kUnknowns * k, share_[k], body.position(v) - center);
        rigid::put(move_ + 3 * body.row(v), d);
      }
    }
  }
  bool test(const AdvanceState<T>& state) {
    uint8_t* blocked = state.blocked + scene_ * in_.bodies();
    std::fill_n(blocked, in_.bodies(), uint8_t{0});
    for (int64_t i = in_.first_listed(scene_); i < in_.first_listed(scene_ + 1); ++i) {
      if (is_between(in_, i)) try_pair(in_.gate, state, i, 0);
    }
    for (int32_t k = 0; k < in_.bodies(); ++k) {
      const Body<T> body{in_.scene, scene_, k};
      for (int32_t i = 0; in_.free[k] && i < body.size(); ++i) {
        stay(in_.gate, state, body.row(body.vertex(i)), 0);
        if (!admitted(in_, body, body.vertex(i))) blocked[k] = 1;
      }
    }
    std::copy_n(blocked, in_.bodies(), blocked_.begin());
    return std::find(blocked_.begin(), blocked_.end(), 1) == blocked_.end();
  }

  const RigidInputs<T>& in_;
  const int64_t scene_;
  const double *center_, *motion_;
  T* move_;
  double *share_, before_ = 0;
  std::vector<double> low_;
  std::vector<uint8_t> blocked_;
  std::vector<std::pair<int32_t, int32_t>> touching_;
};

}  // namespace

template <class T>
void rigid_move(const RigidInputs<T>& in, const double* center, const double* motion, T* move, double* share, T* x) {
  const int64_t n = in.bodies(), units = in.gate.units();
  std::vector<T> none(units, T(0)), all(units, T(1));
  std::vector<uint8_t> blocked(units), stamp(units), failed(in.scene.scenes);
  const AdvanceState<T> state{none.data(), all.data(), blocked.data(), stamp.data(), failed.data(), false};
  torch::stable::parallel_for(0, in.scene.scenes, 1, [&](int64_t begin, int64_t end) {
    for (int64_t s = begin; s < end; ++s) {
      Tries<T>(in, s, center + 3 * n * s, motion + kUnknowns * n * s, move, share + n * s).run(state);
      for (int64_t i = 3 * s * in.scene.vertices; i < 3 * (s + 1) * in.scene.vertices; ++i)
        x[i] = in.scene.x[i] + move[i];
    }
  });
}

#define DIFFVBD_INSTANTIATE(T) \
  template void rigid_move<T>(const RigidInputs<T>&, const double*, const double*, T*, double*, T*);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd
