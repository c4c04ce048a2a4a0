#include <torch/csrc/stable/ops.h>

#include <algorithm>
#include <cmath>
#include <utility>
#include <vector>

#include "../contact/rigid_tries.h"
#include "contact_rigid.h"

namespace diffvbd {

using namespace contact;
using rigid::Body, rigid::Vector;

namespace {

constexpr double kRounded = 1e-6;  // of a length, that rounding cannot reach

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
    find_near();
    before_ = potential(false, [&](const PairPress& a) {
      if (a.body[0] >= 0 && a.body[1] >= 0) touching_.emplace_back(a.body[0], a.body[1]);
    });
  }

  // state: shares and flags of all units, as the test of a pair takes them. motions [V]: memory.
  void run(AdvanceState<T> state, std::vector<Motion<T>>& motions) {
    const int32_t n = in_.bodies();
    state.motion = motions.data() - scene_ * in_.scene.vertices;
    std::fill_n(share_, n, 1.0);
    for (int attempt = 0; attempt < kTries; ++attempt) {
      displace();
      for (int64_t v = 0; v < in_.scene.vertices; ++v) {
        motions[v] = motion_of(in_.gate, state, scene_ * in_.scene.vertices + v);
      }
      const bool fits = test(state);
      const double after = fits ? potential(true, [](const PairPress&) {}) : 0;
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
  // The listed pairs that some share of the motions may bring within reach of their barrier. A gap shrinks by no more
  // than its sides have moved since it was taken.
  void find_near() {
    std::vector<double> farthest(in_.bodies(), 0.0);  // that a vertex of each body may be from where it was then
    std::vector<T> size(in_.bodies(), T(0));          // of positions, which rounding is measured by
    for (int32_t k = 0; k < in_.bodies(); ++k) {
      const Body<T> body{in_.scene, scene_, k};
      const Vector center = vector_of(center_ + 3 * k);
      const double *turn = motion_ + kUnknowns * k, *shift = turn + 3;
      const double angle = std::hypot(turn[0], turn[1], turn[2]), way = std::hypot(shift[0], shift[1], shift[2]);
      for (int32_t i = 0; i < body.size(); ++i) {
        const Vector x = body.position(body.vertex(i)), arm = x - center;
        const Vector since = x - Body<T>::at(in_.gate.center + 3 * body.row(body.vertex(i)));
        const double far = std::sqrt(dot(since, since)) + way + angle * std::sqrt(dot(arm, arm));
        farthest[k] = std::max(farthest[k], (1 + kRounded) * far);
        const Vec3<T> at = point_at(in_.gate.x, body.row(body.vertex(i)));
        const Vec3<T> from = in_.gate.origin ? point_at(in_.gate.origin, body.row(body.vertex(i))) : zero3<T>();
        size[k] = std::max(size[k], size_of(at + from));
      }
    }
    for (int64_t i = in_.first_listed(scene_); i < in_.first_listed(scene_ + 1); ++i) {
      if (!is_between(in_, i)) continue;
      const int32_t* record = in_.gate.listed.pairs + kPairRow * i;
      const T* constants = in_.gate.constants + kConstants * i;
      const int32_t a = in_.gate.body[record[0]], b = in_.gate.body[record[sides(record[4])]];
      const bool known = a < in_.bodies() && b < in_.bodies();  // whose gap is of the time of the centers
      const double gap = PairHints<T>(constants).gap - PairConstants<T>(constants).dhat;
      const double room = known ? gap - guard_of_size(std::max(size[a], size[b])) : gap;  // as stays_far()
      if (!known || !(farthest[a] + farthest[b] < (1 - kRounded) * room)) near_.push_back(i);
    }
  }
  // Of all bodies, where they are or would go; calls f(press) for each listed pair that pushes.
  template <class F>
  double potential(bool moved, const F& f) const {
    double value = 0;
    for (int32_t k = 0; k < in_.bodies(); ++k) {
      const Body<T> body{in_.scene, scene_, k};
      double own = 0;
      for (int32_t i = 0; in_.free[k] && i < body.size(); ++i) own += vertex_value(in_, body, body.vertex(i), moved);
      value += own;
    }
    const CornerPoints<T> at{in_, moved};
    PairPress press;
    for (const int64_t i : near_) {
      if (!barrier_press(in_, i, at, press)) continue;
      value += press.value;
      f(press);
    }
    for (int64_t i = in_.first_lagged(scene_); i < in_.first_lagged(scene_ + 1); ++i) {
      if (lagged_press(in_, i, at, Slid{}, press, -1)) value += press.value;
    }
    return value;
  }
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
    for (const int64_t i : near_) try_pair(in_.gate, state, i, 0);
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
  std::vector<int64_t> near_;
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
    std::vector<Motion<T>> motions(in.scene.vertices);
    for (int64_t s = begin; s < end; ++s) {
      Tries<T>(in, s, center + 3 * n * s, motion + kUnknowns * n * s, move, share + n * s).run(state, motions);
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
