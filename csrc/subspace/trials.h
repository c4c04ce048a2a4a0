// Trial fractions of a displacement of bodies that touch (docs/method.md, sections 16 and 18): a correction takes the
// first of a few fractions that nothing blocks and that lowers the incremental potential enough, for each island of
// bodies, or none of it. In double precision.
//
// A Run makes the loops over the items of scenes: run.each(phase, step, n) calls phase(step, scene, i) for i < n,
// run.rows() phase(step, row) for listed and then lagged pairs, run.parts() phase(step, row, part) for the former,
// run.bodies() phase(step, body, team), run.groups() phase(step, scene, place, team), and run.points() phase(step,
// point, team) for corner points. What a loop wrote the next one may read. run.all(flags, n): whether n flags are set,
// run.none(flags, n) whether none is; both false on launches, where the host would wait.
#pragma once

#include "coarse.h"
#include "contact_rigid.h"

// Of functions that run where their Run does.
#ifdef __CUDACC__
#define DIFFVBD_RUNS _Pragma("nv_exec_check_disable")
#else
#define DIFFVBD_RUNS
#endif

namespace diffvbd::contact {

using rigid::Body;

constexpr double kRounded = 1e-6;  // of a length, that rounding cannot reach

// Rows of listed pairs, and then of lagged ones, and those of each vertex.
struct RowMemory {
  int64_t listed, lagged;  // rows of the lists
  int32_t *list, *count;   // [4 rows]; by vertex [2]: see Rows::list()

  DIFFVBD_FN int64_t rows() const { return listed + lagged; }
  // take(pointer, items), for so many vertices of all scenes
  template <class Take>
  void parts(Take& take, int64_t vertices) {
    take(list, 4 * rows()), take(count, 2 * vertices);
  }
};

template <class T>
struct Rows {
  RigidInputs<T> in;
  RowMemory all;

  DIFFVBD_FN const RigidInputs<T>& inputs() const { return in; }
  DIFFVBD_FN int64_t listed() const { return all.listed; }
  DIFFVBD_FN int64_t lagged() const { return all.lagged; }
  DIFFVBD_FN int64_t unit(int64_t scene, int64_t body) const { return scene * in.bodies() + body; }
  DIFFVBD_FN bool is_listed(int64_t row) const { return row < all.listed; }
  DIFFVBD_FN int64_t pair_of(int64_t row) const { return is_listed(row) ? row : row - all.listed; }
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
  // The side of which a corner is the first, or -1.
  DIFFVBD_FN int side_of(int64_t row, int corner) const {
    return corner == 0 ? 0 : corner == sides(record(row)[4]) ? 1 : -1;
  }
  // Lists the rows of a vertex where keep(row, corner).
  template <class Keep>
  DIFFVBD_FN void list(int64_t scene, int64_t v, const Keep& keep) const {
    for (int which = 0; which < 2; ++which) {
      int32_t& found = all.count[2 * (scene * in.scene.vertices + v) + which];
      found = 0;
      if ((which == 0 ? all.listed : all.lagged) == 0) continue;
      const PairList& pairs = which == 0 ? in.gate.listed : in.lagged;
      const int64_t point = scene * in.gate.corners + v, first = which == 0 ? 0 : all.listed;
      const PairList::Entries entries = pairs.of(point);
      for (int e = 0; e < entries.count; ++e) {
        const int32_t entry = entries.first[e];
        if (keep(first + (entry >> 2), entry & 3)) all.list[4 * first + pairs.ptr[point] + found++] = entry;
      }
    }
  }
  // Calls f(row, corner) for them.
  template <class F>
  DIFFVBD_FN void each_listed(int64_t scene, int64_t v, const F& f) const {
    for (int which = 0; which < 2; ++which) {
      const int32_t count = all.count[2 * (scene * in.scene.vertices + v) + which];
      if (count == 0) continue;
      const PairList& pairs = which == 0 ? in.gate.listed : in.lagged;
      const int64_t first = which == 0 ? 0 : all.listed;
      const int32_t* own = all.list + 4 * first + pairs.ptr[scene * in.gate.corners + v];
      for (int32_t i = 0; i < count; ++i) f(first + (own[i] >> 2), own[i] & 3);
    }
  }
};

// Memory of the trials, by body [B, bodies], vertex [B, V] and row.
template <class T>
struct TrialMemory {
  PairForce* forces;                  // by row, before; of bodies that it acts on, or -1
  uint8_t *near, *active;             // by row: whether it may act after the displacement; by scene [B]
  int32_t* label;                     // by body: the first body of its island
  double *reach, *sum, *own, *after;  // by body [2]: Farthest; by body and vertex [2]: change, size; by row
  uint8_t *decided, *joined, *held;   // by body; held: near what is not of its island
  T* move;                            // by vertex [3]; of the inputs
  AdvanceState<T> state;
  Motion<T>* motions;  // by vertex, that of `state`

  // take(pointer, items), for so many rows and scenes, and vertices and bodies of all of them; trials: whether there
  // are any
  template <class Take>
  void parts(Take& take, int64_t rows, int64_t scenes, int64_t vertices, int64_t units, bool trials) {
    take(forces, rows), take(active, scenes), take(label, units);
    if (!trials) return;
    take(near, rows), take(after, rows), take(reach, 2 * units), take(sum, 2 * units), take(own, 2 * vertices);
    take(decided, units), take(joined, units), take(held, units), take(move, 3 * vertices), take(motions, vertices);
    take(state.fraction, units), take(state.now, units), take(state.blocked, units), take(state.stamp, units);
  }
};

// Bounds for any fraction of the displacement of a vertex: its displacement since gaps were taken, and the size of its
// position, the scale of rounding.
struct Farthest {
  double displacement, size;
};

// Of a Step, displacement(body, v, fraction), moves(unit), whether a body has a displacement in the end,
// smooth_change(body, v, fraction, size), the change of what pairs, vertex energies and inertia are not, whose terms'
// sizes are added, length(body, v), of any fraction of a motion, and slope(unit), of the potential along the whole
// displacement; 0 asks for no decrease.
template <class T>
struct TrialStep : Rows<T> {
  using Scalar = T;
  TrialMemory<T> m;
  double* fraction;  // [B, bodies]
  T* x_end;          // [B, V, 3]
};

struct FindForce {  // rows
  template <class T>
  DIFFVBD_FN void operator()(const TrialStep<T>& s, int64_t row) const {
    PairForce& a = s.m.forces[row];
    const bool acts = s.exists(row) && s.m.active[s.record(row)[5]] && s.force(row, CornerPoints<T>{s.in, false}, a);
    if (!acts) a.body[0] = a.body[1] = -1, a.value = 0;
  }
};
template <class Run>
struct Flatten {  // each body
  template <class T>
  DIFFVBD_FN void operator()(const TrialStep<T>& s, int64_t scene, int64_t k) const {
    int32_t* label = s.m.label + s.unit(scene, 0);
    label[k] = Run::root_of(label, static_cast<int32_t>(k));
  }
};
struct FindReach {  // bodies
  template <class Step, class T, class Team>
  DIFFVBD_FN void operator()(const Step& s, const Body<T>& b, const Team& team) const {
    const int64_t unit = s.unit(b.scene, b.body);
    const AdvanceInputs<T>& gate = s.in.gate;
    double most[2];
    const bool active = s.m.active[b.scene];
    team.template most<2>(active ? b.size() : 0, most, [&](int32_t i, double* to) {
      const int32_t v = b.vertex(i);
      const int64_t row = 3 * b.row(v);
      const Vector since = b.position(v) - wide_at(gate.center + row);
      const Vec3<T> at = vector_at(gate.x + row), from = gate.origin ? vector_at(gate.origin + row) : zero3<T>();
      to[0] = (1 + kRounded) * (square_root(dot(since, since)) + s.length(b, v)), to[1] = size_of(at + from);
    });
    if (!team.leads()) return;
    s.m.reach[2 * unit] = most[0], s.m.reach[2 * unit + 1] = most[1];
    s.m.label[unit] = b.body, s.m.decided[unit] = !active, s.m.joined[unit] = s.m.held[unit] = 0;
    s.fraction[unit] = 0;
    const AdvanceState<T>& state = s.m.state;
    state.fraction[unit] = T(0), state.now[unit] = T(1), state.blocked[unit] = state.stamp[unit] = 0;
  }
};
// Whether a listed pair may come within reach of its barrier for any fractions: a gap shrinks by no more than its sides
// have moved.
template <class T>
DIFFVBD_FN bool may_touch(const RigidInputs<T>& in, int64_t pair, const double* reach) {
  if (!is_between(in, pair)) return false;
  const int32_t* record = in.gate.listed.pairs + kPairRow * pair;
  const T* constants = in.gate.constants + kConstants * pair;
  const int32_t a = in.gate.body[record[0]], b = in.gate.body[record[sides(record[4])]];
  if (a >= in.bodies() || b >= in.bodies()) return true;  // its gap may be older
  const double gap = PairHints<T>(constants).gap - PairConstants<T>(constants).dhat;
  const T size = static_cast<T>(larger(reach[2 * a + 1], reach[2 * b + 1]));
  return !(reach[2 * a] + reach[2 * b] < (1 - kRounded) * (gap - guard_of_size(size)));  // as stays_far()
}
// Whether a row may act; then its bodies are of one island.
template <class Run>
struct Near {  // rows
  template <class T>
  DIFFVBD_FN void operator()(const TrialStep<T>& s, int64_t row) const {
    s.m.near[row] = 0;
    if (!s.exists(row) || !s.m.active[s.record(row)[5]] || s.owner(row) < 0) return;
    const int32_t* of = s.record(row);
    const int64_t first = s.unit(of[5], 0);
    const bool near = s.is_listed(row) ? may_touch(s.in, row, s.m.reach + 2 * first)
                                       : Lag<T>(s.in.lag + kLagScalars * s.pair_of(row)).active();
    if (!near) return;
    s.m.near[row] = 1;
    const int32_t a = moving_body(s.in, of[0]), b = moving_body(s.in, of[sides(of[4])]);
    if (a < 0 || b < 0) mark(s.m.held + first + (a < 0 ? b : a));
    if (a < 0 || b < 0 || a == b) return;
    Run::unite(s.m.label + first, a, b);
    mark(s.m.joined + first + a), mark(s.m.joined + first + b);
  }
};
struct ListNear {  // each vertex, of the rows that its body owns
  template <class T>
  DIFFVBD_FN void operator()(const TrialStep<T>& s, int64_t scene, int64_t v) const {
    s.list(scene, v, [&](int64_t row, int corner) {
      return s.m.near[row] && s.side_of(row, corner) == (0 <= moving_body(s.in, s.record(row)[0]) ? 0 : 1);
    });
  }
};
struct MoveVertex {  // each vertex
  double fraction;
  template <class Step>
  DIFFVBD_FN void operator()(const Step& s, int64_t scene, int64_t of) const {
    const auto v = static_cast<int32_t>(of);
    const Body<typename Step::Scalar> b{s.in.scene, scene, s.in.gate.body[v]};
    const int64_t row = b.row(v), unit = s.unit(scene, b.body);
    if (s.m.decided[unit]) return;
    const Vector d = s.displacement(b, v, fraction);
    put(s.m.move + 3 * row, d);
    s.m.motions[row] = motion_of(s.in.gate, s.m.state, scene, v);
    double size = 0, change = s.smooth_change(b, v, fraction, size);
    if (s.in.free[b.body] && !s.in.gate.pinned[v]) {
      const Vector off = b.position(v) - b.target(v);
      const double slope = b.mass(v) * dot(off, d), bend = 0.5 * b.mass(v) * dot(d, d);
      change += change_of_vertex(s.in, b, v, d, size) + (slope + bend), size += absolute(slope) + bend;
      stay(s.in.gate, s.m.state, scene, v, 0);
    }
    s.m.own[2 * row] = change, s.m.own[2 * row + 1] = size;
  }
};
struct MoveRow {  // rows
  template <class T>
  DIFFVBD_FN void operator()(const TrialStep<T>& s, int64_t row) const {
    s.m.after[row] = 0;
    if (!s.m.near[row] || s.m.decided[s.owner(row)]) return;
    PairForce a;
    if (s.force(row, CornerPoints<T>{s.in, true}, a)) s.m.after[row] = a.value;
    if (s.is_listed(row)) test_pair(s.in.gate, s.m.state, row, 0);
  }
};
struct SumBody {  // bodies
  template <class T, class Team>
  DIFFVBD_FN void operator()(const TrialStep<T>& s, const Body<T>& b, const Team& team) const {
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
// An island that fits takes the fraction; one whose displacement does not descend takes none.
struct Decide {  // each body
  double fraction;
  template <class Step>
  DIFFVBD_FN void operator()(const Step& s, int64_t scene, int64_t k) const {
    using T = typename Step::Scalar;
    const int64_t first = s.unit(scene, 0);
    if (s.m.decided[first + k] || s.m.label[first + k] != k) return;
    const int64_t last = s.m.joined[first + k] ? s.in.bodies() : k + 1;
    double change = 0, size = 0, slope = 0;
    bool fits = true;
    const auto each = [&](const auto& f) {
      for (int64_t j = k; j < last; ++j) {
        if (s.m.label[first + j] == k) f(first + j);
      }
    };
    each([&](int64_t unit) {
      change += s.m.sum[2 * unit], size += s.m.sum[2 * unit + 1], slope += s.slope(unit);
      fits = fits && !s.m.state.blocked[unit];
    });
    const bool descends = slope <= 0;
    const double slack = kRounding * double(std::numeric_limits<T>::epsilon()) * size;
    const bool good = fits && descends && change <= coarse::kDecrease * fraction * slope + slack;
    each([&](int64_t unit) {
      s.m.state.blocked[unit] = 0;
      if (good) s.fraction[unit] = fraction;
      if (good || !descends) s.m.decided[unit] = 1;
    });
  }
};
struct EndVertex {  // each vertex
  template <class Step>
  DIFFVBD_FN void operator()(const Step& s, int64_t scene, int64_t of) const {
    using T = typename Step::Scalar;
    const auto v = static_cast<int32_t>(of);
    const Body<T> b{s.in.scene, scene, s.in.gate.body[v]};
    const int64_t unit = s.unit(scene, b.body);
    const Vector d = s.moves(unit) ? s.displacement(b, v, s.fraction[unit]) : Vector{};  // the refused may be no number
    put(s.x_end + 3 * b.row(v), vector_at(s.in.scene.x + 3 * b.row(v)) + Vec3<T>{T(d.x), T(d.y), T(d.z)});
  }
};

// The scenes that are active, and the forces before, are known.
DIFFVBD_RUNS
template <class Run, class Step>
DIFFVBD_FN void find_islands(const Run& run, const Step& s) {
  run.rows(Near<Run>{}, s);
  run.each(Flatten<Run>{}, s, s.in.bodies());
}

// Islands that are not decided take a fraction, if they can. Whether all are decided, as far as the host knows.
DIFFVBD_RUNS
template <class Run, class Step>
DIFFVBD_FN bool try_fraction(const Run& run, const Step& s, double fraction) {
  const int64_t n = s.in.bodies();
  run.each(MoveVertex{fraction}, s, s.in.scene.vertices);
  run.rows(MoveRow{}, s);
  run.bodies(SumBody{}, s);
  run.each(Decide{fraction}, s, n);
  return run.all(s.m.decided, s.in.scene.scenes * n);
}

}  // namespace diffvbd::contact
