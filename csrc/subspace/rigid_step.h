// The loops of the rigid correction of bodies that touch (docs/method.md, section 18): one Newton step of the
// incremental potential in the turn and the shift of every body,
//
//     (J' H J) d = -J' g,        x <- x moved by s d,
//
// where s is the first of 1, 1/4, ... that raises no potential and that nothing blocks, for each island of bodies; and
// its transpose. In double precision.
//
// A Run makes the loops over the items of scenes: run.each(phase, step, n) calls phase(step, scene, i) for i < n,
// run.rows() phase(step, row) for listed and then lagged pairs, run.parts() phase(step, row, part) for the former,
// run.bodies() phase(step, body, team), run.groups() phase(step, scene, place, team), and run.points() phase(step,
// point, team) for corner points. What a loop wrote the next one may read. run.is_done(flags, n): whether n flags are
// set, where that can be told.
#pragma once

#include "cholesky.h"
#include "contact_rigid.h"
#include "contact_rigid_reverse.h"

// Of functions that run where their Run does.
#ifdef __CUDACC__
#define DIFFVBD_RUNS _Pragma("nv_exec_check_disable")
#else
#define DIFFVBD_RUNS
#endif

namespace diffvbd::contact {

using rigid::Body;

// Memory of a correction, by body [B, bodies], place [B, bodies], vertex [B, V] and row.
template <class T>
struct RigidMemory {
  int64_t listed, lagged;         // rows of the lists
  PairForce* forces;              // by row, of bodies that it acts on, or -1
  uint8_t *near, *active, *some;  // by row: whether it may act after the motion; by scene [B] twice
  double *center, *motion;        // by body [3], [6]
  double *solution, *matrix;      // by place: six; and as Groups::matrix() says
  uint64_t* blocks;               // by place
  int32_t *label, *groups;        // by body; [B, 4, bodies]
  int32_t *list, *count;          // [4 rows]; by vertex [2]: see RigidStep::list()
  // of the trials
  double *reach, *sum, *own, *after;   // by body [2]: farthest_of(); by body and vertex [2]: change, size; by row
  uint8_t *decided, *joined, *solved;  // by body
  T* move;                             // by vertex [3]
  AdvanceState<T> state;
  Motion<T>* motions;  // by vertex, that of `state`

  // take(pointer, items), for so many scenes, and vertices and bodies of all of them; size: of the matrices of a scene;
  // trials: whether these follow
  template <class Take>
  void parts(Take& take, int64_t scenes, int64_t vertices, int64_t units, int64_t size, bool trials) {
    const int64_t rows = listed + lagged;
    take(forces, rows), take(list, 4 * rows), take(count, 2 * vertices);
    take(active, scenes), take(some, scenes), take(solved, units), take(blocks, units), take(label, units);
    take(center, 3 * units), take(motion, kUnknowns * units), take(solution, kUnknowns * units);
    take(matrix, scenes * size), take(groups, kGroupRows * units);
    if (!trials) return;
    take(near, rows), take(after, rows), take(reach, 2 * units), take(sum, 2 * units), take(own, 2 * vertices);
    take(decided, units), take(joined, units), take(move, 3 * vertices), take(motions, vertices);
    take(state.fraction, units), take(state.now, units), take(state.blocked, units), take(state.stamp, units);
  }
};

template <class T>
struct RigidStep {
  RigidInputs<T> in;  // its groups, and the displacement of `gate`, are those of the memory
  RigidMemory<T> m;
  RigidOutcome<T> out;
  T* x_end;  // [B, V, 3]

  DIFFVBD_FN const RigidInputs<T>& inputs() const { return in; }
  DIFFVBD_FN int64_t listed() const { return m.listed; }
  DIFFVBD_FN int64_t lagged() const { return m.lagged; }
  DIFFVBD_FN int64_t unit(int64_t scene, int64_t body) const { return scene * in.bodies() + body; }
  DIFFVBD_FN bool is_listed(int64_t row) const { return row < m.listed; }
  DIFFVBD_FN int64_t pair_of(int64_t row) const { return is_listed(row) ? row : row - m.listed; }
  // Whether a list has a row; it may be shorter than its memory.
  DIFFVBD_FN bool exists(int64_t row) const {
    const int64_t scenes = in.scene.scenes;
    return pair_of(row) < (is_listed(row) ? in.first_listed(scenes) : in.first_lagged(scenes));
  }
  DIFFVBD_FN const int32_t* record(int64_t row) const {
    return (is_listed(row) ? in.gate.listed.pairs : in.lagged.pairs) + kPairRow * pair_of(row);
  }
  template <class At>
  DIFFVBD_FN bool force(int64_t row, const At& at, PairForce& to) const {
    return is_listed(row) ? barrier_force(in, row, at, to) : lagged_force(in, pair_of(row), at, to);
  }
  // The first of the bodies that a row acts on, which owns it.
  DIFFVBD_FN int64_t owner(int64_t row) const {
    const int32_t* of = record(row);
    const int32_t body = owner_of(in, of);
    return body < 0 ? -1 : unit(of[5], body);
  }
  // Lists the rows of a vertex that is the first of a side of theirs, where keep(row, side).
  template <class Keep>
  DIFFVBD_FN void list(int64_t scene, int64_t v, const Keep& keep) const {
    for (int which = 0; which < 2; ++which) {
      int32_t& found = m.count[2 * (scene * in.scene.vertices + v) + which];
      found = 0;
      if ((which == 0 ? m.listed : m.lagged) == 0) continue;
      const PairList& pairs = which == 0 ? in.gate.listed : in.lagged;
      const int64_t point = scene * in.gate.corners + v, first = which == 0 ? 0 : m.listed;
      const PairList::Entries all = pairs.of(point);
      for (int e = 0; e < all.count; ++e) {
        const int64_t pair = all.first[e] >> 2;
        const int corner = all.first[e] & 3, side = corner == 0 ? 0 : 1;
        if (side == 1 && corner != sides(pairs.pairs[kPairRow * pair + 4])) continue;
        if (keep(first + pair, side)) {
          m.list[4 * first + pairs.ptr[point] + found++] = static_cast<int32_t>(2 * pair) + side;
        }
      }
    }
  }
  // Calls f(row, side) for them.
  template <class F>
  DIFFVBD_FN void each_listed(int64_t scene, int64_t v, const F& f) const {
    for (int which = 0; which < 2; ++which) {
      const int32_t count = m.count[2 * (scene * in.scene.vertices + v) + which];
      if (count == 0) continue;
      const PairList& pairs = which == 0 ? in.gate.listed : in.lagged;
      const int64_t first = which == 0 ? 0 : m.listed;
      const int32_t* own = m.list + 4 * first + pairs.ptr[scene * in.gate.corners + v];
      for (int32_t i = 0; i < count; ++i) f(first + (own[i] >> 1), own[i] & 1);
    }
  }
};

// --- the system

struct Begin {  // each scene
  template <class T>
  DIFFVBD_FN void operator()(const RigidStep<T>& s, int64_t scene, int64_t) const {
    s.m.active[scene] = s.in.moving == nullptr, s.m.some[scene] = 0;
  }
};
struct BeginBody {  // each body
  template <class T>
  DIFFVBD_FN void operator()(const RigidStep<T>& s, int64_t scene, int64_t k) const {
    const int64_t unit = s.unit(scene, k);
    s.m.label[unit] = static_cast<int32_t>(k), s.m.blocks[unit] = 0;
    if (s.in.moving && s.in.moving[unit]) mark(s.m.active + scene);
  }
};
struct FindForce {  // rows
  template <class T>
  DIFFVBD_FN void operator()(const RigidStep<T>& s, int64_t row) const {
    PairForce& a = s.m.forces[row];
    const bool acts = s.exists(row) && s.m.active[s.record(row)[5]] && s.force(row, CornerPoints<T>{s.in, false}, a);
    if (!acts) a.body[0] = a.body[1] = -1, a.value = 0;
  }
};
// The bodies of what acts are of one group; -1 where no group has more than one.
template <class Run>
struct Join {  // rows
  template <class T>
  DIFFVBD_FN void operator()(const RigidStep<T>& s, int64_t row) const {
    const PairForce& a = s.m.forces[row];
    if (a.body[0] < 0 || a.body[1] < 0) return;
    int32_t* label = s.m.label + s.unit(s.record(row)[5], 0);
    if (most_grouped(s.in.bodies()) > 1) {
      Run::unite(label, a.body[0], a.body[1]);
    } else {
      label[a.body[0]] = label[a.body[1]] = -1;
    }
  }
};
template <class Run>
struct Flatten {  // each body
  template <class T>
  DIFFVBD_FN void operator()(const RigidStep<T>& s, int64_t scene, int64_t k) const {
    int32_t* label = s.m.label + s.unit(scene, 0);
    if (label[k] >= 0) label[k] = Run::root_of(label, static_cast<int32_t>(k));
  }
};
struct FindPlace {  // each body
  template <class T>
  DIFFVBD_FN void operator()(const RigidStep<T>& s, int64_t scene, int64_t of) const {
    const Groups g = s.in.groups_of(scene);
    const int32_t* label = s.m.label + s.unit(scene, 0);
    const int32_t k = static_cast<int32_t>(of), own = label[k];
    int32_t before = k, rank = 0, size = 1;
    if (g.capacity > 1) {
      before = rank = size = 0;
      for (int32_t j = 0; j < g.bodies; ++j) before += label[j] < own, size += label[j] == own;
      for (int32_t j = 0; j < k; ++j) rank += label[j] == own;
    }
    const bool left = own < 0 || size > g.capacity;
    g.member(before + rank) = k;
    g.first(k) = left ? before + rank : before, g.rank(k) = left ? 0 : rank;
    g.size(before + rank) = left ? kLeft : rank == 0 ? size : 0;
    s.out.alone[s.unit(scene, k)] = left;
  }
};
template <class Run>
struct Touch {  // rows
  template <class T>
  DIFFVBD_FN void operator()(const RigidStep<T>& s, int64_t row) const {
    const PairForce& a = s.m.forces[row];
    if (a.body[0] < 0 || a.body[1] < 0 || a.body[0] == a.body[1]) return;
    const int64_t scene = s.record(row)[5];
    const Groups g = s.in.groups_of(scene);
    if (!g.joined(a.body[0], a.body[1])) return;
    const bool swapped = g.rank(a.body[0]) > g.rank(a.body[1]);
    const int32_t low = a.body[swapped ? 1 : 0], high = a.body[swapped ? 0 : 1];
    Run::set_bit(s.m.blocks + s.unit(scene, g.place(low)), g.rank(high));
  }
};

struct ListForces {  // each vertex
  template <class T>
  DIFFVBD_FN void operator()(const RigidStep<T>& s, int64_t scene, int64_t v) const {
    s.list(scene, v, [&](int64_t row, int side) { return s.m.forces[row].body[side] >= 0; });
  }
};
struct Assemble {  // bodies
  template <class T, class Team>
  DIFFVBD_FN void operator()(const RigidStep<T>& s, const Body<T>& b, const Team& team) const {
    constexpr int kOwn = kUnknowns + rigid::kSix, kHalf = 3 * kUnknowns;
    const RigidInputs<T>& in = s.in;
    const Groups g = in.groups_of(b.scene);
    const int32_t first = g.first(b.body), rank = g.rank(b.body), size = kUnknowns * g.count(first);
    if (!s.m.active[b.scene]) return;
    const Whole whole = whole_of(b, team);
    const bool free = in.free[b.body] && 0 < whole.mass;
    if (team.leads()) put(s.m.center + 3 * s.unit(b.scene, b.body), whole.center);
    if (!in.moves(b.scene, g, first)) return;
    double total[kOwn + 1];  // and the sum of m r^2
    team.template sum<kOwn + 1>(free ? b.size() : 0, total, [&](int32_t i, double* to) {
      const int32_t v = b.vertex(i);
      const Vector arm = b.position(v) - whole.center;
      Vector force;
      Sym3<double> H;
      vertex_force(in, b, v, force, H);
      add_floor_friction(in, b, v, force, H);
      rigid::add_vertex(arm, force, H, to, to + kUnknowns);
      to[kOwn] += b.mass(v) * dot(arm, arm);
      s.each_listed(b.scene, v, [&](int64_t row, int side) {
        const PairForce& a = s.m.forces[row];
        const double share = borne(in, b.scene, a);
        for (int j = 0; j < kUnknowns; ++j) {
          to[j] += a.gradient(side, j, whole.center);
          const Vector along = share * (a.stiffness * a.map(side, j, whole.center));
          for (int k = j; k < kUnknowns; ++k)
            to[kUnknowns + rigid::at6(k, j)] += dot(a.map(side, k, whole.center), along);
        }
      });
    });
    double* const rows = s.m.matrix + in.matrix_size() * b.scene + g.matrix(first) + int64_t{kUnknowns} * rank * size;
    if (team.leads()) {
      double* solution = s.m.solution + kUnknowns * s.unit(b.scene, g.place(b.body));
      for (int i = 0; i < kUnknowns; ++i) {
        solution[i] = -total[i];
        total[kUnknowns + rigid::at6(i, i)] += !free ? 1 : i < 3 ? kLeastInertia * total[kOwn] : 0;
      }
    }
    team.each(kUnknowns * kUnknowns * rank,
              [&](int32_t i) { rows[i / (kUnknowns * rank) * size + i % (kUnknowns * rank)] = 0; });
    team.meet();
    if (team.leads()) {
      for (int i = 0; i < kUnknowns; ++i) {
        for (int j = 0; j <= i; ++j) rows[i * size + kUnknowns * rank + j] = total[kUnknowns + rigid::at6(i, j)];
      }
    }
    for (int32_t other = 0; other < rank; ++other) {
      const int32_t place = first + other, number = g.member(place);
      if (!(s.m.blocks[s.unit(b.scene, place)] >> rank & 1)) continue;
      const Whole other_whole = whole_of(Body<T>{in.scene, b.scene, number}, team);
      for (int half = 0; half < 2; ++half) {
        double block[kHalf];
        team.template sum<kHalf>(b.size(), block, [&](int32_t i, double* to) {
          s.each_listed(b.scene, b.vertex(i), [&](int64_t row, int side) {
            const PairForce& a = s.m.forces[row];
            if ((side == 0 ? a.body[1] : a.body[0]) != number) return;
            for (int j = 0; j < kUnknowns; ++j) {
              const Vector along = a.stiffness * a.map(1 - side, j, other_whole.center);
              for (int k = 0; k < 3; ++k) to[kUnknowns * k + j] += dot(a.map(side, 3 * half + k, whole.center), along);
            }
          });
        });
        if (!team.leads()) continue;
        for (int k = 0; k < kHalf; ++k) {
          rows[(3 * half + k / kUnknowns) * size + kUnknowns * other + k % kUnknowns] = block[k];
        }
      }
    }
  }
};

// Solves for the right side in `solution`; zero where the matrix was not positive definite, or nothing moves. Factors
// the matrix before, where it is new.
template <bool is_new>
struct Solve {  // groups
  template <class T, class Team>
  DIFFVBD_FN void operator()(const RigidStep<T>& s, int64_t scene, int32_t place, const Team& team) const {
    const Groups g = s.in.groups_of(scene);
    const int32_t count = g.count(place), size = kUnknowns * count;
    if (count == 0) return;
    double *matrix = s.m.matrix + s.in.matrix_size() * scene + g.matrix(place),
           *solution = s.m.solution + kUnknowns * s.unit(scene, place),
           *motion = s.m.motion + kUnknowns * s.unit(scene, 0);
    uint64_t* blocks = s.m.blocks + s.unit(scene, place);
    const bool moves = s.m.active[scene] && s.in.moves(scene, g, place);
    if (moves && is_new) cholesky::factor(team, count, matrix, blocks);
    if (moves) cholesky::solve(team, count, matrix, blocks, solution);
    bool finite = moves;
    for (int32_t i = 0; i < size; ++i) {
      finite = finite && absolute(solution[i]) < std::numeric_limits<double>::infinity();
    }
    team.meet();
    team.each(size, [&](int32_t i) {
      const double own = finite ? solution[i] : 0;
      const int32_t body = g.member(place + i / kUnknowns);
      if (is_new) motion[kUnknowns * body + i % kUnknowns] = own, s.m.solved[s.unit(scene, body)] = finite;
      solution[i] = own;
    });
    team.meet();
  }
};

DIFFVBD_RUNS
template <class Run, class T>
DIFFVBD_FN void system_of_bodies(const Run& run, const RigidStep<T>& s) {
  const int64_t n = s.in.bodies();
  run.each(Begin{}, s, 1);
  run.each(BeginBody{}, s, n);
  run.rows(FindForce{}, s);
  run.rows(Join<Run>{}, s);
  run.each(Flatten<Run>{}, s, n);
  run.each(FindPlace{}, s, n);
  run.rows(Touch<Run>{}, s);
  run.each(ListForces{}, s, s.in.scene.vertices);
  run.bodies(Assemble{}, s);
  run.groups(Solve<true>{}, s);
}

// --- the length of the step

struct FindReach {  // bodies
  template <class T, class Team>
  DIFFVBD_FN void operator()(const RigidStep<T>& s, const Body<T>& b, const Team& team) const {
    const int64_t unit = s.unit(b.scene, b.body);
    double most[2];
    const bool active = s.m.active[b.scene];
    team.template most<2>(active ? b.size() : 0, most, [&](int32_t i, double* to) {
      const Farthest own = farthest_of(s.in, b, b.vertex(i), s.m.center + 3 * unit, s.m.motion + kUnknowns * unit);
      to[0] = own.displacement, to[1] = own.size;
    });
    if (!team.leads()) return;
    s.m.reach[2 * unit] = most[0], s.m.reach[2 * unit + 1] = most[1];
    s.m.label[unit] = b.body, s.m.decided[unit] = !active, s.m.joined[unit] = 0;
    s.out.fraction[unit] = 0;
    const AdvanceState<T>& state = s.m.state;
    state.fraction[unit] = T(0), state.now[unit] = T(1), state.blocked[unit] = state.stamp[unit] = 0;
  }
};
// Whether a row may act; then its bodies are of one island.
template <class Run>
struct Near {  // rows
  template <class T>
  DIFFVBD_FN void operator()(const RigidStep<T>& s, int64_t row) const {
    s.m.near[row] = 0;
    if (!s.exists(row) || !s.m.active[s.record(row)[5]] || s.owner(row) < 0) return;
    const int32_t* of = s.record(row);
    const int64_t first = s.unit(of[5], 0);
    const bool near = s.is_listed(row) ? may_touch(s.in, row, s.m.reach + 2 * first)
                                       : Lag<T>(s.in.lag + kLagScalars * s.pair_of(row)).active();
    if (!near) return;
    s.m.near[row] = 1;
    const int32_t a = moving_body(s.in, of[0]), b = moving_body(s.in, of[sides(of[4])]);
    if (a < 0 || b < 0 || a == b) return;
    Run::unite(s.m.label + first, a, b);
    mark(s.m.joined + first + a), mark(s.m.joined + first + b);
  }
};
struct ListNear {  // each vertex, of the rows that its body owns
  template <class T>
  DIFFVBD_FN void operator()(const RigidStep<T>& s, int64_t scene, int64_t v) const {
    s.list(scene, v, [&](int64_t row, int side) {
      return s.m.near[row] && (side == 0) == (0 <= moving_body(s.in, s.record(row)[0]));
    });
  }
};
struct MoveVertex {  // each vertex
  double fraction;
  template <class T>
  DIFFVBD_FN void operator()(const RigidStep<T>& s, int64_t scene, int64_t of) const {
    const auto v = static_cast<int32_t>(of);
    const Body<T> b{s.in.scene, scene, s.in.gate.body[v]};
    const int64_t row = b.row(v), unit = s.unit(scene, b.body);
    if (s.m.decided[unit]) return;
    const Vector x = b.position(v);
    const Vector d = displaced(s.m.motion + kUnknowns * unit, fraction, x - wide_at(s.m.center + 3 * unit));
    put(s.m.move + 3 * row, d);
    s.m.motions[row] = motion_of(s.in.gate, s.m.state, scene, v);
    double change = 0, size = 0;
    if (s.in.free[b.body]) {
      const Vector off = x - b.target(v);
      change = change_of_vertex(s.in, b, v, d, size);
      const double slope = b.mass(v) * dot(off, d), bend = 0.5 * b.mass(v) * dot(d, d);
      change += slope + bend, size += absolute(slope) + bend;
      stay(s.in.gate, s.m.state, scene, v, 0);
    }
    s.m.own[2 * row] = change, s.m.own[2 * row + 1] = size;
  }
};
struct MoveRow {  // rows
  template <class T>
  DIFFVBD_FN void operator()(const RigidStep<T>& s, int64_t row) const {
    s.m.after[row] = 0;
    if (!s.m.near[row] || s.m.decided[s.owner(row)]) return;
    PairForce a;
    if (s.force(row, CornerPoints<T>{s.in, true}, a)) s.m.after[row] = a.value;
    if (s.is_listed(row)) test_pair(s.in.gate, s.m.state, row, 0);
  }
};
struct SumBody {  // bodies
  template <class T, class Team>
  DIFFVBD_FN void operator()(const RigidStep<T>& s, const Body<T>& b, const Team& team) const {
    const int64_t unit = s.unit(b.scene, b.body);
    if (s.m.decided[unit]) return;
    double sum[2];
    team.template sum<2>(b.size(), sum, [&](int32_t i, double* to) {
      const int32_t v = b.vertex(i);
      to[0] += s.m.own[2 * b.row(v)], to[1] += s.m.own[2 * b.row(v) + 1];
      s.each_listed(b.scene, v, [&](int64_t row, int) {
        const double before = s.m.forces[row].value, after = s.m.after[row];
        to[0] += after - before, to[1] += absolute(after) + absolute(before);
      });
    });
    if (team.leads()) s.m.sum[2 * unit] = sum[0], s.m.sum[2 * unit + 1] = sum[1];
  }
};
// An island that fits takes the fraction.
struct Decide {  // each body
  double fraction;
  template <class T>
  DIFFVBD_FN void operator()(const RigidStep<T>& s, int64_t scene, int64_t k) const {
    const int64_t first = s.unit(scene, 0);
    if (s.m.decided[first + k] || s.m.label[first + k] != k) return;
    const int64_t last = s.m.joined[first + k] ? s.in.bodies() : k + 1;
    double change = 0, size = 0;
    bool fits = true;
    const auto each = [&](const auto& f) {
      for (int64_t j = k; j < last; ++j) {
        if (s.m.label[first + j] == k) f(first + j);
      }
    };
    each([&](int64_t unit) {
      change += s.m.sum[2 * unit], size += s.m.sum[2 * unit + 1];
      fits = fits && !s.m.state.blocked[unit];
    });
    const double slack = kRounding * double(std::numeric_limits<T>::epsilon()) * size;
    const bool good = fits && change <= slack;
    each([&](int64_t unit) {
      s.m.state.blocked[unit] = 0;
      if (good) s.out.fraction[unit] = fraction, s.m.decided[unit] = 1;
    });
  }
};
struct EndVertex {  // each vertex
  template <class T>
  DIFFVBD_FN void operator()(const RigidStep<T>& s, int64_t scene, int64_t of) const {
    const auto v = static_cast<int32_t>(of);
    const Body<T> b{s.in.scene, scene, s.in.gate.body[v]};
    const int64_t row = b.row(v), unit = s.unit(scene, b.body);
    const double fraction = s.out.fraction[unit];
    const T* x = s.in.scene.x + 3 * row;
    Vec3<T> d = zero3<T>();
    if (fraction > 0) {
      const Vector whole =
          displaced(s.m.motion + kUnknowns * unit, fraction, b.position(v) - wide_at(s.m.center + 3 * unit));
      d = {T(whole.x), T(whole.y), T(whole.z)};
    }
    put(s.x_end + 3 * row, vector_at(x) + d);
  }
};
struct EndBody {  // each body
  template <class T>
  DIFFVBD_FN void operator()(const RigidStep<T>& s, int64_t scene, int64_t k) const {
    const int64_t unit = s.unit(scene, k);
    if (!s.m.solved[unit] || !s.in.free[k]) s.out.fraction[unit] = 0;  // it passes no adjoint on
    if (finish_trials(s.m.motion, unit, s.out)) mark(s.m.some + scene);
  }
};
struct EndBlocked {  // each body
  template <class T>
  DIFFVBD_FN void operator()(const RigidStep<T>& s, int64_t scene, int64_t k) const {
    if (!s.m.some[scene]) s.out.blocked[s.unit(scene, k)] = false;
  }
};

DIFFVBD_RUNS
template <class Run, class T>
DIFFVBD_FN void correct_bodies(const Run& run, const RigidStep<T>& s) {
  const int64_t n = s.in.bodies(), vertices = s.in.scene.vertices;
  system_of_bodies(run, s);
  run.bodies(FindReach{}, s);
  run.rows(Near<Run>{}, s);
  run.each(Flatten<Run>{}, s, n);
  run.each(ListNear{}, s, vertices);
  for (int trial = 0; trial < kTrials; ++trial) {
    const double fraction = fraction_of(kHalvings * trial);
    run.each(MoveVertex{fraction}, s, vertices);
    run.rows(MoveRow{}, s);
    run.bodies(SumBody{}, s);
    run.each(Decide{fraction}, s, n);
    if (run.is_done(s.m.decided, s.in.scene.scenes * n)) break;
  }
  run.each(EndVertex{}, s, vertices);
  run.each(EndBody{}, s, n);
  run.each(EndBlocked{}, s, n);
}

// --- the transpose: the work of pairs in two virtual motions, then that of a correction that took its fractions

template <class T>
struct WorkStep {
  RigidInputs<T> in;
  VirtualMotions<T> given;
  RigidWork<T> work;
  PointWork<T> sums;
  DIFFVBD_FN const RigidInputs<T>& inputs() const { return in; }
  DIFFVBD_FN int64_t listed() const { return work.listed; }
  DIFFVBD_FN int64_t lagged() const { return work.lagged; }
};

struct FindWork {  // rows
  template <class T>
  DIFFVBD_FN void operator()(const WorkStep<T>& s, int64_t row) const {
    if (row < s.work.listed) {
      s.work.pushes[row] = BarrierWork<T>::pushes(s.in, s.given, row);
      return;
    }
    const int64_t pair = row - s.work.listed;
    const LaggedWork<T> work(s.in, s.given, pair);
    T* rows = s.work.friction + 4 * kWorkScalars * pair;
    work.acts ? work.store(rows, s.work.lag_bar + kLagScalars * pair) : work.store_none(rows);
  }
};
struct StoreWork {  // parts
  template <class T>
  DIFFVBD_FN void operator()(const WorkStep<T>& s, int64_t row, int part) const {
    if (!s.work.pushes[row]) return;
    const BarrierWork<T> work(s.in, s.given, row, true);
    work.store(part, s.work.barrier + 4 * kWorkScalars * row, s.work.by_kappa + row);
  }
};
struct SumPoint {  // points
  template <class T, class Team>
  DIFFVBD_FN void operator()(const WorkStep<T>& s, int64_t point, const Team& team) const {
    double sum[kPointScalars];
    const int32_t listed = s.work.listed > 0 ? s.in.gate.listed.of(point).count : 0;
    const int32_t lagged = s.work.lagged > 0 ? s.in.lagged.of(point).count : 0;
    team.template sum<kPointScalars>(listed + lagged, sum, [&](int32_t i, double* to) {
      const bool pushes = i < listed;
      const int64_t entry = pushes ? s.in.gate.listed.of(point).first[i] : s.in.lagged.of(point).first[i - listed];
      if (pushes && !s.work.pushes[entry >> 2]) return;
      const T* row = (pushes ? s.work.barrier : s.work.friction) + kWorkScalars * entry;
      for (int k = 0; k < kWorkScalars; ++k) to[k] += row[k];
      for (int k = 0; !pushes && k < 3; ++k) to[kWorkScalars + k] += row[k];
    });
    if (team.leads()) store_at_point(sum, point, s.sums);
  }
};

DIFFVBD_RUNS
template <class Run, class T>
DIFFVBD_FN void sum_work(const Run& run, const WorkStep<T>& s) {
  run.rows(FindWork{}, s);
  run.parts(StoreWork{}, s, kWorkParts);
  run.points(SumPoint{}, s);
}

template <class T>
struct RigidReverse {
  RigidStep<T> step;
  WorkStep<T> work;
  const double* fraction;   // [B, bodies]
  bool* moving;             // of the step: bodies with a fraction
  const T* end_bar;         // [B, V, 3]; may be out.vertices.x
  T *p, *q, *displacement;  // as of virtual_motion() and reverse_end()
  CorrectionAdjoints<T> out;

  DIFFVBD_FN const RigidInputs<T>& inputs() const { return step.in; }
  DIFFVBD_FN double* motion(const Body<T>& b) const { return step.m.motion + kUnknowns * step.unit(b.scene, b.body); }
  DIFFVBD_FN double* solution(const Body<T>& b) const {
    return step.m.solution + kUnknowns * step.unit(b.scene, step.in.groups_of(b.scene).place(b.body));
  }
};

struct FindMoving {  // each body
  template <class T>
  DIFFVBD_FN void operator()(const RigidReverse<T>& r, int64_t scene, int64_t k) const {
    const int64_t unit = r.step.unit(scene, k);
    r.moving[unit] = r.fraction[unit] != 0;
  }
};
struct ReverseEnd {  // bodies
  template <class T, class Team>
  DIFFVBD_FN void operator()(const RigidReverse<T>& r, const Body<T>& b, const Team& team) const {
    reverse_end(b, team, r.motion(b), r.fraction[r.step.unit(b.scene, b.body)], r.end_bar, r.solution(b),
                r.displacement, r.out.vertices.mass);
  }
};
struct Virtual {  // bodies
  template <class T, class Team>
  DIFFVBD_FN void operator()(const RigidReverse<T>& r, const Body<T>& b, const Team& team) const {
    virtual_motion(r.step.in, b, team, r.motion(b), r.solution(b), r.p, r.q);
  }
};
struct ReverseVertices {  // bodies
  template <class T, class Team>
  DIFFVBD_FN void operator()(const RigidReverse<T>& r, const Body<T>& b, const Team& team) const {
    reverse_vertices(r.step.in, b, team, r.motion(b), r.solution(b), r.displacement, r.work.sums, r.out);
  }
};
struct ReverseCollider {  // each point of a collider
  template <class T>
  DIFFVBD_FN void operator()(const RigidReverse<T>& r, int64_t scene, int64_t point) const {
    reverse_collider(r.step.in, scene, static_cast<int32_t>(point), r.work.sums, r.out);
  }
};

DIFFVBD_RUNS
template <class Run, class T>
DIFFVBD_FN void reverse_bodies(const Run& run, const RigidReverse<T>& r) {
  const AdvanceInputs<T>& gate = r.step.in.gate;
  run.each(FindMoving{}, r, r.step.in.bodies());
  system_of_bodies(run, r.step);
  run.bodies(ReverseEnd{}, r);
  run.groups(Solve<false>{}, r.step);
  run.bodies(Virtual{}, r);
  sum_work(run, r.work);
  run.bodies(ReverseVertices{}, r);
  run.each(ReverseCollider{}, r, gate.corners - gate.vertices);
}

}  // namespace diffvbd::contact
