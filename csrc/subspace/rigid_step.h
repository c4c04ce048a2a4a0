// The loops of the rigid correction of bodies that touch (docs/method.md, section 18): one Newton step of the
// incremental potential in the turn and the shift of every body,
//
//     (J' H J) d = -J' g,        x <- x moved by s d,
//
// where s is the first of 1, 1/4, ... that raises no potential and that nothing blocks, for each island of bodies; and
// its transpose. The shift that all bodies of an island have in common changes no gap between them: an island on which
// nothing else acts takes it whole with any s, 0 among them, in place of s times its mean motion, and so keeps its
// momentum. In double precision. Runs are those of trials.h.
#pragma once

#include "cholesky.h"
#include "contact_rigid_reverse.h"
#include "trials.h"

namespace diffvbd::contact {

constexpr int kTrials = 6, kHalvings = 2;  // fractions 1, 1/4, ..., 1/1024 before 0

constexpr int kCommon = 7;  // scalars of Common

// Memory of a correction beyond that of its trials, by body [B, bodies] and by place [B, bodies].
struct RigidMemory {
  uint8_t* solved;            // by body
  double *center, *motion;    // by body [3], [6]
  double *rest, *common;      // by body: sum of m (y - x), and mass, 0 where a vertex energy acts; Common [7]
  double *solution, *matrix;  // by place: six; and as Groups::matrix() says
  uint64_t* blocks;           // by place
  int32_t* groups;            // [B, 4, bodies]

  // take(pointer, items), for so many scenes, and bodies of all of them; size: of the matrices of a scene
  template <class Take>
  void parts(Take& take, int64_t scenes, int64_t units, int64_t size) {
    take(solved, units), take(blocks, units), take(rest, 4 * units), take(common, kCommon * units);
    take(center, 3 * units), take(motion, kUnknowns * units), take(solution, kUnknowns * units);
    take(matrix, scenes * size), take(groups, kGroupRows * units);
  }
};

// The result of a correction, of each body [B, bodies].
template <class T>
struct RigidOutcome {
  double* taken;  // [2]: fraction of its motion; the first body of the island whose common shift it took whole, or -1
  T* left;        // the rest of its shift [m]
};

// Of an island: the mean of y - x by mass, its common shift; that of the shifts of its bodies, which differs where they
// were too many for one system; its mass. All 0 where something else acts on it.
struct Common {
  Vector shift, mean;
  double mass;
  DIFFVBD_FN void add(const double* rest, const double* motion) {
    shift += wide_at(rest), mean += rest[3] * wide_at(motion + 3), mass += rest[3];
  }
  DIFFVBD_FN void divide() { shift = (1 / mass) * shift, mean = (1 / mass) * mean; }
};

// The groups of the inputs are those of the memory.
template <class T>
struct RigidStep : TrialStep<T> {
  RigidMemory r;
  RigidOutcome<T> out;

  DIFFVBD_FN const double* motion_of(const Body<T>& b) const {
    return r.motion + kUnknowns * this->unit(b.scene, b.body);
  }
  DIFFVBD_FN Vector arm(const Body<T>& b, int32_t v) const {
    return b.position(v) - wide_at(r.center + 3 * this->unit(b.scene, b.body));
  }
  DIFFVBD_FN Common common(int64_t unit) const {
    const double* at = r.common + kCommon * unit;
    return {wide_at(at), wide_at(at + 3), at[6]};
  }
  DIFFVBD_FN bool shares(int64_t unit) const { return 0 < common(unit).mass; }
  DIFFVBD_FN void share(int64_t unit, const Common& a) const {
    double* to = r.common + kCommon * unit;
    put(to, a.shift), put(to + 3, a.mean), to[6] = a.mass;
  }
  DIFFVBD_FN Vector displacement(const Body<T>& b, int32_t v, double fraction) const {
    const Common a = common(this->unit(b.scene, b.body));
    return displaced(motion_of(b), fraction, arm(b, v)) + (a.shift - fraction * a.mean);
  }
  DIFFVBD_FN bool moves(int64_t unit) const {
    return this->fraction[unit] > 0 || (this->m.decided[unit] && shares(unit));
  }
  DIFFVBD_FN double smooth_change(const Body<T>&, int32_t, double, double&) const { return 0; }
  DIFFVBD_FN double length(const Body<T>& b, int32_t v) const {
    const auto size = [](const Vector& a) { return square_root(dot(a, a)); };
    return size(wide_at(motion_of(b) + 3)) + size(wide_at(motion_of(b))) * size(arm(b, v));
  }
  DIFFVBD_FN double slope(int64_t) const { return 0; }
};

// --- the system

struct Begin {  // each scene
  template <class T>
  DIFFVBD_FN void operator()(const RigidStep<T>& s, int64_t scene, int64_t) const {
    s.m.active[scene] = s.in.moving == nullptr;
  }
};
struct BeginBody {  // each body
  template <class T>
  DIFFVBD_FN void operator()(const RigidStep<T>& s, int64_t scene, int64_t k) const {
    const int64_t unit = s.unit(scene, k);
    s.m.label[unit] = static_cast<int32_t>(k), s.r.blocks[unit] = 0;
    if (s.in.moving && s.in.moving[unit]) mark(s.m.active + scene);
  }
};
// Whether any body is to move.
DIFFVBD_RUNS
template <class Run, class T>
DIFFVBD_FN bool begin_bodies(const Run& run, const RigidStep<T>& s) {
  run.each(Begin{}, s, 1);
  run.each(BeginBody{}, s, s.in.bodies());
  return !run.none(s.m.active, s.in.scene.scenes);
}

// The bodies of what acts are of one group.
template <class Run>
struct Join {  // rows
  template <class T>
  DIFFVBD_FN void operator()(const RigidStep<T>& s, int64_t row) const {
    const PairForce& a = s.m.forces[row];
    if (a.body[0] < 0 || a.body[1] < 0 || most_grouped(s.in.bodies()) == 1) return;
    Run::unite(s.m.label + s.unit(s.record(row)[5], 0), a.body[0], a.body[1]);
  }
};
struct FindPlace {  // each body
  template <class T>
  DIFFVBD_FN void operator()(const RigidStep<T>& s, int64_t scene, int64_t of) const {
    const Groups g = s.in.groups_of(scene);
    const int32_t* label = s.m.label + s.unit(scene, 0);
    const int32_t k = static_cast<int32_t>(of), own = label[k];
    const auto most = static_cast<int32_t>(g.capacity);
    int32_t before = k, rank = 0, size = 1;
    if (most > 1) {
      before = rank = size = 0;
      for (int32_t j = 0; j < g.bodies; ++j) before += label[j] < own, size += label[j] == own;
      for (int32_t j = 0; j < k; ++j) rank += label[j] == own;
    }
    const int32_t part = rank / most * most;  // bodies of its group in parts before its own
    g.member(before + rank) = k;
    g.first(k) = before + part, g.rank(k) = rank - part;
    g.count(before + rank) = rank > part ? 0 : size - part < most ? size - part : most;
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
    Run::set_bit(s.r.blocks + s.unit(scene, g.place(low)), g.rank(high));
  }
};

struct ListForces {  // each vertex
  template <class T>
  DIFFVBD_FN void operator()(const RigidStep<T>& s, int64_t scene, int64_t v) const {
    s.list(scene, v, [&](int64_t row, int corner) {
      const int side = s.side_of(row, corner);
      return side >= 0 && s.m.forces[row].body[side] >= 0;
    });
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
    if (team.leads()) put(s.r.center + 3 * s.unit(b.scene, b.body), whole.center);
    if (!in.moves(b.scene, g, first)) return;
    double total[kOwn + 5];  // and sums of m r^2 and m (y - x), and on how many vertices an energy acts
    team.template sum<kOwn + 5>(free ? b.size() : 0, total, [&](int32_t i, double* to) {
      const int32_t v = b.vertex(i);
      const Vector arm = b.position(v) - whole.center;
      Vector force;
      Sym3<double> H;
      vertex_force(in, b, v, force, H);
      add_floor_friction(in, b, v, force, H);
      rigid::add_vertex(arm, force, H, to, to + kUnknowns);
      to[kOwn] += b.mass(v) * dot(arm, arm);
      add_to(to + kOwn + 1, b.mass(v) * (b.target(v) - b.position(v)));
      to[kOwn + 4] += H.xx + H.yy + H.zz > 3 * b.mass(v);
      s.each_listed(b.scene, v, [&](int64_t row, int corner) {
        const PairForce& a = s.m.forces[row];
        const int side = corner == 0 ? 0 : 1;
        const double share = borne(in, b.scene, a);
        for (int j = 0; j < kUnknowns; ++j) {
          to[j] += a.gradient(side, j, whole.center);
          const Vector along = share * (a.stiffness * a.map(side, j, whole.center));
          for (int k = j; k < kUnknowns; ++k)
            to[kUnknowns + rigid::at6(k, j)] += dot(a.map(side, k, whole.center), along);
        }
      });
    });
    double* const rows = s.r.matrix + in.matrix_size() * b.scene + g.matrix(first) + int64_t{kUnknowns} * rank * size;
    if (team.leads()) {
      double* solution = s.r.solution + kUnknowns * s.unit(b.scene, g.place(b.body));
      double* rest = s.r.rest + 4 * s.unit(b.scene, b.body);
      put(rest, vector_at(total + kOwn + 1)), rest[3] = free && total[kOwn + 4] == 0 ? whole.mass : 0;
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
      if (!(s.r.blocks[s.unit(b.scene, place)] >> rank & 1)) continue;
      const Whole other_whole = whole_of(Body<T>{in.scene, b.scene, number}, team);
      for (int half = 0; half < 2; ++half) {
        double block[kHalf];
        team.template sum<kHalf>(b.size(), block, [&](int32_t i, double* to) {
          s.each_listed(b.scene, b.vertex(i), [&](int64_t row, int corner) {
            const PairForce& a = s.m.forces[row];
            const int side = corner == 0 ? 0 : 1;
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
    double *matrix = s.r.matrix + s.in.matrix_size() * scene + g.matrix(place),
           *solution = s.r.solution + kUnknowns * s.unit(scene, place),
           *motion = s.r.motion + kUnknowns * s.unit(scene, 0);
    uint64_t* blocks = s.r.blocks + s.unit(scene, place);
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
      if (is_new) motion[kUnknowns * body + i % kUnknowns] = own, s.r.solved[s.unit(scene, body)] = finite;
      solution[i] = own;
    });
    team.meet();
  }
};

DIFFVBD_RUNS
template <class Run, class T>
DIFFVBD_FN void system_of_bodies(const Run& run, const RigidStep<T>& s) {
  const int64_t n = s.in.bodies();
  run.rows(FindForce{}, s);
  run.rows(Join<Run>{}, s);
  run.each(Flatten<Run>{}, s, n);
  run.each(FindPlace{}, s, n);
  run.rows(Touch<Run>{}, s);
  run.each(ListForces{}, s, s.in.scene.vertices);
  run.bodies(Assemble{}, s);
  run.groups(Solve<true>{}, s);
}

// --- what the bodies of an island have in common

// Calls f(unit) for the bodies of the island whose first is k.
template <class T, class F>
DIFFVBD_FN void each_of_island(const RigidStep<T>& s, int64_t scene, int64_t k, const F& f) {
  const int64_t first = s.unit(scene, 0);
  if (s.m.label[first + k] != k) return;
  for (int64_t j = k; j < (s.m.joined[first + k] ? s.in.bodies() : k + 1); ++j) {
    if (s.m.label[first + j] == k) f(first + j);
  }
}
struct Share {  // each body
  template <class T>
  DIFFVBD_FN void operator()(const RigidStep<T>& s, int64_t scene, int64_t k) const {
    Common common{};
    bool alone = true;
    each_of_island(s, scene, k, [&](int64_t unit) {
      const double* rest = s.r.rest + 4 * unit;
      common.add(rest, s.r.motion + kUnknowns * unit);
      alone = alone && 0 < rest[3] && s.r.solved[unit] && !s.m.held[unit];
    });
    common.divide();
    const double length = square_root(dot(common.shift, common.shift));
    each_of_island(s, scene, k, [&](int64_t unit) {
      s.share(unit, alone ? common : Common{});
      if (alone) s.m.reach[2 * unit] += (1 + kRounded) * length;
    });
  }
};
struct Hold {  // rows: no island comes near another by its common shift
  template <class T>
  DIFFVBD_FN void operator()(const RigidStep<T>& s, int64_t row) const {
    if (!s.is_listed(row) || s.m.near[row] || !s.exists(row) || s.owner(row) < 0) return;
    const int32_t* of = s.record(row);
    const int64_t first = s.unit(of[5], 0);
    const int32_t a = moving_body(s.in, of[0]), b = moving_body(s.in, of[sides(of[4])]);
    if (0 <= a && 0 <= b && s.m.label[first + a] == s.m.label[first + b]) return;
    if (!may_touch(s.in, row, s.m.reach + 2 * first)) return;
    if (0 <= a) mark(s.m.held + first + a);
    if (0 <= b) mark(s.m.held + first + b);
  }
};
// Takes it from islands that are held, or from those that are not decided.
template <bool undecided>
struct Drop {  // each body
  template <class T>
  DIFFVBD_FN void operator()(const RigidStep<T>& s, int64_t scene, int64_t k) const {
    bool drops = false;
    each_of_island(s, scene, k,
                   [&](int64_t unit) { drops = drops || (undecided ? !s.m.decided[unit] : s.m.held[unit]); });
    if (drops) each_of_island(s, scene, k, [&](int64_t unit) { s.share(unit, {}); });
  }
};

// --- the end of the step

struct EndBody {  // each body
  template <class T>
  DIFFVBD_FN void operator()(const RigidStep<T>& s, int64_t scene, int64_t k) const {
    const int64_t unit = s.unit(scene, k);
    const bool passes_on = s.r.solved[unit] && s.in.free[k];  // an adjoint
    const double fraction = passes_on ? s.fraction[unit] : 0;
    const int32_t island = s.m.label[unit];
    const bool shares = passes_on && s.moves(unit) && s.shares(unit) &&
                        (fraction < 1 || s.m.joined[s.unit(scene, island)]);  // one body has taken it
    const Vector rest = wide_at(s.r.motion + kUnknowns * unit + 3) - (shares ? s.common(unit).mean : Vector{});
    s.out.taken[2 * unit] = fraction;
    s.out.taken[2 * unit + 1] = shares ? island : -1;
    s.out.left[unit] = T((1 - fraction) * square_root(dot(rest, rest)));
  }
};

DIFFVBD_RUNS
template <class Run, class T>
DIFFVBD_FN void correct_bodies(const Run& run, const RigidStep<T>& s) {
  const int64_t n = s.in.bodies();
  begin_bodies(run, s);
  system_of_bodies(run, s);
  run.bodies(FindReach{}, s);
  find_islands(run, s);
  run.each(Share{}, s, n);
  run.rows(Hold{}, s);
  run.each(Drop<false>{}, s, n);
  run.each(ListNear{}, s, s.in.scene.vertices);
  bool done = false;
  for (int trial = 0; trial < kTrials && !done; ++trial) done = try_fraction(run, s, fraction_of(kHalvings * trial));
  if (!done) done = try_fraction(run, s, 0);
  if (!done) run.each(Drop<true>{}, s, n);
  for (int trial = 1; trial < kTrials && !done; ++trial) done = try_fraction(run, s, fraction_of(kHalvings * trial));
  run.each(EndVertex{}, s, s.in.scene.vertices);
  run.each(EndBody{}, s, n);
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
  const double* taken;      // as of RigidOutcome
  bool* moving;             // of the step: bodies that have moved
  double* bar;              // by body [3]: of a shift of it, and then of its island by mass
  const T* end_bar;         // [B, V, 3]
  T *p, *q, *displacement;  // as of virtual_motion() and reverse_end()
  CorrectionAdjoints<T> out;

  DIFFVBD_FN const RigidInputs<T>& inputs() const { return step.in; }
  DIFFVBD_FN double* motion(const Body<T>& b) const { return step.r.motion + kUnknowns * step.unit(b.scene, b.body); }
  DIFFVBD_FN double* solution(const Body<T>& b) const {
    return step.r.solution + kUnknowns * step.unit(b.scene, step.in.groups_of(b.scene).place(b.body));
  }
};

struct FindMoving {  // each body
  template <class T>
  DIFFVBD_FN void operator()(const RigidReverse<T>& r, int64_t scene, int64_t k) const {
    const int64_t unit = r.step.unit(scene, k);
    r.moving[unit] = r.taken[2 * unit] > 0 || r.taken[2 * unit + 1] >= 0;
  }
};
struct PassOn {  // each vertex, where nothing moved
  template <class T>
  DIFFVBD_FN void operator()(const RigidReverse<T>& r, int64_t scene, int64_t v) const {
    const int64_t at = 3 * (scene * r.step.in.gate.vertices + v);
    put(r.out.vertices.x + at, vector_at(r.end_bar + at));
  }
};
struct SumEnd {  // bodies, the adjoint of a shift of each
  template <class T, class Team>
  DIFFVBD_FN void operator()(const RigidReverse<T>& r, const Body<T>& b, const Team& team) const {
    const int64_t unit = r.step.unit(b.scene, b.body);
    if (r.taken[2 * unit + 1] < 0) return;
    double sum[3];
    team.template sum<3>(b.size(), sum,
                         [&](int32_t i, double* to) { add_to(to, wide_at(r.end_bar + 3 * b.row(b.vertex(i)))); });
    if (team.leads()) put(r.bar + 3 * unit, vector_at(sum));
  }
};
struct SumIsland {  // each body, and by mass
  template <class T>
  DIFFVBD_FN void operator()(const RigidReverse<T>& r, int64_t scene, int64_t k) const {
    const RigidStep<T>& s = r.step;
    const auto each = [&](const auto& f) {
      for (int64_t unit = s.unit(scene, k); unit < s.unit(scene, s.in.bodies()); ++unit) {
        if (r.taken[2 * unit + 1] == k) f(unit);
      }
    };
    if (r.taken[2 * s.unit(scene, k) + 1] != k) return;
    Common common{};
    Vector bar{};
    each([&](int64_t unit) {
      common.add(s.r.rest + 4 * unit, s.r.motion + kUnknowns * unit), bar += wide_at(r.bar + 3 * unit);
    });
    common.divide();
    each([&](int64_t unit) { s.share(unit, common), put(r.bar + 3 * unit, (1 / common.mass) * bar); });
  }
};
struct ReverseEnd {  // bodies
  template <class T, class Team>
  DIFFVBD_FN void operator()(const RigidReverse<T>& r, const Body<T>& b, const Team& team) const {
    const int64_t unit = r.step.unit(b.scene, b.body);
    const double fraction = r.taken[2 * unit];
    reverse_end(b, team, r.motion(b), fraction, r.end_bar, r.solution(b), r.displacement, r.out.vertices.mass);
    if (r.taken[2 * unit + 1] < 0) return;
    const Common common = r.step.common(unit);
    const Vector each = wide_at(r.bar + 3 * unit),
                 off = common.shift + fraction * (wide_at(r.motion(b) + 3) - common.mean);
    team.each(b.size(), [&](int32_t i) {
      const int32_t v = b.vertex(i);
      const int64_t row = b.row(v);
      add_to(r.displacement + 3 * row, -b.mass(v) * each);
      add_to(r.out.vertices.y + 3 * row, b.mass(v) * each);
      r.out.vertices.mass[row] += T(dot(b.target(v) - b.position(v) - off, each));
    });
    if (team.leads()) add_to(r.solution(b) + 3, -(fraction * r.step.r.rest[4 * unit + 3]) * each);
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
  if (!begin_bodies(run, r.step)) {
    run.each(PassOn{}, r, gate.vertices);
    return;
  }
  system_of_bodies(run, r.step);
  run.bodies(SumEnd{}, r);
  run.each(SumIsland{}, r, r.step.in.bodies());
  run.bodies(ReverseEnd{}, r);
  run.groups(Solve<false>{}, r.step);
  run.bodies(Virtual{}, r);
  sum_work(run, r.work);
  run.bodies(ReverseVertices{}, r);
  run.each(ReverseCollider{}, r, gate.corners - gate.vertices);
}

}  // namespace diffvbd::contact
