#include "contact_rigid.h"

#include <torch/csrc/stable/ops.h>

#include <algorithm>
#include <cmath>
#include <vector>

#include "../contact/rigid_slip.h"

namespace diffvbd {

using namespace contact;
using rigid::Body, rigid::Vector;

namespace {

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

// Where Newton's method is with a system: on its way, at the motion it has settled at but not with the matrix there,
// and done, when it is left alone.
enum Settling : uint8_t { kOnItsWay, kSettledAt, kDone };

// The systems of a scene, one for all bodies or one for each.
struct Systems {
  bool together;
  std::vector<Settling> state;
  bool works(int32_t body) const { return body >= 0 && state[together ? 0 : body] != kDone; }
  bool all_done() const {
    return std::all_of(state.begin(), state.end(), [](Settling s) { return s == kDone; });
  }
};

// Calls f(press) for all of a lagged pair that acts, or for each side that is solved for alone.
template <class T, class At, class F>
void each_lagged_press(const RigidInputs<T>& in, int64_t pair, const At& at, const Slid& slid, const F& f) {
  PairPress press;
  if (!lagged_press(in, pair, at, slid, press, 0)) return;
  f(press);
  if (press.doubled == 1 || !lagged_press(in, pair, at, slid, press, 1)) return;
  f(press);
}

// Calls f(press, pair) for what each lagged pair of a scene presses in systems that are not done.
template <class T, class F>
void each_lagged(const RigidInputs<T>& in, int64_t scene, const Slid& slid, const Systems& systems, const F& f) {
  const CornerPoints<T> at{in, false};
  for (int64_t i = in.first_lagged(scene); i < in.first_lagged(scene + 1); ++i) {
    const int32_t* record = in.lagged.pairs + kPairRow * i;
    const int32_t a = moving_body(in, record[0]), b = moving_body(in, record[sides(record[4])]);
    if (!systems.works(a) && !systems.works(b)) continue;
    each_lagged_press(in, i, at, slid, [&](const PairPress& press) {
      if (systems.works(press.body[0] < 0 ? press.body[1] : press.body[0])) f(press, i);
    });
  }
}

// What friction and damping add, linear about the motions of bodies.
template <class T>
void add_lagged_of_scene(const RigidInputs<T>& in, int64_t scene, const Slid& slid, const Systems& systems,
                         double* gradient, double* matrix) {
  const int32_t n = in.bodies();
  each_lagged(in, scene, slid, systems, [&](const PairPress& press, int64_t) {
    add_press(press, n, in.together(), slid.center, gradient, matrix);
  });
  for (int32_t k = 0; in.planes && k < n; ++k) {
    if (!in.free[k] || !systems.works(k)) continue;
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
                                                  const Systems& systems, const double* step) {
  std::vector<std::vector<SlipLine>> out(systems.state.size());
  each_lagged(in, scene, slid, systems, [&](const PairPress& press, int64_t i) {
    const int32_t body = press.body[0] < 0 ? press.body[1] : press.body[0];
    out[in.together() ? 0 : body].push_back(slip_line(in, i, press, slid.center, step));
  });
  for (int32_t k = 0; in.planes && k < in.bodies(); ++k) {
    const Body<T> body{in.scene, scene, k};
    const int64_t own = kUnknowns * k;
    for (int32_t i = 0; in.free[k] && systems.works(k) && i < body.size(); ++i) {
      const int32_t v = body.vertex(i);
      const Vector arm = body.position(v) - vector_of(slid.center + 3 * k);
      for (int plane = 0; plane < in.planes; ++plane) {
        if (bears(in, body, v, plane))
          out[in.together() ? 0 : k].push_back(slip_line(in, body, v, plane, arm, slid.motion + own, step + own));
      }
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

// y += A x
void add_product(const double* matrix, int64_t size, const double* x, double* y) {
  for (int64_t row = 0; row < size; ++row) {
    for (int64_t j = 0; j < size; ++j) y[row] += matrix[size * row + j] * x[j];
  }
}

// Motions of the bodies of a scene, zero at first, and the factor of the matrix there.
template <class T>
void solve_scene(const RigidInputs<T>& in, int64_t scene, double* center, double* motion, double* factor) {
  const int64_t n = in.bodies(), unknowns = kUnknowns * n, size = in.system_size(), count = unknowns / size;
  const int64_t square = size * size;
  std::vector<double> gradient(unknowns), matrix(in.matrix_size(), 0.0), step(unknowns);
  system_of_scene(in, scene, center, gradient.data(), matrix.data());
  std::fill_n(motion, unknowns, 0.0);
  const Slid slid{center, motion};
  Systems systems{in.together(), std::vector<Settling>(count, kOnItsWay)};
  const auto each = [&](const auto& f) {
    for (int64_t s = 0; s < count; ++s) {
      if (systems.state[s] != kDone) f(s, factor + square * s, motion + size * s, step.data() + size * s);
    }
  };
  for (int iteration = 0; iteration < kSlipIterations && !systems.all_done(); ++iteration) {
    each([&](int64_t s, double* own, double*, double* to) {
      std::copy_n(gradient.data() + size * s, size, to), std::copy_n(matrix.data() + square * s, square, own);
    });
    add_lagged_of_scene(in, scene, slid, systems, step.data(), factor);
    each([&](int64_t, double* own, double* at, double* to) {
      if (iteration > 0) add_product(own, size, at, to);
      cholesky(size, own);
      cholesky_solve(1, size, own, to);
      for (int64_t i = 0; i < size; i += kUnknowns) keep_finite(to + i);
    });
    if (!in.rubs()) {
      std::copy(step.begin(), step.end(), motion);
      return;
    }
    const auto lines = lines_of_scene(in, scene, slid, systems, step.data());
    each([&](int64_t s, double* own, double* at, double* to) {
      std::vector<double> whole(at, at + size);
      for (int64_t i = 0; i < size; ++i) whole[i] += to[i];
      const double fall = energy_of(own, size, to);
      const bool settled = fall <= kSettled * kSettled * energy_of(own, size, whole.data());
      if (systems.state[s] == kSettledAt || settled) {
        systems.state[s] = systems.state[s] == kSettledAt ? kDone : kSettledAt;
        std::copy(whole.begin(), whole.end(), at);
        return;
      }
      const double share = slip_share(fall, [&](double tried) {
        double sum = 0;
        for (const SlipLine& line : lines[s]) sum += line.excess(tried);
        return sum;
      });
      for (int64_t i = 0; i < size; ++i) at[i] += share * to[i];
    });
  }
}

}  // namespace

void cholesky(int64_t size, double* a) {
  std::vector<int64_t> first(size);  // of each row, before which it is zero: bodies touch few others
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

#define DIFFVBD_INSTANTIATE(T) template void rigid_system<T>(const RigidInputs<T>&, double*, double*, double*);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd
