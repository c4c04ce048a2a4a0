#include <torch/csrc/stable/ops.h>

#include <algorithm>
#include <numeric>
#include <utility>
#include <vector>

#include "../contact/limit.h"
#include "../subspace/contact_rigid.h"
#include "contact_rigid.h"

namespace diffvbd {

using namespace contact;
using rigid::Body, rigid::Vector;

namespace {

template <class T>
class Trials {
 public:
  Trials(const RigidInputs<T>& in, int64_t scene, const double* center, const double* motion, T* move, double* fraction)
      : in_(in),
        scene_(scene),
        center_(center),
        motion_(motion),
        move_(move),
        fraction_(fraction),
        lead_(in.bodies()),
        low_(in.bodies()),
        decided_(in.bodies(), 0) {
    std::iota(lead_.begin(), lead_.end(), 0);
    find_near();
    leave_what_rests();
    before_ = potentials(false, [&](const PairForce& a) {
      if (a.body[0] >= 0 && a.body[1] >= 0) touching_.emplace_back(a.body[0], a.body[1]);
    });
  }

  // state: fractions and flags of all units, for the test of a pair. motions [V]: memory.
  void run(AdvanceState<T> state, std::vector<Motion<T>>& motions) {
    const int32_t n = in_.bodies();
    state.motion = motions.data() - scene_ * in_.scene.vertices;
    std::fill_n(fraction_, n, 1.0);
    for (int attempt = 0; attempt < kTrials; ++attempt) {
      each_open([&](int32_t k) { displace(k); });
      each_vertex([&](int64_t row) {
        const auto v = static_cast<int32_t>(row - scene_ * in_.scene.vertices);
        motions[v] = motion_of(in_.gate, state, scene_, v);
      });
      const std::vector<uint8_t> stopped = test(state);
      const std::vector<double> after = potentials(true, [](const PairForce&) {});
      const uint8_t* blocked = state.blocked + scene_ * n;
      bool open = false;
      each_open([&](int32_t k) {
        const int32_t of = lead_[k];
        if (is_safe(before_[of], after[of], !stopped[of])) {
          decided_[k] = 1;
        } else {
          low_[k] = shortened(blocked[k], !stopped[of], attempt), open = true;
        }
      });
      if (!open) return;
      for (int spread = 0; spread < kSpreads; ++spread) {
        std::vector<double> next = low_;  // from one to the next only, whatever their order
        for (const auto& [a, b] : touching_) {
          const double both = std::min(low_[a], low_[b]);
          next[a] = std::min(next[a], both), next[b] = std::min(next[b], both);
        }
        low_ = next;
      }
      each_open([&](int32_t k) { fraction_[k] *= low_[k]; });
    }
    each_open([&](int32_t k) { fraction_[k] = 0, displace(k); });
  }

 private:
  // Calls f(body) for those that have not decided yet.
  template <class F>
  void each_open(const F& f) const {
    for (int32_t k = 0; k < in_.bodies(); ++k)
      if (!decided_[k]) f(k);
  }
  template <class F>
  void each_vertex(const F& f) const {  // of theirs
    each_open([&](int32_t k) {
      const Body<T> body{in_.scene, scene_, k};
      for (int32_t i = 0; i < body.size(); ++i) f(body.row(body.vertex(i)));
    });
  }
  int32_t lead_of(int32_t body) {
    while (lead_[body] != body) body = lead_[body] = lead_[lead_[body]];
    return body;
  }
  // The bodies that a pair moves with decide together.
  void join(const int32_t* record) {
    const int32_t a = moving_body(in_, record[0]), b = moving_body(in_, record[sides(record[4])]);
    if (a < 0 || b < 0) return;
    const int32_t first = lead_of(a), second = lead_of(b);
    lead_[std::max(first, second)] = std::min(first, second);
  }
  // The listed pairs that may touch, and which bodies decide together.
  void find_near() {
    std::vector<double> displacement(in_.bodies(), 0.0), size(in_.bodies(), 0.0),
        own_displacement(in_.scene.vertices, 0.0);
    for (int32_t k = 0; k < in_.bodies(); ++k) {
      const Body<T> body{in_.scene, scene_, k};
      for (int32_t i = 0; i < body.size(); ++i) {
        const Farthest own = farthest_of(in_, body, body.vertex(i), center_ + 3 * k, motion_ + kUnknowns * k);
        own_displacement[body.vertex(i)] = own.displacement;
        displacement[k] = larger(displacement[k], own.displacement), size[k] = larger(size[k], own.size);
      }
    }
    for (int64_t i = in_.first_listed(scene_); i < in_.first_listed(scene_ + 1); ++i) {
      if (!may_touch(in_, i, displacement.data(), size.data())) continue;
      join(listed(i));
      if (may_touch_by(i, own_displacement, size)) near_.push_back(i);
    }
    for (int64_t i = in_.first_lagged(scene_); i < in_.first_lagged(scene_ + 1); ++i) {
      if (Lag<T>(in_.lag + kLagScalars * i).active()) join(lagged(i));
    }
    for (int32_t k = 0; k < in_.bodies(); ++k) lead_[k] = lead_of(k);
  }
  // Bodies that decide together and have no motion have decided.
  void leave_what_rests() {
    std::vector<uint8_t> moves(in_.bodies(), 0);
    for (int32_t k = 0; k < in_.bodies(); ++k) {
      const double* own = motion_ + kUnknowns * k;
      if (std::any_of(own, own + kUnknowns, [](double a) { return a != 0; })) moves[lead_[k]] = 1;
    }
    for (int32_t k = 0; k < in_.bodies(); ++k) {
      if (moves[lead_[k]]) continue;
      decided_[k] = 1, fraction_[k] = 1;
      displace(k);
    }
  }
  // Whether a pair that may touch by the motions of its bodies may touch by those of its corners.
  bool may_touch_by(int64_t pair, const std::vector<double>& displacement, const std::vector<double>& size) const {
    const int32_t* record = listed(pair);
    const T* constants = in_.gate.constants + kConstants * pair;
    const int32_t a = in_.gate.body[record[0]], b = in_.gate.body[record[sides(record[4])]];
    if (a >= in_.bodies() || b >= in_.bodies()) return true;
    const double gap = PairHints<T>(constants).gap - PairConstants<T>(constants).dhat;
    const double slack = gap - guard_of_size(static_cast<T>(std::max(size[a], size[b])));
    return !(most_closed(record, in_.gate.vertices, displacement.data()) < (1 - kRounded) * slack);
  }
  const int32_t* listed(int64_t i) const { return in_.gate.listed.pairs + kPairRow * i; }
  const int32_t* lagged(int64_t i) const { return in_.lagged.pairs + kPairRow * i; }
  // The first of the bodies that a pair moves with, if they have yet to decide; or -1.
  int32_t open_lead_of(const int32_t* record) const {
    const int32_t body = owner_of(in_, record);
    return body >= 0 && !decided_[body] ? lead_[body] : -1;
  }
  // Of bodies that decide together, by their first one: now or after the trial. Calls f(term) for each listed pair
  // that pushes.
  template <class F>
  std::vector<double> potentials(bool moved, const F& f) const {
    std::vector<double> out(in_.bodies(), 0.0);
    each_open([&](int32_t k) {
      const Body<T> body{in_.scene, scene_, k};
      double own = 0;
      for (int32_t i = 0; in_.free[k] && i < body.size(); ++i) own += vertex_value(in_, body, body.vertex(i), moved);
      out[lead_[k]] += own;
    });
    const CornerPoints<T> at{in_, moved};
    PairForce term;
    for (const int64_t i : near_) {
      const int32_t of = open_lead_of(listed(i));
      if (of < 0 || !barrier_force(in_, i, at, term)) continue;
      out[of] += term.value;
      f(term);
    }
    for (int64_t i = in_.first_lagged(scene_); i < in_.first_lagged(scene_ + 1); ++i) {
      const int32_t of = open_lead_of(lagged(i));
      if (0 <= of && lagged_force(in_, i, at, BodyMotions{}, term, -1)) out[of] += term.value;
    }
    return out;
  }
  void displace(int32_t k) const {
    const Body<T> body{in_.scene, scene_, k};
    const Vector center = vector_at(center_ + 3 * k);
    for (int32_t i = 0; i < body.size(); ++i) {
      const int32_t v = body.vertex(i);
      const Vector d = displaced(motion_ + kUnknowns * k, fraction_[k], body.position(v) - center);
      put(move_ + 3 * body.row(v), d);
    }
  }
  // Marks blocked bodies; and whether any is, of those that decide together, by their first one.
  std::vector<uint8_t> test(const AdvanceState<T>& state) {
    uint8_t* blocked = state.blocked + scene_ * in_.bodies();
    std::vector<uint8_t> out(in_.bodies(), 0);
    std::fill_n(blocked, in_.bodies(), uint8_t{0});
    for (const int64_t i : near_) {
      if (open_lead_of(listed(i)) >= 0) test_pair(in_.gate, state, i, 0);
    }
    each_open([&](int32_t k) {
      const Body<T> body{in_.scene, scene_, k};
      for (int32_t i = 0; in_.free[k] && i < body.size(); ++i) {
        stay(in_.gate, state, scene_, body.vertex(i), 0);
        if (!admitted(in_, body, body.vertex(i))) blocked[k] = 1;
      }
      if (blocked[k]) out[lead_[k]] = 1;
    });
    return out;
  }

  const RigidInputs<T>& in_;
  const int64_t scene_;
  const double *center_, *motion_;
  T* move_;
  double* fraction_;
  std::vector<int32_t> lead_;  // the first of the bodies that decide together
  std::vector<double> low_, before_;
  std::vector<uint8_t> decided_;
  std::vector<int64_t> near_;
  std::vector<std::pair<int32_t, int32_t>> touching_;
};

}  // namespace

template <class T>
void rigid_move(const RigidInputs<T>& in, const double* center, const double* motion, T* move,
                const RigidOutcome<T>& out, T* x) {
  const int64_t n = in.bodies(), units = in.gate.units();
  std::vector<T> none(units, T(0)), all(units, T(1));
  std::vector<uint8_t> blocked(units), stamp(units), failed(in.scene.scenes);
  const AdvanceState<T> state{none.data(), all.data(), blocked.data(), stamp.data(), failed.data(), false};
  torch::stable::parallel_for(0, in.scene.scenes, 1, [&](int64_t begin, int64_t end) {
    std::vector<Motion<T>> motions(in.scene.vertices);
    for (int64_t s = begin; s < end; ++s) {
      const int64_t first = 3 * s * in.scene.vertices, last = first + 3 * in.scene.vertices;
      const double* own = motion + kUnknowns * n * s;
      if (std::all_of(own, own + kUnknowns * n, [](double a) { return a == 0; })) {
        std::fill_n(out.fraction + n * s, n, 1.0);
        std::copy(in.scene.x + first, in.scene.x + last, x + first);
      } else {
        Trials<T>(in, s, center + 3 * n * s, own, move, out.fraction + n * s).run(state, motions);
        for (int64_t i = first; i < last; ++i) x[i] = in.scene.x[i] + move[i];
      }
      bool some = false;
      for (int64_t unit = n * s; unit < n * (s + 1); ++unit) some = finish_trials(in, motion, unit, out) || some;
      if (!some) std::fill_n(out.blocked + n * s, n, false);
    }
  });
}

#define DIFFVBD_INSTANTIATE(T) \
  template void rigid_move<T>(const RigidInputs<T>&, const double*, const double*, T*, const RigidOutcome<T>&, T*);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)

}  // namespace diffvbd
