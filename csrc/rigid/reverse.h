// The transpose of a rigid correction: of the closed form, or of the executed Newton steps, last one first. What was
// executed is found again, so that nothing is kept between forward and reverse.
#pragma once

#include "body.h"

namespace diffvbd::rigid {

template <class T>
struct Adjoints {
  const T *end, *velocity;   // of the result [B, V, 3]; velocity may be null
  T *x, *x_prev, *y, *mass;  // [B, V, 3] three times, [B, V]; x_prev only with energies or a velocity
  T *shared, *own;           // of the data: [B, bodies, scalars of a scene], [B, V, scalars of a vertex]; or null
  int32_t shared_count, own_count;
};

// The adjoint of an end position, velocity included; and what the velocity sends to x_prev.
template <class T>
DIFFVBD_FN Vector end_bar(const Adjoints<T>& a, int64_t row, double h) {
  const Vector bar = Body<T>::at(a.end + 3 * row);
  return a.velocity ? bar + 1 / h * Body<T>::at(a.velocity + 3 * row) : bar;
}
template <class T>
DIFFVBD_FN Vector before_bar(const Adjoints<T>& a, int64_t row, double h) {
  return a.velocity ? -1 / h * Body<T>::at(a.velocity + 3 * row) : Vector{};
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
struct VertexShare {
  Vector r_start, r, x, P, D;
  template <class T>
  DIFFVBD_FN VertexShare(const Body<T>& b, int32_t v, const Vector& center, const Iteration& k, const Vector& p_turn,
                         const Vector& p_shift)
      : r_start(b.position(v) - center),
        r(k.pose.turn * r_start),
        x(center + k.pose.shift + r),
        P(cross(p_turn, r) + p_shift),
        D(cross(k.turn(), r) + k.shift()) {}
};

// What a vertex does by two motions, and where it is: what the adjoint of its energies' data takes.
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
      const Vector turn_step = k.share * k.turn();
      const Vector turning = k.share * turn_vjp(turn_step, turn_bar * transposed(after_turn));
      double p[6] = {
          turning.x, turning.y, turning.z, k.share * center_bar.x, k.share * center_bar.y, k.share * center_bar.z};
      solve6(k.factor, p);
      const Vector p_turn{p[0], p[1], p[2]}, p_shift{p[3], p[4], p[5]};
      turn_bar = turn_bar + transposed(turned_by(turn_step)) * turn_bar;
      const double damped = kDamping * b.in.spread[b.body] * dot(p_turn, k.turn());
      if (a.shared != nullptr || a.own != nullptr) {
        reverse_data(b, team, a, [&](int32_t v) {
          const VertexShare at(b, v, m.center, k, p_turn, p_shift);
          return VertexMotions{at.x, at.P, at.D};
        });
      }
      double add[15];
      team.template sum<15>(b.size(), add, [&](int32_t i, double* to) {
        const int32_t v = b.vertex(i);
        const int64_t row = b.row(v);
        const double mass = b.mass(v);
        const VertexShare at(b, v, m.center, k, p_turn, p_shift);
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
      center_bar += Vector{add[0], add[1], add[2]};
      start_bar -= transposed_times(k.pose.turn, Vector{add[3], add[4], add[5]});
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
