// The rigid correction of one body: the rigid motion of its current shape that minimises the incremental potential
//     1/2 sum m |R r + c - y|^2 + the vertex energies (h^2-scaled),      r = x - center of mass,
// (docs/method.md, section 14; its transpose is in reverse.h). A rigid motion leaves the tets' energy as it is, so only
// sums over vertices are needed. Loops and sums belong to a Team: a few threads, a block, or a whole device.
#pragma once

#include <limits>

#include "../energies/energies.h"
#include "rotation.h"

namespace diffvbd::rigid {

constexpr int kMaxIterations = 8;
constexpr int kMaxHalvings = 30;
constexpr double kLeastShare = 0.1;  // of its gap that a vertex keeps in one step: that of the updates, 1 - FILTER_ETA
constexpr double kDamping = 1e-9;    // of the inertia, so that a body collapsed to a line has a turning block
constexpr double kArrived = 1e-24;   // squared step over squared radius of gyration below which a step has arrived
constexpr int kArrivals = 2;  // steps of no length: each leaves of the derivative's error what the block leaves out
constexpr double kRounding = 1e-13;  // relative rise of the energies' sum that is rounding

constexpr int32_t kCorrected = -2;  // as `other` of a vertex whose body is corrected

template <class T>
struct Inputs {
  using Scalar = T;
  const T* x;                                      // [B, V, 3]
  Batched<const T> x_prev, y, mass, origin, data;  // origin may be null
  const int32_t *order, *ptr;                      // vertices by body [listed], [bodies + 1]
  const double* spread;                            // [bodies]  squared radius of gyration at rest [m^2]
  const int32_t* other;                            // [V]  which of the other bodies a vertex is in, -1: none
  int64_t scenes, data_start[kVertexEnergies];     // of each energy among the data of a scene
  int32_t vertices, bodies, data_count[kVertexEnergies];
  double time_step;
};

// calls f(energy, its position in the list)
template <int k = 0, class F>
DIFFVBD_FN void each_energy(F&&, EnergyList<>) {}
template <int k = 0, class F, class E, class... Rest>
DIFFVBD_FN void each_energy(F&& f, EnergyList<E, Rest...>) {
  f(E{}, k);
  each_energy<k + 1>(f, EnergyList<Rest...>{});
}

// One body of one scene; item i is its i-th vertex.
template <class T>
struct Body {
  const Inputs<T>& in;
  int64_t scene;
  int32_t body;

  DIFFVBD_FN int32_t size() const { return in.ptr[body + 1] - in.ptr[body]; }
  DIFFVBD_FN int32_t vertex(int32_t i) const { return in.order[in.ptr[body] + i]; }
  DIFFVBD_FN int64_t row(int32_t v) const { return scene * in.vertices + v; }
  DIFFVBD_FN static Vector at(const T* p) { return {double(p[0]), double(p[1]), double(p[2])}; }
  DIFFVBD_FN Vector position(int32_t v) const { return at(in.x + 3 * row(v)); }
  DIFFVBD_FN Vector target(int32_t v) const { return at(in.y.data + scene * in.y.scene + 3 * int64_t{v}); }
  DIFFVBD_FN double mass(int32_t v) const { return in.mass.data[scene * in.mass.scene + v]; }
  DIFFVBD_FN VertexState<double> state(int32_t v, const Vector& x) const {
    const Vector origin = in.origin.data ? at(in.origin.data + scene * in.origin.scene + 3 * int64_t{v}) : Vector{};
    return {x, at(in.x_prev.data + scene * in.x_prev.scene + 3 * int64_t{v}), origin, in.time_step};
  }

  // calls f(energy, its position, its data for a vertex, their count) for the energies that are present
  template <class F>
  DIFFVBD_FN void energies(int32_t v, F&& f) const {
    each_energy(
        [&](auto energy, int k) {
          const int count = in.data_count[k];
          if (count == 0) return;
          const T* own = in.data.data + scene * in.data.scene + in.data_start[k] +
                         (decltype(energy)::per_vertex ? int64_t{v} * count : 0);
          if constexpr (sizeof(T) == sizeof(double)) {
            f(energy, k, own, count);
          } else {
            double values[kMaxEnergyData];
            for (int i = 0; i < count; ++i) values[i] = own[i];
            f(energy, k, values, count);
          }
        },
        VertexEnergies{});
  }
};

// Where the rigid motion takes a body: its turn, and how far its center of mass moves.
struct Pose {
  Matrix turn;
  Vector shift;
};

struct Moments {
  double mass;
  Vector center, shift;  // center of mass of x, and from there to that of y
  Matrix x_x, y_x;       // sum m r r^T and sum m (y - target) r^T
};

// Of the vertex energies at a pose: their sum (infinite where a vertex is too near a plane), gradient and Gauss-Newton
// block with respect to (turn, translation).
struct Load {
  double value, g[6], block[kSix];
  DIFFVBD_FN bool acts() const {
    double sum = value;
    for (int i = 0; i < 6; ++i) sum += block[at6(i, i)];
    return sum != 0;
  }
};

// One executed Newton step: the pose before it, (turn, translation), the share that was taken, and the factored block.
struct Iteration {
  Pose pose;
  double step[6], share, factor[kSix];
  DIFFVBD_FN Vector turn() const { return {step[0], step[1], step[2]}; }
  DIFFVBD_FN Vector shift() const { return {step[3], step[4], step[5]}; }
};

// What was executed: nothing, the closed form (with or without a turn), or `count` Newton steps.
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
    to[1] += mx.x, to[2] += mx.y, to[3] += mx.z;
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
  const Vector x = inverse * Vector{sum[1], sum[2], sum[3]}, move = inverse * Vector{sum[4], sum[5], sum[6]};
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
  g6[0] += torque.x, g6[1] += torque.y, g6[2] += torque.z;
  g6[3] += g.x, g6[4] += g.y, g6[5] += g.z;
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
        admitted = admitted &&
                   E::template admits<T>(s, center + before.shift + before.turn * at_start, data, count, kLeastShare);
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

// By how much the inertial part of the potential rises from the pose of a step to the next one, without cancellation.
DIFFVBD_FN double inertial_rise(const Moments& m, const Iteration& k) {
  const Vector turn = k.share * k.turn(), shift = k.share * k.shift();
  return m.mass * dot(shift, k.pose.shift - m.shift + 0.5 * shift) - inner(turned_by(turn) * k.pose.turn, m.y_x);
}

DIFFVBD_FN Pose after(const Iteration& k) {
  return {k.pose.turn + turned_by(k.share * k.turn()) * k.pose.turn, k.pose.shift + k.share * k.shift()};
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
    if (!(load.value < std::numeric_limits<double>::infinity()))
      return out;  // starts outside: there is no way to judge
    Iteration k;
    // The steps that arrive are taken as well, and whole: where a body rests they are the only ones, and carry the
    // derivative.
    int arrived = 0;
    while (arrived < kArrivals && out.count < kMaxIterations) {
      const bool goes_on = newton_step(m, b.in.spread[b.body], out.end, load, k);
      arrived += !goes_on;
      bool taken = false;
      k.share = 1;
      for (int halving = 0; halving < kMaxHalvings && !taken; ++halving) {
        if (halving > 0) k.share *= 0.5;
        const Pose next = after(k);
        const Load there = load_at(b, team, m.center, next, k.pose);
        taken = goes_on ? inertial_rise(m, k) + there.value - load.value <= kRounding * load.value
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
DIFFVBD_FN void put(T* to, const Vector& a) {
  to[0] = static_cast<T>(a.x), to[1] = static_cast<T>(a.y), to[2] = static_cast<T>(a.z);
}
template <class T>
DIFFVBD_FN void add_to(T* to, const Vector& a) {
  put(to, Body<T>::at(to) + a);
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

}  // namespace diffvbd::rigid
