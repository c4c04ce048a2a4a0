#include "contact_rigid.h"

#include <torch/csrc/stable/ops.h>

#include <algorithm>
#include <cmath>
#include <utility>
#include <vector>

#include "../contact/rigid_slip.h"

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

Vector vector_of(const double* a) { return {a[0], a[1], a[2]}; }

void add_press(const PairPress& a, int32_t bodies, bool together, const double* center, double* gradient,
               double* matrix) {
  double maps[2][kUnknowns][3], pressed[2][kUnknowns][3];
  for (int side = 0; side < 2; ++side) {
    const int32_t body = a.body[side];
    if (body < 0) continue;
    const Vector c = vector_of(center + 3 * body);
    const MatrixPart own(matrix, bodies, together, body, body);
    for (int i = 0; i < kUnknowns; ++i) {
      gradient[kUnknowns * body + i] += a.gradient(side, i, c);
      const Vector m = a.map(side, i, c), q = a.stiffness * m;
      const double values[2][3] = {{m.x, m.y, m.z}, {q.x, q.y, q.z}};
      std::copy_n(values[0], 3, maps[side][i]), std::copy_n(values[1], 3, pressed[side][i]);
    }
    const double share = borne(a, together);
    for (int i = 0; i < kUnknowns; ++i) {
      for (int j = 0; j < kUnknowns; ++j) {
        double sum = 0;
        for (int k = 0; k < 3; ++k) sum += maps[side][i][k] * pressed[side][j][k];
        own(i, j) += share * sum;
      }
    }
  }
  if (!together || a.body[0] < 0 || a.body[1] < 0) return;
  const MatrixPart upper(matrix, bodies, true, a.body[0], a.body[1]), lower(matrix, bodies, true, a.body[1], a.body[0]);
  for (int i = 0; i < kUnknowns; ++i) {
    for (int j = 0; j < kUnknowns; ++j) {
      double sum = 0;
      for (int k = 0; k < 3; ++k) sum += maps[0][i][k] * pressed[1][j][k];
      upper(i, j) += sum, lower(j, i) += sum;
    }
  }
}

template <class T>
void system_of_scene(const RigidInputs<T>& in, int64_t scene, double* center, double* gradient, double* matrix) {
  const bool together = in.together();
  const int32_t n = in.bodies();
  for (int32_t k = 0; k < n; ++k) {
    const Body<T> body{in.scene, scene, k};
    double mass = 0, spread = 0, g6[kUnknowns] = {}, block[rigid::kSix] = {};
    Vector sum{};
    for (int32_t i = 0; i < body.size(); ++i) {
      const double m = body.mass(body.vertex(i));
      mass += m;
      sum += m * body.position(body.vertex(i));
    }
    const bool free = in.free[k] && 0 < mass;
    const Vector c = 0 < mass ? (1 / mass) * sum : Vector{};
    rigid::put(center + 3 * k, c);
    for (int32_t i = 0; free && i < body.size(); ++i) {
      const int32_t v = body.vertex(i);
      Vector g;
      Sym3<double> H;
      vertex_press(in, body, v, g, H);
      const Vector arm = body.position(v) - c;
      rigid::add_vertex(arm, g, H, g6, block);
      spread += body.mass(v) * dot(arm, arm);
    }
    const MatrixPart own(matrix, n, together, k, k);
    std::copy_n(g6, kUnknowns, gradient + kUnknowns * k);
    for (int i = 0; i < kUnknowns; ++i) {
      for (int j = 0; j < kUnknowns; ++j) own(i, j) = block[rigid::at6(std::max(i, j), std::min(i, j))];
      own(i, i) += free ? kLeastInertia * (i < 3 ? spread : mass) : 1;
    }
  }
  const CornerPoints<T> at{in, false};
  PairPress press;
  for (int64_t i = in.first_listed(scene); i < in.first_listed(scene + 1); ++i) {
    if (barrier_press(in, i, at, press)) add_press(press, n, together, center, gradient, matrix);
  }
}

// What friction and damping add, linear about the motions of bodies.
template <class T>
void add_lagged_of_scene(const RigidInputs<T>& in, int64_t scene, const Slid& slid, double* gradient, double* matrix) {
  const int32_t n = in.bodies();
  const CornerPoints<T> at{in, false};
  for (int64_t i = in.first_lagged(scene); i < in.first_lagged(scene + 1); ++i) {
    each_lagged_press(in, i, at, slid, [&](const PairPress& press) {
      add_press(press, n, in.together(), slid.center, gradient, matrix);
    });
  }
  for (int32_t k = 0; in.planes && k < n; ++k) {
    if (!in.free[k]) continue;
    const Body<T> body{in.scene, scene, k};
    double* g6 = gradient + kUnknowns * k;
    double block[rigid::kSix] = {};
    for (int32_t i = 0; i < body.size(); ++i) {
      const int32_t v = body.vertex(i);
      const Vector arm = body.position(v) - vector_of(slid.center + 3 * k);
      Vector g{};
      Sym3<double> H{};
      add_floor_friction(in, body, v, moved_by(slid.motion + kUnknowns * k, arm), g, H);
      rigid::add_vertex(arm, g, H, g6, block);
    }
    const MatrixPart own(matrix, n, in.together(), k, k);
    for (int i = 0; i < kUnknowns; ++i) {
      for (int j = 0; j < kUnknowns; ++j) own(i, j) += block[rigid::at6(std::max(i, j), std::min(i, j))];
    }
  }
}

// Slips along a step, and which system each has a say in.
template <class T>
std::vector<std::vector<SlipLine>> lines_of_scene(const RigidInputs<T>& in, int64_t scene, const Slid& slid,
                                                  const double* step) {
  std::vector<std::vector<SlipLine>> out(in.together() ? 1 : in.bodies());
  const CornerPoints<T> at{in, false};
  for (int64_t i = in.first_lagged(scene); i < in.first_lagged(scene + 1); ++i) {
    each_lagged_press(in, i, at, slid, [&](const PairPress& press) {
      const int32_t body = press.body[0] < 0 ? press.body[1] : press.body[0];
      out[in.together() ? 0 : body].push_back(slip_line(in, i, press, slid.center, step));
    });
  }
  for (int32_t k = 0; in.planes && k < in.bodies(); ++k) {
    const Body<T> body{in.scene, scene, k};
    const int64_t own = kUnknowns * k;
    for (int32_t i = 0; in.free[k] && i < body.size(); ++i) {
      const int32_t v = body.vertex(i);
      const Vector arm = body.position(v) - vector_of(slid.center + 3 * k);
      for (int plane = 0; plane < in.planes; ++plane)
        out[in.together() ? 0 : k].push_back(slip_line(in, body, v, plane, arm, slid.motion + own, step + own));
    }
  }
  return out;
}

// x' A x of a matrix with the Cholesky factor.
double energy_of(const double* factor, int64_t size, const double* x) {
  double total = 0;
  for (int64_t j = 0; j < size; ++j) {
    double sum = 0;
    for (int64_t i = j; i < size; ++i) sum += factor[size * i + j] * x[i];
    total += sum * sum;
  }
  return total;
}

// y += A x for each of some matrices.
void add_product(const double* matrices, int64_t count, int64_t size, const double* x, double* y) {
  for (int64_t row = 0; row < count * size; ++row) {
    const double *a = matrices + size * row, *own = x + row / size * size;
    for (int64_t j = 0; j < size; ++j) y[row] += a[j] * own[j];
  }
}

// Motions of the bodies of a scene, zero at first, and the factor of the matrix there.
template <class T>
void solve_scene(const RigidInputs<T>& in, int64_t scene, double* center, double* motion, double* factor) {
  const int64_t n = in.bodies(), unknowns = kUnknowns * n, size = in.system_size(), systems = unknowns / size;
  std::vector<double> gradient(unknowns), matrix(in.matrix_size(), 0.0), next(unknowns), step(unknowns);
  system_of_scene(in, scene, center, gradient.data(), matrix.data());
  std::fill_n(motion, unknowns, 0.0);
  bool settled = false;
  for (int iteration = 0; iteration < kSlipIterations; ++iteration) {
    step = gradient;
    std::copy(matrix.begin(), matrix.end(), factor);
    const Slid slid{center, motion};
    add_lagged_of_scene(in, scene, slid, step.data(), factor);
    if (iteration > 0) add_product(factor, systems, size, motion, step.data());
    cholesky(systems, size, factor);
    cholesky_solve(systems, size, factor, step.data());
    for (int64_t k = 0; k < n; ++k) keep_finite(step.data() + kUnknowns * k);
    for (int64_t i = 0; i < unknowns; ++i) next[i] = motion[i] + step[i];
    if (settled || !in.rubs()) break;  // the matrix is that of where the motion ends
    const auto lines = lines_of_scene(in, scene, slid, step.data());
    settled = true;
    for (int64_t s = 0; s < systems; ++s) {
      const double* own = factor + size * size * s;
      const double fall = energy_of(own, size, step.data() + size * s);
      if (fall <= kSettled * kSettled * energy_of(own, size, next.data() + size * s)) continue;
      settled = false;
      const double share = slip_share(fall, [&](double tried) {
        double sum = 0;
        for (const SlipLine& line : lines[s]) sum += line.excess(tried);
        return sum;
      });
      for (int64_t i = size * s; i < size * (s + 1); ++i) next[i] = motion[i] + share * step[i];
    }
    std::copy(next.begin(), next.end(), motion);
  }
  std::copy(next.begin(), next.end(), motion);
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

void cholesky(int64_t count, int64_t size, double* matrices) {
  torch::stable::parallel_for(0, count, 1, [&](int64_t begin, int64_t end) {
    std::vector<int64_t> first(size);  // of each row, before which it is zero: bodies touch few others
    for (int64_t n = begin; n < end; ++n) {
      double* a = matrices + size * size * n;
      for (int64_t i = 0; i < size; ++i) {
        first[i] = 0;
        while (first[i] < i && a[size * i + first[i]] == 0) ++first[i];
        for (int64_t j = first[i]; j <= i; ++j) {
          double sum = a[size * i + j];
          for (int64_t k = std::max(first[i], first[j]); k < j; ++k) sum -= a[size * i + k] * a[size * j + k];
          a[size * i + j] = i == j ? std::sqrt(sum) : sum / a[size * j + j];
        }
      }
    }
  });
}

void cholesky_solve(int64_t count, int64_t size, const double* factors, double* x) {
  for (int64_t n = 0; n < count; ++n) {
    const double* a = factors + size * size * n;
    double* b = x + size * n;
    for (int64_t i = 0; i < size; ++i) {
      for (int64_t k = 0; k < i; ++k) b[i] -= a[size * i + k] * b[k];
      b[i] /= a[size * i + i];
    }
    for (int64_t i = size - 1; i >= 0; --i) {
      b[i] /= a[size * i + i];
      for (int64_t k = 0; k < i; ++k) b[k] -= a[size * i + k] * b[i];
    }
  }
}

template <class T>
void rigid_system(const RigidInputs<T>& in, double* center, double* motion, double* factor) {
  const int64_t n = in.bodies();
  torch::stable::parallel_for(0, in.scene.scenes, 1, [&](int64_t begin, int64_t end) {
    for (int64_t s = begin; s < end; ++s)
      solve_scene(in, s, center + 3 * n * s, motion + kUnknowns * n * s, factor + in.matrix_size() * s);
  });
}

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

#define DIFFVBD_INSTANTIATE(T)                                                     \
  template void rigid_system<T>(const RigidInputs<T>&, double*, double*, double*); \
  template void rigid_move<T>(const RigidInputs<T>&, const double*, const double*, T*, double*, T*);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd
