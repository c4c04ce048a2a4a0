// The rigid correction of bodies that touch, on the CPU: groups, their systems and the solutions.
#include "contact_rigid.h"

#include <algorithm>
#include <bitset>
#include <cmath>
#include <cstdint>
#include <limits>
#include <numeric>
#include <utility>
#include <vector>

#include "threads.h"

namespace diffvbd {

using namespace contact;
using rigid::Body, rigid::Vector;

namespace {

// The Cholesky factor of a matrix of blocks of six, one for each two bodies, in its lower triangle; what is no number
// says that it is not positive definite. Blocks of zeros are left out: bodies touch few others.
void cholesky(int64_t size, double* a) {
  constexpr int kBlock = kUnknowns;
  std::vector<double*> filled;  // rows of blocks below that on the diagonal
  for (double *pivot = a, *end = a + size * size; pivot < end; pivot += kBlock * (size + 1)) {
    for (int j = 0; j < kBlock; ++j) {
      for (int i = j; i < kBlock; ++i) {
        double sum = pivot[size * i + j];
        for (int k = 0; k < j; ++k) sum -= pivot[size * i + k] * pivot[size * j + k];
        pivot[size * i + j] = i == j ? std::sqrt(sum) : sum / pivot[size * j + j];
      }
    }
    filled.clear();
    for (double* block = pivot + kBlock * size; block < end; block += kBlock * size) {
      bool any = false;
      for (int i = 0; i < kBlock; ++i)
        any = any || std::any_of(block + size * i, block + size * i + kBlock, [](double x) { return x != 0; });
      if (any) filled.push_back(block);
    }
    for (double* block : filled) {
      for (int i = 0; i < kBlock; ++i) {
        double* row = block + size * i;
        for (int j = 0; j < kBlock; ++j) {
          double sum = row[j];
          for (int k = 0; k < j; ++k) sum -= row[k] * pivot[size * j + k];
          row[j] = sum / pivot[size * j + j];
        }
      }
    }
    for (size_t r = 0; r < filled.size(); ++r) {
      for (size_t c = 0; c <= r; ++c) {
        double* to = filled[r] + (filled[c] - pivot) / size;  // as far right as that is below
        for (int i = 0; i < kBlock; ++i) {
          for (int j = 0; j < kBlock; ++j) {
            double sum = to[size * i + j];
            for (int k = 0; k < kBlock; ++k) sum -= filled[r][size * i + k] * filled[c][size * j + k];
            to[size * i + j] = sum;
          }
        }
      }
    }
  }
}

// b = factor^-T factor^-1 b
void cholesky_solve(int64_t size, const double* a, double* b) {
  for (int64_t i = 0; i < size; ++i) {
    for (int64_t k = 0; k < i; ++k) b[i] -= a[size * i + k] * b[k];
    b[i] /= a[size * i + i];
  }
  for (int64_t i = size - 1; i >= 0; --i) {
    b[i] /= a[size * i + i];
    for (int64_t k = 0; k < i; ++k) b[k] -= a[size * i + k] * b[i];
  }
}

// The order in which the bodies of a group are eliminated: always next the one that touches the fewest of those left,
// and then these touch one another. touching [count]: a bit for each other body; left as it is then.
std::vector<int32_t> elimination_order(std::vector<uint64_t>& touching) {
  const auto count = static_cast<int32_t>(touching.size());
  uint64_t left = count < 64 ? (uint64_t{1} << count) - 1 : ~uint64_t{0};
  std::vector<int32_t> order;
  while (left != 0) {
    int32_t next = -1, fewest = 65;
    for (int32_t k = 0; k < count; ++k) {
      const auto degree = static_cast<int32_t>(std::bitset<64>(touching[k] & left).count());
      if ((left >> k & 1) && degree < fewest) next = k, fewest = degree;
    }
    order.push_back(next);
    left &= ~(uint64_t{1} << next);
    const uint64_t rest = touching[next] & left;
    for (int32_t k = 0; k < count; ++k) {
      if (rest >> k & 1) touching[k] |= rest & ~(uint64_t{1} << k);
    }
  }
  return order;
}

// Calls f(a, b) for the bodies that touch by barriers or lagged pairs.
template <class T, class F>
void each_touching(const RigidInputs<T>& in, int64_t scene, const std::vector<PairForce>& terms, const F& f) {
  const auto touch = [&](int32_t a, int32_t b) {
    if (0 <= a && 0 <= b && a != b) f(a, b);
  };
  for (const PairForce& term : terms) touch(term.body[0], term.body[1]);
  for (int64_t i = in.first_lagged(scene); i < in.first_lagged(scene + 1); ++i) {
    if (!Lag<T>(in.lag + kLagScalars * i).active()) continue;
    const int32_t* record = in.lagged.pairs + kPairRow * i;
    touch(moving_body(in, record[0]), moving_body(in, record[sides(record[4])]));
  }
}

// The groups of a scene, by its touching bodies; rows [4, bodies].
template <class T>
void find_groups(const RigidInputs<T>& in, int64_t scene, const std::vector<PairForce>& terms, int32_t* rows) {
  const int32_t n = in.bodies();
  std::vector<std::pair<int32_t, int32_t>> touching;
  each_touching(in, scene, terms, [&](int32_t a, int32_t b) { touching.emplace_back(a, b); });
  std::vector<int32_t> root(n), size(n, 0);
  std::iota(root.begin(), root.end(), 0);
  const auto root_of = [&](int32_t body) {
    while (root[body] != body) body = root[body] = root[root[body]];
    return body;
  };
  for (auto [a, b] : touching) {
    a = root_of(a), b = root_of(b);
    root[std::max(a, b)] = std::min(a, b);
  }
  for (int32_t k = 0; k < n; ++k) ++size[root_of(k)];
  int32_t *member = rows, *first = rows + n, *rank = rows + 2 * n, *count = rows + 3 * n, place = 0;
  std::fill_n(count, n, 0);
  for (int32_t k = 0; k < n; ++k) {
    const int32_t own = root_of(k);
    const bool fits = size[own] <= most_grouped(n);
    const int32_t lead = fits ? own : k;
    if (lead == k) {
      first[k] = place;
      place += fits ? size[own] : 1;
    }
    first[k] = first[lead];
    rank[k] = fits ? count[first[k]]++ : 0;
    if (!fits) count[first[k]] = kLeft;
    member[first[k] + rank[k]] = k;
  }
  std::vector<uint64_t> masks(n, 0);
  for (const auto& [a, b] : touching) {
    if (first[a] != first[b]) continue;
    masks[first[a] + rank[a]] |= uint64_t{1} << rank[b];
    masks[first[b] + rank[b]] |= uint64_t{1} << rank[a];
  }
  for (place = 0; place < n; ++place) {
    if (count[place] <= kFew) continue;
    std::vector<uint64_t> own(masks.begin() + place, masks.begin() + place + count[place]);
    const std::vector<int32_t> before(member + place, member + place + count[place]), order = elimination_order(own);
    for (int32_t i = 0; i < count[place]; ++i) {
      member[place + i] = before[order[i]];
      rank[member[place + i]] = i;
    }
  }
}

// A part of the matrix of a group, 6 x 6, between two of its bodies; `matrices` of the scene.
struct MatrixPart {
  double* at;
  int64_t stride;
  MatrixPart(double* matrices, const Groups& groups, int32_t row, int32_t column) {
    const int32_t first = groups.first(row);
    stride = int64_t{kUnknowns} * groups.count(first);
    at = matrices + groups.matrix(first) + kUnknowns * (stride * groups.rank(row) + groups.rank(column));
  }
  double& operator()(int i, int j) const { return at[i * stride + j]; }
};

void add_pair_force(const PairForce& a, double fraction, const Groups& groups, const double* center, double* gradient,
                    double* matrix) {
  double maps[2][kUnknowns][3], forces[2][kUnknowns][3];
  for (int side = 0; side < 2; ++side) {
    const int32_t body = a.body[side];
    if (body < 0) continue;
    const Vector c = vector_at(center + 3 * body);
    const MatrixPart own(matrix, groups, body, body);
    for (int i = 0; i < kUnknowns; ++i) {
      gradient[kUnknowns * body + i] += a.gradient(side, i, c);
      const Vector m = a.map(side, i, c), q = a.stiffness * m;
      const double values[2][3] = {{m.x, m.y, m.z}, {q.x, q.y, q.z}};
      std::copy_n(values[0], 3, maps[side][i]), std::copy_n(values[1], 3, forces[side][i]);
    }
    for (int i = 0; i < kUnknowns; ++i) {
      for (int j = 0; j < kUnknowns; ++j) {
        double sum = 0;
        for (int k = 0; k < 3; ++k) sum += maps[side][i][k] * forces[side][j][k];
        own(i, j) += fraction * sum;
      }
    }
  }
  if (a.body[0] < 0 || a.body[1] < 0 || !groups.joined(a.body[0], a.body[1])) return;
  const MatrixPart upper(matrix, groups, a.body[0], a.body[1]), lower(matrix, groups, a.body[1], a.body[0]);
  for (int i = 0; i < kUnknowns; ++i) {
    for (int j = 0; j < kUnknowns; ++j) {
      double sum = 0;
      for (int k = 0; k < 3; ++k) sum += maps[0][i][k] * forces[1][j][k];
      upper(i, j) += sum, lower(j, i) += sum;
    }
  }
}

template <class T>
void system_of_scene(const RigidInputs<T>& in, int64_t scene, const Groups& groups, const std::vector<PairForce>& terms,
                     double* center, double* gradient, double* matrix) {
  std::vector<uint8_t> moves(in.bodies());  // nobody asks for the system of another
  for (int32_t k = 0; k < in.bodies(); ++k) moves[k] = in.moves(scene, groups, groups.first(k));
  for (int32_t k = 0; k < in.bodies(); ++k) {
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
    put(center + 3 * k, c);
    if (!moves[k]) continue;
    for (int32_t i = 0; free && i < body.size(); ++i) {
      const int32_t v = body.vertex(i);
      Vector g;
      Sym3<double> H;
      vertex_force(in, body, v, g, H);
      const Vector arm = body.position(v) - c;
      rigid::add_vertex(arm, g, H, g6, block);
      spread += body.mass(v) * dot(arm, arm);
    }
    const MatrixPart own(matrix, groups, k, k);
    std::copy_n(g6, kUnknowns, gradient + kUnknowns * k);
    for (int i = 0; i < kUnknowns; ++i) {
      for (int j = 0; j < kUnknowns; ++j) own(i, j) = block[rigid::at6(std::max(i, j), std::min(i, j))];
      own(i, i) += !free ? 1 : i < 3 ? kLeastInertia * spread : 0;
    }
  }
  for (const PairForce& term : terms) {
    const int32_t a = term.body[0], b = term.body[1];
    if (!(a >= 0 && moves[a]) && !(b >= 0 && moves[b])) continue;
    add_pair_force(term, borne(in, scene, term), groups, center, gradient, matrix);
  }
}

// The systems of a scene, one for each group.
struct Systems {
  struct System {
    int32_t first, count;
    Settling state = kIterating;
    int64_t size() const { return int64_t{kUnknowns} * count; }
  };
  Groups groups;
  std::vector<System> all;
  std::vector<int32_t> of;  // [bodies]

  explicit Systems(const Groups& given) : groups(given), of(given.bodies) {
    for (int32_t place = 0; place < groups.bodies; ++place) {
      if (0 < groups.count(place)) all.push_back({place, groups.count(place)});
      of[groups.member(place)] = static_cast<int32_t>(all.size()) - 1;
    }
  }
  bool works(int32_t body) const { return body >= 0 && all[of[body]].state != kDone; }
  bool all_done() const {
    return std::all_of(all.begin(), all.end(), [](const System& s) { return s.state == kDone; });
  }
  // Calls f(i, k) for the i-th unknown of a system, the k-th of the scene.
  template <class F>
  void each_unknown(const System& s, const F& f) const {
    for (int32_t i = 0; i < s.count; ++i) {
      for (int k = 0; k < kUnknowns; ++k) f(kUnknowns * i + k, kUnknowns * groups.member(s.first + i) + k);
    }
  }
};

// Calls f(term) for a lagged pair that acts, or for each side that is solved for alone.
template <class T, class At, class F>
void each_lagged_force(const RigidInputs<T>& in, int64_t pair, const At& at, const BodyMotions& motions, const F& f) {
  PairForce term;
  if (!lagged_force(in, pair, at, motions, term, 0)) return;
  f(term);
  if (term.doubled == 1 || !lagged_force(in, pair, at, motions, term, 1)) return;
  f(term);
}

// Calls f(term, pair) for each lagged pair of a scene in systems that are not done.
template <class T, class F>
void each_lagged(const RigidInputs<T>& in, int64_t scene, const BodyMotions& motions, const Systems& systems,
                 const F& f) {
  const CornerPoints<T> at{in, false};
  for (int64_t i = in.first_lagged(scene); i < in.first_lagged(scene + 1); ++i) {
    const int32_t* record = in.lagged.pairs + kPairRow * i;
    const int32_t a = moving_body(in, record[0]), b = moving_body(in, record[sides(record[4])]);
    if (!systems.works(a) && !systems.works(b)) continue;
    each_lagged_force(in, i, at, motions, [&](const PairForce& term) {
      if (systems.works(term.body[0] < 0 ? term.body[1] : term.body[0])) f(term, i);
    });
  }
}

// Adds friction and damping, linear about the motions of bodies.
template <class T>
void add_lagged_of_scene(const RigidInputs<T>& in, int64_t scene, const BodyMotions& motions, const Systems& systems,
                         double* gradient, double* matrix) {
  each_lagged(in, scene, motions, systems, [&](const PairForce& term, int64_t) {
    add_pair_force(term, 1, systems.groups, motions.center, gradient, matrix);
  });
  for (int32_t k = 0; in.planes && k < in.bodies(); ++k) {
    if (!in.free[k] || !systems.works(k)) continue;
    const Body<T> body{in.scene, scene, k};
    double* g6 = gradient + kUnknowns * k;
    double block[rigid::kSix] = {};
    for (int32_t i = 0; i < body.size(); ++i) {
      const int32_t v = body.vertex(i);
      const Vector arm = body.position(v) - vector_at(motions.center + 3 * k);
      Vector g{};
      Sym3<double> H{};
      add_floor_friction(in, body, v, moved_by(motions.motion + kUnknowns * k, arm), g, H);
      rigid::add_vertex(arm, g, H, g6, block);
    }
    const MatrixPart own(matrix, systems.groups, k, k);
    for (int i = 0; i < kUnknowns; ++i) {
      for (int j = 0; j < kUnknowns; ++j) own(i, j) += block[rigid::at6(std::max(i, j), std::min(i, j))];
    }
  }
}

// Tangential displacements along a step, by system.
template <class T>
std::vector<std::vector<FrictionLine>> lines_of_scene(const RigidInputs<T>& in, int64_t scene,
                                                      const BodyMotions& motions, const Systems& systems,
                                                      const double* step) {
  std::vector<std::vector<FrictionLine>> out(systems.all.size());
  each_lagged(in, scene, motions, systems, [&](const PairForce& term, int64_t i) {
    const int32_t body = term.body[0] < 0 ? term.body[1] : term.body[0];
    out[systems.of[body]].push_back(friction_line(in, i, term, motions.center, step));
  });
  for (int32_t k = 0; in.planes && k < in.bodies(); ++k) {
    const Body<T> body{in.scene, scene, k};
    const int64_t own = kUnknowns * k;
    for (int32_t i = 0; in.free[k] && systems.works(k) && i < body.size(); ++i) {
      const int32_t v = body.vertex(i);
      const Vector arm = body.position(v) - vector_at(motions.center + 3 * k);
      for (int plane = 0; plane < in.planes; ++plane) {
        if (bears(in, body, v, plane))
          out[systems.of[k]].push_back(friction_line(in, body, v, plane, arm, motions.motion + own, step + own));
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

// Clears the motion of bodies of a scene of few that touch none that is to move.
template <class T>
void keep_few(const RigidInputs<T>& in, int64_t scene, const std::vector<PairForce>& terms, double* motion) {
  const int32_t n = in.bodies();
  uint8_t touching[kFew * kFew] = {};
  bool moves[kFew];
  each_touching(in, scene, terms, [&](int32_t a, int32_t b) { touching[n * a + b] = 1; });
  find_moving(n, in.moving + n * scene, touching, moves);
  for (int32_t k = 0; k < n; ++k) {
    if (!moves[k]) std::fill_n(motion + kUnknowns * k, kUnknowns, 0.0);
  }
}

// The forces of the listed pairs of a scene within reach.
template <class T>
std::vector<PairForce> terms_of(const RigidInputs<T>& in, int64_t scene) {
  const int32_t vertices = in.gate.vertices;
  const int64_t row = scene * vertices;
  std::vector<double> since(vertices);  // how far each vertex is from where gaps were taken
  for (int32_t v = 0; v < vertices; ++v) {
    const Vector d = wide_at(in.scene.x + 3 * (row + v)) - wide_at(in.gate.center + 3 * (row + v));
    since[v] = std::sqrt(dot(d, d));
  }
  const auto is_far = [&](int64_t pair) {
    const T* constants = in.gate.constants + kConstants * pair;
    const double slack = PairHints<T>(constants).gap - PairConstants<T>(constants).dhat;
    return most_closed(in.gate.listed.pairs + kPairRow * pair, vertices, since.data()) < (1 - 1e-6) * slack;
  };
  std::vector<PairForce> out(1);
  for (int64_t i = in.first_listed(scene); i < in.first_listed(scene + 1); ++i) {
    if (!is_far(i) && barrier_force(in, i, CornerPoints<T>{in, false}, out.back())) out.emplace_back();
  }
  out.pop_back();
  return out;
}

// Motions of the bodies of a scene, zero at first, and the factors of the matrices there. rows [4, bodies] of `in`, or
// null. Those that do not move have no factor.
template <class T>
void solve_scene(const RigidInputs<T>& in, int64_t scene, double* center, double* motion, double* factor,
                 int32_t* rows) {
  const int64_t unknowns = int64_t{kUnknowns} * in.bodies();
  const std::vector<PairForce> terms = terms_of(in, scene);
  if (rows) find_groups(in, scene, terms, rows);
  Groups groups = in.groups_of(scene);
  groups.capacity = most_grouped(in.bodies());
  const int64_t size = kUnknowns * unknowns * groups.capacity;
  std::vector<double> gradient(unknowns), matrix(size, 0.0), factors(size), step(unknowns), own(unknowns),
      whole(unknowns);
  system_of_scene(in, scene, groups, terms, center, gradient.data(), matrix.data());
  std::fill_n(motion, unknowns, 0.0);
  const BodyMotions motions{center, motion};
  Systems systems(groups);
  for (auto& s : systems.all) {
    if (in.moves(scene, groups, s.first)) continue;
    s.state = kDone;
    factors[groups.matrix(s.first)] = std::numeric_limits<double>::quiet_NaN();
  }
  const bool has_friction = in.has_friction_in(scene);
  for (int iteration = 0; iteration < kFrictionIterations && !systems.all_done(); ++iteration) {
    for (const auto& s : systems.all) {
      if (s.state == kDone) continue;
      std::copy_n(matrix.data() + groups.matrix(s.first), s.size() * s.size(), &factors[groups.matrix(s.first)]);
      systems.each_unknown(s, [&](int, int64_t k) { step[k] = gradient[k]; });
    }
    add_lagged_of_scene(in, scene, motions, systems, step.data(), factors.data());
    for (const auto& s : systems.all) {
      if (s.state == kDone) continue;
      double* a = &factors[groups.matrix(s.first)];
      systems.each_unknown(s, [&](int i, int64_t k) { own[i] = step[k], whole[i] = motion[k]; });
      if (iteration > 0) add_product(a, s.size(), whole.data(), own.data());
      cholesky(s.size(), a);
      cholesky_solve(s.size(), a, own.data());
      for (int64_t i = 0; i < s.size(); i += kUnknowns) keep_finite(own.data() + i);
      systems.each_unknown(s, [&](int i, int64_t k) { step[k] = own[i]; });
    }
    if (!has_friction) {
      for (const auto& s : systems.all) {
        if (s.state != kDone) systems.each_unknown(s, [&](int, int64_t k) { motion[k] = step[k]; });
      }
      break;
    }
    const auto lines = lines_of_scene(in, scene, motions, systems, step.data());
    for (auto& s : systems.all) {
      if (s.state == kDone) continue;
      const double* a = &factors[groups.matrix(s.first)];
      systems.each_unknown(s, [&](int i, int64_t k) { own[i] = step[k], whole[i] = motion[k] + step[k]; });
      const double decrease = energy_of(a, s.size(), own.data());
      const double all = energy_of(a, s.size(), whole.data());
      const double fraction = settle(s.state, true, decrease, all, [&](double most) {
        return friction_fraction(most, [&](double tried) {
          double sum = 0;
          for (const FrictionLine& line : lines[&s - systems.all.data()]) sum += line.excess(tried, in.friction_eps);
          return sum;
        });
      });
      systems.each_unknown(s, [&](int, int64_t k) { motion[k] += fraction * step[k]; });
    }
  }
  if (in.moving && in.together()) keep_few(in, scene, terms, motion);
  const Groups kept = in.groups_of(scene);
  for (const auto& s : systems.all) {
    const int64_t count = s.count <= kept.capacity ? s.size() * s.size() : 1;  // of others it says that there is none
    std::copy_n(&factors[groups.matrix(s.first)], count, factor + kept.matrix(s.first));
  }
}

}  // namespace

template <class T>
void rigid_system(const RigidInputs<T>& in, double* center, double* motion, double* factor, int32_t* groups) {
  const int64_t n = in.bodies();
  const auto solve = [&](int64_t s) {
    solve_scene(in, s, center + 3 * n * s, motion + kUnknowns * n * s, factor + in.matrix_size() * s,
                groups ? groups + kGroupRows * n * s : nullptr);
  };
  for_each(in.scene.scenes, solve, 1);
}

template <class T>
void rigid_solve(const RigidInputs<T>& in, const double* factor, double* x) {
  std::vector<double> own(int64_t{kUnknowns} * in.bodies());
  for (int64_t scene = 0; scene < in.scene.scenes; ++scene) {
    const Systems systems(in.groups_of(scene));
    double* all = x + kUnknowns * in.bodies() * scene;
    for (const auto& s : systems.all) {
      if (s.count > systems.groups.capacity) {  // it did not move
        systems.each_unknown(s, [&](int, int64_t k) { all[k] = 0; });
        continue;
      }
      systems.each_unknown(s, [&](int i, int64_t k) { own[i] = all[k]; });
      cholesky_solve(s.size(), factor + in.matrix_size() * scene + systems.groups.matrix(s.first), own.data());
      systems.each_unknown(s, [&](int i, int64_t k) { all[k] = own[i]; });
    }
  }
}

#define DIFFVBD_INSTANTIATE(T)                                                               \
  template void rigid_system<T>(const RigidInputs<T>&, double*, double*, double*, int32_t*); \
  template void rigid_solve<T>(const RigidInputs<T>&, const double*, double*);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)

}  // namespace diffvbd
