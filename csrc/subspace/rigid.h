// The rigid correction of one body: the rigid motion of its current shape that minimises the incremental potential
//     1/2 sum m |R r + c - y|^2 + the vertex energies (h^2-scaled),      r = x - center of mass,
// and its transpose (docs/method.md, section 14). A rigid motion does not change the energy of tets: sums over vertices
// suffice.
#pragma once

#include <limits>

#include "../sweep/body.h"

namespace diffvbd::rigid {

constexpr int kMaxIterations = 8;
constexpr int kMaxHalvings = 30;
constexpr double kDamping = 1e-9;   // of the inertia, so that a body collapsed to a line has a turning block
constexpr double kArrived = 1e-24;  // squared step over squared radius of gyration below which a step has arrived
constexpr int kArrivals = 2;  // steps of no length: each leaves of the derivative's error what the block leaves out
constexpr double kRounding = 1e-13;  // relative increase of the energies' sum that is rounding

// The pose of a body: its turn, and the shift of its center of mass.
struct Pose {
  Matrix turn;
  Vector shift;
};

struct Moments {
  double mass;
  Vector center, shift;  // center of mass of x, and from there to that of y
  Matrix x_x, y_x;       // sum m r r^T and sum m (y - target) r^T
};

// The vertex energies at a pose: sum (infinite where a vertex is too near a plane), gradient and Gauss-Newton block
// with respect to (turn, translation).
struct Load {
  double value, g[6], block[kSix];
  DIFFVBD_FN bool acts() const {
    double sum = value;
    for (int i = 0; i < 6; ++i) sum += block[at6(i, i)];
    return sum != 0;
  }
};

// One executed Newton step: the pose before it, (turn, translation), its fraction, and the factored block.
struct Iteration {
  Pose pose;
  double step[6], fraction, factor[kSix];
  DIFFVBD_FN Vector turn() const { return {step[0], step[1], step[2]}; }
  DIFFVBD_FN Vector shift() const { return {step[3], step[4], step[5]}; }
};

// The executed method: none, the closed form (with or without a turn), or `count` Newton steps.
struct Executed {
  Moments moments;
  Pose end;
  bool closed, turned;
  int count;
};

// With energies also the inertia that Newton's method needs.
template <bool energies, class T, class Team>
DIFFVBD_FN Moments moments_of(const Body<T>& b, const Team& team) {
  constexpr int count = energies ? 22 : 16;
  const Vector about = b.position(b.vertex(0));  // squares of distances inside the body, not to the origin
  double sum[count];
  team.template sum<count>(b.size(), sum, [&](int32_t i, double* to) {
    const int32_t v = b.vertex(i);
    const double m = b.mass(v);
    const Vector at = b.position(v), x = at - about, mx = m * x;
    const Vector move = b.target(v) - at, y = x + move;  // small: its mean is what momentum rounds to
    to[0] += m;
    add_to(to + 1, mx);
    to[4] += m * move.x, to[5] += m * move.y, to[6] += m * move.z;
    to[7] += y.x * mx.x, to[8] += y.x * mx.y, to[9] += y.x * mx.z;
    to[10] += y.y * mx.x, to[11] += y.y * mx.y, to[12] += y.y * mx.z;
    to[13] += y.z * mx.x, to[14] += y.z * mx.y, to[15] += y.z * mx.z;
    if constexpr (energies) {
      to[16] += mx.x * x.x, to[17] += mx.x * x.y, to[18] += mx.x * x.z;
      to[19] += mx.y * x.y, to[20] += mx.y * x.z, to[21] += mx.z * x.z;
    }
  });
  Moments out{};
  out.mass = sum[0];
  const double inverse = 1 / sum[0];
  const Vector x = inverse * vector_at(sum + 1), move = inverse * vector_at(sum + 4);
  out.center = about + x;
  out.shift = move;
  out.y_x = Matrix{{sum[7], sum[8], sum[9]}, {sum[10], sum[11], sum[12]}, {sum[13], sum[14], sum[15]}} +
            (-sum[0]) * outer(x + move, x);
  if constexpr (energies) {
    out.x_x = Matrix{{sum[16], sum[17], sum[18]}, {sum[17], sum[19], sum[20]}, {sum[18], sum[20], sum[21]}} +
              (-sum[0]) * outer(x, x);
  }
  return out;
}

// J^T H J and J^T g are added for J = d(position) / d(turn, translation) of a vertex at r from the center of mass.
DIFFVBD_FN void add_vertex(const Vector& r, const Vector& g, const Sym3<double>& H, double* g6, double* block) {
  const Vector torque = cross(r, g);
  add_to(g6, torque);
  add_to(g6 + 3, g);
  // columns of H [-r]: H (e_k x r)
  const Vector q[3] = {H * Vector{0, -r.z, r.y}, H * Vector{r.z, 0, -r.x}, H * Vector{-r.y, r.x, 0}};
  const Vector w[3] = {cross(r, q[0]), cross(r, q[1]), cross(r, q[2])};
  block[at6(0, 0)] += w[0].x, block[at6(1, 0)] += w[0].y, block[at6(1, 1)] += w[1].y;
  block[at6(2, 0)] += w[0].z, block[at6(2, 1)] += w[1].z, block[at6(2, 2)] += w[2].z;
  for (int k = 0; k < 3; ++k) {
    block[at6(3, k)] += q[k].x, block[at6(4, k)] += q[k].y, block[at6(5, k)] += q[k].z;
  }
  block[at6(3, 3)] += H.xx, block[at6(4, 3)] += H.xy, block[at6(4, 4)] += H.yy;
  block[at6(5, 3)] += H.xz, block[at6(5, 4)] += H.yz, block[at6(5, 5)] += H.zz;
}

// At a pose that was reached from `before`: no vertex may lose more of its gap there than a step may take.
template <class T, class Team>
DIFFVBD_FN Load load_at(const Body<T>& b, const Team& team, const Vector& center, const Pose& pose,
                        const Pose& before) {
  Load out;
  double sum[1 + 6 + kSix];
  team.template sum<1 + 6 + kSix>(b.size(), sum, [&](int32_t i, double* to) {
    const int32_t v = b.vertex(i);
    const Vector at_start = b.position(v) - center, r = pose.turn * at_start;
    const VertexState<double> s = b.state(v, center + pose.shift + r);
    Vector g{};
    Sym3<double> H{};
    bool admitted = true;
    b.energies(v, [&](auto energy, int, const double* data, int count) {
      using E = decltype(energy);
      if constexpr (E::has_filter) {
        admitted = admitted && E::template admits<T>(s, center + before.shift + before.turn * at_start, data, count,
                                                     kLeastGapFraction);
      }
      to[0] += E::value(s, data, count);
      E::block(s, data, count, g, H);
    });
    if (!admitted) to[0] = std::numeric_limits<double>::infinity();
    if (H.xx + H.yy + H.zz != 0 || dot(g, g) != 0) add_vertex(r, g, H, to + 1, to + 7);
  });
  out.value = sum[0];
  for (int i = 0; i < 6; ++i) out.g[i] = sum[1 + i];
  for (int i = 0; i < kSix; ++i) out.block[i] = sum[7 + i];
  return out;
}

// The Newton step at a pose; false where it is too small for another one to follow.
DIFFVBD_FN bool newton_step(const Moments& m, double spread, const Pose& pose, const Load& load, Iteration& out) {
  const Matrix turned = m.y_x * transposed(pose.turn);  // sum m (y - target) r^T
  const Vector torque = -axial(turned), force = m.mass * (pose.shift - m.shift);
  const double inertial[6] = {torque.x, torque.y, torque.z, force.x, force.y, force.z};
  const Sym3<double> turning = turning_stiffness(pose.turn * m.x_x * transposed(pose.turn));
  double g[6];
  for (int i = 0; i < 6; ++i) g[i] = inertial[i] + load.g[i], out.step[i] = -g[i];
  for (int i = 0; i < kSix; ++i) out.factor[i] = load.block[i];
  const double damping = kDamping * m.mass * spread;
  out.factor[at6(0, 0)] += turning.xx + damping;
  out.factor[at6(1, 0)] += turning.xy;
  out.factor[at6(1, 1)] += turning.yy + damping;
  out.factor[at6(2, 0)] += turning.xz;
  out.factor[at6(2, 1)] += turning.yz;
  out.factor[at6(2, 2)] += turning.zz + damping;
  for (int i = 3; i < 6; ++i) out.factor[at6(i, i)] += m.mass;
  factor6(out.factor);
  solve6(out.factor, out.step);
  double decrease = 0;
  for (int i = 0; i < 6; ++i) decrease -= g[i] * out.step[i];
  out.pose = pose;
  return kArrived * m.mass * spread < decrease;
}

// The increase of the inertial potential from the pose of a step to the next one, without cancellation.
DIFFVBD_FN double inertial_increase(const Moments& m, const Iteration& k) {
  const Vector turn = k.fraction * k.turn(), shift = k.fraction * k.shift();
  return m.mass * dot(shift, k.pose.shift - m.shift + 0.5 * shift) - inner(turned_by(turn) * k.pose.turn, m.y_x);
}

DIFFVBD_FN Pose after(const Iteration& k) {
  return {k.pose.turn + turned_by(k.fraction * k.turn()) * k.pose.turn, k.pose.shift + k.fraction * k.shift()};
}

// Finds the motion; `record`, which a team shares, receives the executed Newton steps unless it is null.
template <bool energies, class T, class Team>
DIFFVBD_FN Executed find(const Body<T>& b, const Team& team, Iteration* record) {
  Executed out{};
  out.moments = moments_of<energies>(b, team);
  const Moments& m = out.moments;
  const Pose start{identity(), Vector{}};
  out.end = {identity(), m.shift};
  out.turned = polar_rotation(m.y_x, out.end.turn);
  if constexpr (energies) {
    Load load = load_at(b, team, m.center, out.end, out.end);
    out.closed = !load.acts();
    if (out.closed) return out;
    out.end = start;
    load = load_at(b, team, m.center, start, start);
    if (!(load.value < std::numeric_limits<double>::infinity())) return out;  // starts outside of the domain
    Iteration k;
    // The steps that arrive are executed as well, and whole: of a body at rest they are the only ones, and have the
    // derivative.
    int arrived = 0;
    while (arrived < kArrivals && out.count < kMaxIterations) {
      const bool goes_on = newton_step(m, b.in.spread[b.body], out.end, load, k);
      arrived += !goes_on;
      bool taken = false;
      k.fraction = 1;
      for (int halving = 0; halving < kMaxHalvings && !taken; ++halving) {
        if (halving > 0) k.fraction *= 0.5;
        const Pose next = after(k);
        const Load there = load_at(b, team, m.center, next, k.pose);
        taken = goes_on ? inertial_increase(m, k) + there.value - load.value <= kRounding * load.value
                        : there.value < std::numeric_limits<double>::infinity();
        if (taken) load = there, out.end = next;
      }
      if (!taken) break;
      if (record != nullptr && team.leads()) record[out.count] = k;
      ++out.count;
    }
  } else {
    out.closed = true;
  }
  return out;
}

template <class T>
DIFFVBD_FN void set_velocity(const Inputs<T>& in, int64_t scene, int32_t v, const T* x, T* velocity) {
  const T* before = in.x_prev.data + scene * in.x_prev.scene + 3 * int64_t{v};
  T* to = velocity + 3 * (scene * in.vertices + v);
  for (int c = 0; c < 3; ++c) to[c] = (x[c] - before[c]) / T(in.time_step);
}

// A vertex whose body is not corrected.
template <class T>
DIFFVBD_FN void keep_vertex(const Inputs<T>& in, int64_t scene, int32_t v, T* x, T* velocity) {
  if (in.other[v] == kCorrected) return;
  const int64_t at = 3 * (scene * in.vertices + v);
  for (int c = 0; c < 3; ++c) x[at + c] = in.x[at + c];
  set_velocity(in, scene, v, x + at, velocity);
}

// x after the correction and, unless null, v = (x - x_prev) / h
template <bool energies, class T, class Team>
DIFFVBD_FN void correct(const Body<T>& b, const Team& team, Iteration* record, T* x, T* velocity = nullptr) {
  const Executed e = find<energies>(b, team, record);
  const bool moves = e.closed || e.count > 0;
  const Matrix turned = e.end.turn + -1.0 * identity();
  team.each(b.size(), [&](int32_t i) {
    const int32_t v = b.vertex(i);
    const T* from = b.in.x + 3 * b.row(v);
    T* to = x + 3 * b.row(v);
    if (moves) {
      // as a change of x, which rounds once: momentum is kept to that
      const Vector p = b.position(v), r = p - e.moments.center;
      put(to, p + (turned * r + e.end.shift));
    } else {
      for (int c = 0; c < 3; ++c) to[c] = from[c];
    }
    if (velocity) set_velocity(b.in, b.scene, v, to, velocity);
  });
}

// --- the increase of the incremental potential of a body from one state to another

// The terms of one vertex on the path to `to`: the increase, the sizes of the terms, and a count of vertices too near a
// plane.
template <class T>
DIFFVBD_FN void add_energy_increase(const Body<T>& b, int32_t v, const Vector& to, double* sum) {
  const Vector from = b.position(v), step = to - from;
  const double inertial = b.mass(v) * dot(step, 0.5 * (from + to) - b.target(v));
  sum[0] += inertial, sum[1] += absolute(inertial);
  b.energies(v, [&](auto energy, int, const double* values, int count) {
    using E = decltype(energy);
    const auto there = b.state(v, to);
    if constexpr (E::has_filter) {
      if (!E::template admits<T>(there, from, values, count, kLeastGapFraction)) sum[2] += 1;
    }
    const double before = E::value(b.state(v, from), values, count), after = E::value(there, values, count);
    sum[0] += after - before, sum[1] += absolute(before) + absolute(after);
  });
}

// --- the transpose, of the closed form or of the executed Newton steps, last one first. They are found again: nothing
// is kept between forward and reverse.

template <class T>
struct Adjoints {
  const T *end, *velocity;   // of the result [B, V, 3]; velocity may be null
  T *x, *x_prev, *y, *mass;  // [B, V, 3] three times, [B, V]; x_prev only with energies or a velocity
  T *shared, *own;           // of the data: [B, bodies, scalars of a scene], [B, V, scalars of a vertex]; or null
  int32_t shared_count, own_count;
};

// The adjoint of an end position, velocity included; and that of x_prev by the velocity.
template <class T>
DIFFVBD_FN Vector end_bar(const Adjoints<T>& a, int64_t row, double h) {
  const Vector bar = wide_at(a.end + 3 * row);
  return a.velocity ? bar + 1 / h * wide_at(a.velocity + 3 * row) : bar;
}
template <class T>
DIFFVBD_FN Vector before_bar(const Adjoints<T>& a, int64_t row, double h) {
  return a.velocity ? -1 / h * wide_at(a.velocity + 3 * row) : Vector{};
}

// A vertex whose body is not corrected.
template <class T>
DIFFVBD_FN void reverse_kept(const Inputs<T>& in, const Adjoints<T>& a, int64_t scene, int32_t v) {
  if (in.other[v] == kCorrected) return;
  const int64_t row = scene * in.vertices + v;
  const double h = in.time_step;
  put(a.x + 3 * row, end_bar(a, row, h));
  put(a.y + 3 * row, Vector{});
  if (a.x_prev) put(a.x_prev + 3 * row, before_bar(a, row, h));
  a.mass[row] = T(0);
}

// One executed Newton step seen from a vertex, with p = A^-1 (adjoint of the step). With P and D the displacements of
// the vertex by p and by the whole step, A d = -g makes the adjoint that of -(P . (m (x - y) + g) + P . (m + H) D).
struct VertexDisplacement {
  Vector r_start, r, x, P, D;
  template <class T>
  DIFFVBD_FN VertexDisplacement(const Body<T>& b, int32_t v, const Vector& center, const Iteration& k,
                                const Vector& p_turn, const Vector& p_shift)
      : r_start(b.position(v) - center),
        r(k.pose.turn * r_start),
        x(center + k.pose.shift + r),
        P(cross(p_turn, r) + p_shift),
        D(cross(k.turn(), r) + k.shift()) {}
};

// The position of a vertex and its displacements by two motions, for the adjoint of its energies' data.
struct VertexMotions {
  Vector x, P, D;
};

// The adjoints of an energy's data, record by record, through Dual; added. at(v): the VertexMotions of a vertex.
template <class T, class Team, class At>
DIFFVBD_FN void reverse_data(const Body<T>& b, const Team& team, const Adjoints<T>& a, const At& at) {
  const StepParameters<double> none{b.in.time_step, 0, 1, -1, 0, 1, 1, false};
  int shared = 0, own = 0;
  each_energy(
      [&](auto energy, int e) {
        using E = decltype(energy);
        const int count = b.in.data_count[e];
        for (int j = 0; j < count; j += E::stride) {
          const auto bars = [&](int32_t i, double* to) {
            const int32_t v = b.vertex(i);
            const VertexMotions m = at(v);
            b.energies(v, [&](auto other, int which, const double* data, int) {
              if constexpr (std::is_same_v<decltype(other), E>) {
                record_vjp<E>(b.state(v, m.x), data + j, m.P, m.D, zero3<double>(), none, 0.0, 0.0, NoFrame<double>{},
                              to);
              }
            });
          };
          if constexpr (E::per_vertex) {
            team.each(b.size(), [&](int32_t i) {
              double bar[E::stride];
              bars(i, bar);
              T* to = a.own + b.row(b.vertex(i)) * a.own_count + own + j;
              for (int c = 0; c < E::stride; ++c) to[c] += static_cast<T>(bar[c]);
            });
          } else {
            double sum[E::stride];
            team.template sum<E::stride>(b.size(), sum, [&](int32_t i, double* to) {
              double bar[E::stride];
              bars(i, bar);
              for (int c = 0; c < E::stride; ++c) to[c] += bar[c];
            });
            if (team.leads()) {
              T* to = a.shared + (b.scene * b.in.bodies + b.body) * a.shared_count + shared + j;
              for (int c = 0; c < E::stride; ++c) to[c] += static_cast<T>(sum[c]);
            }
          }
        }
        (E::per_vertex ? own : shared) += count;
      },
      VertexEnergies{});
}

// Transpose of correct(). x, y, mass (and x_prev) are written; the adjoints of data are added to.
template <bool energies, class T, class Team>
DIFFVBD_FN void reverse(const Body<T>& b, const Team& team, Iteration* record, const Adjoints<T>& a) {
  const Executed e = find<energies>(b, team, record);
  const Moments& m = e.moments;
  const bool moves = e.closed || e.count > 0;
  double sum[12];
  team.template sum<12>(b.size(), sum, [&](int32_t i, double* to) {
    const int32_t v = b.vertex(i);
    const int64_t row = b.row(v);
    const Vector bar = end_bar(a, row, b.in.time_step), r = b.position(v) - m.center;
    const double values[] = {bar.x,       bar.y,       bar.z,       bar.x * r.x, bar.x * r.y, bar.x * r.z,
                             bar.y * r.x, bar.y * r.y, bar.y * r.z, bar.z * r.x, bar.z * r.y, bar.z * r.z};
    for (int c = 0; c < 12; ++c) to[c] += values[c];
    put(a.x + 3 * row, moves ? transposed_times(e.end.turn, bar) : bar);
    put(a.y + 3 * row, Vector{});
    if (a.x_prev) put(a.x_prev + 3 * row, before_bar(a, row, b.in.time_step));
    a.mass[row] = T(0);
  });
  if (!moves) return;
  Vector center_bar{sum[0], sum[1], sum[2]};
  Matrix turn_bar{{sum[3], sum[4], sum[5]}, {sum[6], sum[7], sum[8]}, {sum[9], sum[10], sum[11]}};
  Vector start_bar = -transposed_times(e.end.turn, center_bar);  // of the center of mass, through r = x - center
  const double inverse = 1 / m.mass;
  if (e.closed) {
    const Matrix y_x_bar = e.turned ? polar_vjp(m.y_x, e.end.turn, turn_bar) : 0.0 * identity();
    const Vector target_bar = inverse * center_bar, common = inverse * start_bar;
    team.each(b.size(), [&](int32_t i) {
      const int32_t v = b.vertex(i);
      const int64_t row = b.row(v);
      const double mass = b.mass(v);
      const Vector r = b.position(v) - m.center, y = b.target(v) - (m.center + m.shift),
                   pulled = y_x_bar * r + target_bar;
      add_to(a.x + 3 * row, mass * (transposed_times(y_x_bar, y) + common));
      put(a.y + 3 * row, mass * pulled);
      a.mass[row] = static_cast<T>(dot(y, pulled) + dot(r, common));
    });
    return;
  }
  if constexpr (energies) {
    Matrix after_turn = e.end.turn;
    for (int n = e.count - 1; n >= 0; --n) {
      const Iteration& k = record[n];
      const Vector turn_step = k.fraction * k.turn();
      const Vector turning = k.fraction * turn_vjp(turn_step, turn_bar * transposed(after_turn));
      double p[6] = {turning.x,
                     turning.y,
                     turning.z,
                     k.fraction * center_bar.x,
                     k.fraction * center_bar.y,
                     k.fraction * center_bar.z};
      solve6(k.factor, p);
      const Vector p_turn{p[0], p[1], p[2]}, p_shift{p[3], p[4], p[5]};
      turn_bar = turn_bar + transposed(turned_by(turn_step)) * turn_bar;
      const double damped = kDamping * b.in.spread[b.body] * dot(p_turn, k.turn());
      if (a.shared != nullptr || a.own != nullptr) {
        reverse_data(b, team, a, [&](int32_t v) {
          const VertexDisplacement at(b, v, m.center, k, p_turn, p_shift);
          return VertexMotions{at.x, at.P, at.D};
        });
      }
      double add[15];
      team.template sum<15>(b.size(), add, [&](int32_t i, double* to) {
        const int32_t v = b.vertex(i);
        const int64_t row = b.row(v);
        const double mass = b.mass(v);
        const VertexDisplacement at(b, v, m.center, k, p_turn, p_shift);
        const VertexState<double> s = b.state(v, at.x);
        const Vector lag = at.x - b.target(v);
        Vector g = mass * lag, x_bar = -mass * at.P, x_prev_bar{};
        Sym3<double> H = diagonal(mass);
        b.energies(v, [&](auto energy, int, const double* data, int count) {
          using E = decltype(energy);
          E::block(s, data, count, g, H);
          vertex_energy_vjp<E>(s, data, count, at.P, at.D, x_bar, x_prev_bar);
        });
        const Vector r_bar = x_bar - cross(g + H * at.D, p_turn) - cross(H * at.P, k.turn());
        add_to(a.x + 3 * row, transposed_times(k.pose.turn, r_bar));
        add_to(a.y + 3 * row, mass * at.P);
        if (a.x_prev) add_to(a.x_prev + 3 * row, x_prev_bar);
        a.mass[row] = static_cast<T>(a.mass[row] - dot(at.P, lag + at.D) - damped);
        const Vector& r = at.r_start;
        const double values[] = {x_bar.x,       x_bar.y,       x_bar.z,       r_bar.x,       r_bar.y,
                                 r_bar.z,       r_bar.x * r.x, r_bar.x * r.y, r_bar.x * r.z, r_bar.y * r.x,
                                 r_bar.y * r.y, r_bar.y * r.z, r_bar.z * r.x, r_bar.z * r.y, r_bar.z * r.z};
        for (int c = 0; c < 15; ++c) to[c] += values[c];
      });
      center_bar += vector_at(add);
      start_bar -= transposed_times(k.pose.turn, vector_at(add + 3));
      turn_bar = turn_bar + Matrix{{add[6], add[7], add[8]}, {add[9], add[10], add[11]}, {add[12], add[13], add[14]}};
      after_turn = k.pose.turn;
    }
    start_bar += center_bar;  // the first pose starts at the center of mass
    const Vector common = inverse * start_bar;
    team.each(b.size(), [&](int32_t i) {
      const int32_t v = b.vertex(i);
      const int64_t row = b.row(v);
      add_to(a.x + 3 * row, b.mass(v) * common);
      a.mass[row] = static_cast<T>(a.mass[row] + dot(b.position(v) - m.center, common));
    });
  }
}

}  // namespace diffvbd::rigid
