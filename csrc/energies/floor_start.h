// The start of a substep above a floor: the wanted motion, less what would approach a plane too closely, with its
// derivative (docs/method.md, section 6). Unlike the filter of updates it never enters a plane's dhat: a start does not
// minimise the barrier, and the sweeps would have to open again what it closes.
#pragma once

#include "../core/dual.h"
#include "floor_barrier.h"

namespace diffvbd {

struct FloorStart {
  static constexpr int kMostPlanes = 8;
  static constexpr double kParallel = 1e-6;  // squared sine below which a plane counts as parallel to binding ones

  // The allowed motion toward one plane: none within dhat, a fraction of the distance to it from outside.
  template <class R>
  struct Limit {
    Vec3<R> n;
    R allowance;
    template <class T>
    DIFFVBD_FN Limit(const R* record, const VertexState<R>& s, const StepParameters<T>& q) {
      const FloorBarrier::Plane<R> plane(record, s);
      const R outside = plane.gap(s.x) - plane.dhat;
      n = plane.n;
      allowance = select(R(0) < outside, R(q.filter_eta) * outside, R(0));
    }
    DIFFVBD_FN R excess(const Vec3<R>& step) const { return -dot(n, step) - allowance; }
  };

  // The step shortened as a whole.
  template <class R, class T>
  DIFFVBD_FN static Vec3<R> shortened(const VertexState<R>& s, const R* data, int count, const Vec3<R>& step,
                                      const StepParameters<T>& q) {
    R alpha = R(1);
    for (int k = 0; k < count; k += FloorBarrier::stride) {
      const Limit<R> plane(data + k, s, q);
      if (!(R(0) < plane.excess(step))) continue;
      const R a = -(plane.allowance / dot(plane.n, step));
      alpha = select(a < alpha, a, alpha);
    }
    return alpha * step;
  }

  // Takes away what exceeds the limits, so that sliding stays. Planes bind one after the other, the one exceeded most
  // first, each along the part of its normal that leaves those before it as they are: with one or two planes that is
  // the closest motion there is. Where more of them leave no such motion, the whole step is scaled.
  template <class R, class T>
  DIFFVBD_FN static Vec3<R> projected(const VertexState<R>& s, const R* data, int count, const Vec3<R>& step,
                                      const StepParameters<T>& q) {
    const R slack = R(8 * std::numeric_limits<T>::epsilon()) * square_root(dot(step, step));
    Vec3<R> out = step, taken[3] = {step, step, step};
    R square[3] = {R(1), R(1), R(1)};
    int binding[3] = {-1, -1, -1}, number = 0;
    while (true) {
      int worst = -1;
      R most = slack;
      for (int k = 0; k < count; k += FloorBarrier::stride) {
        const R excess = Limit<R>(data + k, s, q).excess(out);
        const bool binds = k == binding[0] || k == binding[1] || k == binding[2];
        if (!binds && most < excess) most = excess, worst = k;
      }
      if (worst < 0 && !(R(1 + 1e-6) * dot(step, step) < dot(out, out))) return out;
      if (worst < 0 || number == 3) break;
      const Vec3<R> n{data[worst], data[worst + 1], data[worst + 2]};
      Vec3<R> w = n;
      for (int j = 0; j < number; ++j) w -= (dot(n, taken[j]) / square[j]) * taken[j];
      square[number] = dot(w, w);
      if (!(R(T(kParallel)) < square[number])) break;
      out += (most / square[number]) * w;
      taken[number] = w;
      binding[number++] = worst;
    }
    return shortened(s, data, count, step, q);
  }

  // The motion from s.x that the start makes of a wanted step.
  template <class R, class T>
  DIFFVBD_FN static Vec3<R> moved(const VertexState<R>& s, const R* data, int count, const Vec3<R>& step,
                                  const StepParameters<T>& q) {
    const Vec3<R> out = projected(s, data, count, step, q), x_new = s.x + out;
    // Rounding must not undo it: a vertex whose new gap cannot be told from zero stays where it is.
    for (int k = 0; k < count; k += FloorBarrier::stride) {
      const FloorBarrier::Plane<R> plane(data + k, s);
      if (!(plane.template guard<T>(s) < plane.gap(x_new))) return zero3<R>();
    }
    return out;
  }

  // bar: adjoint of moved() on entry, of the step on return; x_bar and data_bar (null where not wanted) receive their
  // shares. By forward mode, one evaluation for each input: the decisions are those of the forward.
  template <class T>
  DIFFVBD_COLD static void moved_vjp(const VertexState<T>& s, const T* data, int count, const Vec3<T>& step,
                                     const StepParameters<T>& q, Vec3<T>& bar, Vec3<T>& x_bar, T* data_bar) {
    const Vec3<T> out = moved(s, data, count, step, q);
    if (out.x == step.x && out.y == step.y && out.z == step.z) return;  // nothing binds
    VertexState<Dual<T>> state{constant(s.x), constant(s.x_prev), constant(s.origin), Dual<T>(s.h)};
    Vec3<Dual<T>> wanted = constant(step);
    Dual<T> values[kMostPlanes * FloorBarrier::stride];
    for (int i = 0; i < count; ++i) values[i] = Dual<T>(data[i]);
    Vec3<T> step_bar = zero3<T>();
    Dual<T>* const inputs[] = {&wanted.x, &wanted.y, &wanted.z, &state.x.x, &state.x.y, &state.x.z};
    T* const bars[] = {&step_bar.x, &step_bar.y, &step_bar.z, &x_bar.x, &x_bar.y, &x_bar.z};
    for (int i = 0; i < 6 + (data_bar ? count : 0); ++i) {
      Dual<T>& input = i < 6 ? *inputs[i] : values[i - 6];
      input.derivative = T(1);
      const Vec3<Dual<T>> rate = moved(state, values, count, wanted, q);
      input.derivative = T(0);
      T& to = i < 6 ? *bars[i] : data_bar[i - 6];
      to += rate.x.derivative * bar.x + rate.y.derivative * bar.y + rate.z.derivative * bar.z;
    }
    bar = step_bar;
  }
};

}  // namespace diffvbd
