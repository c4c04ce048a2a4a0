// IPC log barrier against planes (Li et al. 2020), with the paper's lagged damping of approaching motion, and the step
// filter that keeps every executed position strictly above every plane (docs/method.md, section 6).
#pragma once

#include <limits>

#include "../core/dual.h"
#include "../core/frame.h"
#include "../core/safeguards.h"
#include "../core/views.h"
#include "log_barrier.h"

namespace diffvbd {

struct FloorBarrier {
  static constexpr bool per_vertex = false;  // data: `planes` x (n_x, n_y, n_z, height, kappa, dhat, damping)
  static constexpr int stride = 7;
  static constexpr bool has_filter = true;
  static constexpr bool reads_x_prev = true;
  static constexpr bool optional = false;

  // what is wrong with the data of one plane, or null
  template <class T>
  static const char* invalid(const T* a) {
    if (!(a[4] >= 0)) return "floor_kappa: expected >= 0 N/m";
    if (!(a[5] > 0)) return "floor_dhat: expected > 0 m";
    if (!(a[6] >= 0)) return "floor_damping: expected >= 0 N s/m";
    return nullptr;
  }

  template <class R>
  struct Plane {
    Vec3<R> n;
    R height, kappa, dhat, damping;
    DIFFVBD_FN Plane(const R* a, const VertexState<R>& s)
        : n{a[0], a[1], a[2]}, height(a[3] - dot(n, s.origin)), kappa(a[4]), dhat(a[5]), damping(a[6]) {}
    DIFFVBD_FN R gap(const Vec3<R>& x) const { return dot(n, x) - height; }
    // below this the sign of a gap is not safe: a few roundings of its terms, and of the position once it is no longer
    // relative to the origin
    template <class T>
    DIFFVBD_FN R guard(const VertexState<R>& s) const {
      const Vec3<R> x = s.x + s.origin;
      return R(8 * std::numeric_limits<T>::epsilon()) *
             (absolute(n.x * x.x) + absolute(n.y * x.y) + absolute(n.z * x.z) + absolute(height + dot(n, s.origin)));
    }
  };

  // Above 0 where a plane within its dhat lies along no axis of the mesh, so that a block needs axes of its own.
  template <class R>
  DIFFVBD_FN static R slant(const VertexState<R>& s, const R* data, int count) {
    R out = R(0);
    for (int k = 0; k < count; k += stride) {
      const Plane<R> plane(data + k, s);
      const Vec3<R>& n = plane.n;
      const R own = absolute(n.x * n.y) + absolute(n.y * n.z) + absolute(n.z * n.x);
      out = out + select(plane.gap(s.x) < plane.dhat, own, R(0));
    }
    return out;
  }
  template <class R>
  DIFFVBD_FN static bool is_oblique(const VertexState<R>& s, const R* data, int count) {
    return any(R(0) < slant(s, data, count));
  }
  // 0 for a component on which such a plane stands alone, else 1.
  template <class R>
  DIFFVBD_FN static void leave_out(const VertexState<R>& s, const R* data, int count, R& first, R& second) {
    for (int k = 0; k < count; k += stride) {
      const Plane<R> plane(data + k, s);
      const auto near = plane.gap(s.x) < plane.dhat;
      first = select(near, first - plane.n.x * plane.n.x, first);
      second = select(near, second - plane.n.y * plane.n.y, second);
    }
  }
  // Above 0 where a plane acts.
  template <class R>
  DIFFVBD_FN static R near(const VertexState<R>& s, const R* data, int count) {
    R out = R(0);
    for (int k = 0; k < count; k += stride) {
      const Plane<R> plane(data + k, s);
      out = select(plane.gap(s.x) < plane.dhat, R(1), out);
    }
    return out;
  }

  // Where one is oblique, the axes of the two nearest planes within dhat, the nearest, and so the stiffest, first. Each
  // lane decides for itself: the lanes that fill up a pack are elsewhere in the reverse.
  template <class T, class R>
  DIFFVBD_FN static Frame<R> frame(const VertexState<R>& s, const R* data, int count) {
    const R oblique = slant(s, data, count);
    if (!any(R(0) < oblique)) return Frame<R>::none();
    const VertexState<R> s_copy = s;
    const R oblique_copy = oblique;
    return turned<T>(s_copy, data, count, oblique_copy);
  }
  template <class T, class R>
  DIFFVBD_COLD static Frame<R> turned(const VertexState<R>& s, const R* data, int count, const R& oblique) {
    const R far = R(std::numeric_limits<T>::max());
    R d1 = far, d2 = far;
    Vec3<R> n1 = zero3<R>(), n2 = zero3<R>();
    for (int k = 0; k < count; k += stride) {
      const Plane<R> plane(data + k, s);
      const R gap = plane.gap(s.x), d = select(gap < plane.dhat, gap, far);
      const auto first = d < d1, second = d < d2;
      n2 = select(first, n1, select(second, plane.n, n2));
      d2 = select(first, d1, select(second, d, d2));
      n1 = select(first, plane.n, n1);
      d1 = select(first, d, d1);
    }
    const auto turns = R(0) < oblique;
    return Frame<R>::template along<T>(select(turns, n1, zero3<R>()), select(turns, n2, zero3<R>()));
  }

  // The damping fraction of a vertex that began the step at a gap, and its derivative by the gap. It fades in with the
  // normal force A there, A / (A + kappa dhat / 10), as that of pairs does (diffvbd/energies.py): switched on at dhat,
  // damping would make a motion jump where a vertex comes there a step sooner, and gradients miss jumps. kappa cancels;
  // without a barrier there is no damping.
  template <class R>
  struct DampingFraction {
    R value, slope;
  };
  template <class R>
  DIFFVBD_FN static DampingFraction<R> damping_fraction(const Plane<R>& plane, const R& gap) {
    const LogBarrier<R> b(gap, plane.dhat, R(1));
    const R half = R(fade()) * plane.dhat, inv = R(1) / (half - b.first);
    const auto acts = R(0) < plane.kappa;
    return {select(acts, -b.first * inv, R(0)), select(acts, -b.second * inv * (half * inv), R(0))};
  }
  // whether a plane damps, or has a derivative by its damping
  template <class R>
  DIFFVBD_FN static bool damps(const R& damping) {
    return any(R(0) < damping);
  }
  template <class R>
  DIFFVBD_FN static bool damps(const Dual<R>&) {
    return true;
  }

  // The part of one plane in the block: slope n in g, curvature n n^T in H.
  template <class R>
  struct Push {
    Vec3<R> n;  // in the axes of the block
    R slope, curvature;
  };
  template <class R>
  DIFFVBD_FN static Push<R> push(const VertexState<R>& s, const R* record, const Frame<R>& axes) {
    const Plane<R> plane(record, s);
    const R d = plane.gap(s.x), before = plane.gap(s.x_prev), h2 = s.h * s.h;
    Push<R> out{axes.normal(plane.n), R(0), R(0)};
    if (damps(plane.damping) && any(before < plane.dhat)) {
      const R approach = dot(plane.n, s.x - s.x_prev);
      // H has it for both directions, as for pairs: where a start has left no approach, rounding would switch it.
      out.curvature = plane.damping * s.h * damping_fraction(plane, before).value;
      out.slope = out.curvature * select(approach < R(0), approach, R(0));
    }
    if (any(d < plane.dhat)) {
      const LogBarrier<R> b(d, plane.dhat, plane.kappa);
      out.slope = out.slope + h2 * b.first;
      out.curvature = out.curvature + h2 * b.second;
    }
    return out;
  }

  // g and H, and below p and d_raw, are in the axes of `axes`.
  template <class R>
  DIFFVBD_FN static void block(const VertexState<R>& s, const R* data, int count, Vec3<R>& g, Sym3<R>& H,
                               const Frame<R>& axes = Frame<R>::none()) {
    for (int k = 0; k < count; k += stride) {
      const Push<R> f = push(s, data + k, axes);
      g += f.slope * f.n;
      add_outer(H, f.curvature, f.n);
    }
  }

  // the potential whose gradient block() adds
  template <class R>
  DIFFVBD_FN static R value(const VertexState<R>& s, const R* data, int count) {
    R sum = R(0);
    for (int k = 0; k < count; k += stride) {
      const Plane<R> plane(data + k, s);
      sum = sum + potential(s, plane, plane.gap(s.x), dot(plane.n, s.x - s.x_prev));
    }
    return sum;
  }
  // The change along a step, or its excess over the quadratic model of g and H; the sizes of the terms are
  // added to `size`. The gap after the step comes from the gap before: the difference of two positions would round by
  // far more than a small step changes.
  template <bool beyond_quadratic = false, class R>
  DIFFVBD_FN static R change(const VertexState<R>& s, const Vec3<R>& step, const R* data, int count, R& size) {
    R sum = R(0);
    for (int k = 0; k < count; k += stride) {
      const Plane<R> plane(data + k, s);
      const R d = plane.gap(s.x), travel = dot(plane.n, s.x - s.x_prev), move = dot(plane.n, step), after = d + move;
      const R one = potential(s, plane, d, travel), two = potential(s, plane, after, travel + move);
      sum = sum + (two - one);
      size = size + one + two - s.h * s.h * LogBarrier<R>(after, plane.dhat, plane.kappa).first * after;
      if constexpr (beyond_quadratic) {
        const Push<R> f = push(s, data + k, Frame<R>::none());
        const R first = f.slope * move, second = R(0.5) * f.curvature * move * move;
        sum = sum - (first + second);
        size = size + absolute(first) + second;
      }
    }
    return sum;
  }
  // The potential of one plane, at a gap and after a travel away from it within the step.
  template <class R>
  DIFFVBD_FN static R potential(const VertexState<R>& s, const Plane<R>& plane, const R& gap, const R& travel) {
    R out = R(0);
    if (any(gap < plane.dhat)) out = s.h * s.h * LogBarrier<R>(gap, plane.dhat, plane.kappa).value;
    const R before = plane.gap(s.x_prev);
    if (!damps(plane.damping) || !any(before < plane.dhat)) return out;
    const R approach = select(travel < R(0), travel, R(0));
    return out + R(0.5) * plane.damping * s.h * damping_fraction(plane, before).value * approach * approach;
  }

  // Whether a move from `before` to s.x leaves every plane at least `kept` of the gap there was, and more than
  // rounding in T. The barrier's potential means nothing elsewhere.
  template <class T, class R>
  DIFFVBD_FN static bool admits(const VertexState<R>& s, const Vec3<R>& before, const R* data, int count, R kept) {
    bool out = true;
    for (int k = 0; k < count; k += stride) {
      const Plane<R> plane(data + k, s);
      const R d = plane.gap(s.x);
      out = out && plane.template guard<T>(s) < d && kept * plane.gap(before) <= d;
    }
    return out;
  }

  // adjoint of p . (g + H d_raw), negated, toward x and x_prev; toward the data Dual serves
  template <class R>
  DIFFVBD_FN static void block_vjp(const VertexState<R>& s, const R* data, int count, const Vec3<R>& p,
                                   const Vec3<R>& d_raw, Vec3<R>& x_bar, Vec3<R>& x_prev_bar,
                                   const Frame<R>& axes = Frame<R>::none()) {
    for (int k = 0; k < count; k += stride) {
      const Plane<R> plane(data + k, s);
      const Vec3<R> n = axes.normal(plane.n);
      const R n_p = dot(n, p), n_d = dot(n, d_raw), d = plane.gap(s.x), h2 = s.h * s.h;
      if (any(d < plane.dhat)) {
        const LogBarrier<R> b(d, plane.dhat, plane.kappa);
        x_bar -= h2 * (b.second * n_p + b.third * n_d * n_p) * plane.n;
      }
      const R before = plane.gap(s.x_prev);
      if (!damps(plane.damping) || !any(before < plane.dhat)) continue;
      const R travel = dot(plane.n, s.x - s.x_prev), c = plane.damping * s.h;
      const auto nearer = travel < R(0);
      const DampingFraction<R> acts = damping_fraction(plane, before);
      const Vec3<R> pull = select(nearer, c * acts.value, R(0)) * n_p * plane.n;
      x_bar -= pull;
      x_prev_bar += pull - c * acts.slope * (select(nearer, travel, R(0)) + n_d) * n_p * plane.n;
    }
  }

  // The largest fraction of the step that one plane admits.
  template <class R, class T>
  DIFFVBD_FN static R fraction(const VertexState<R>& s, const R* record, const Vec3<R>& step,
                               const StepParameters<T>& q) {
    const Plane<R> plane(record, s);
    return filter_fraction(plane.gap(s.x), dot(plane.n, step), q);
  }

  // The fraction of the step that all planes admit.
  template <class R, class T>
  DIFFVBD_FN static R filter(const VertexState<R>& s, const R* data, int count, const Vec3<R>& step,
                             const StepParameters<T>& q) {
    R alpha = R(1);
    for (int k = 0; k < count; k += stride) {
      const R a = fraction(s, data + k, step, q);
      alpha = select(a < alpha, a, alpha);
    }
    // Rounding must not undo the filter: a vertex whose new gap cannot be told from zero stays where it is.
    const Vec3<R> x_new = s.x + alpha * step;
    for (int k = 0; k < count; k += stride) {
      const Plane<R> plane(data + k, s);
      alpha = select(plane.template guard<T>(s) < plane.gap(x_new), alpha, R(0));
    }
    return alpha;
  }

  // alpha_bar -> adjoints of x and step, for the alpha that filter() returned
  template <class R, class T>
  DIFFVBD_FN static void filter_vjp(const VertexState<R>& s, const R* data, int count, const Vec3<R>& step,
                                    const StepParameters<T>& q, const R& alpha, const R& alpha_bar, Vec3<R>& x_bar,
                                    Vec3<R>& step_bar) {
    R binding = R(1);
    Vec3<R> dx = zero3<R>(), dstep = zero3<R>();
    for (int k = 0; k < count; k += stride) {
      const Plane<R> plane(data + k, s);
      const R change = dot(plane.n, step);
      const R a = filter_fraction(plane.gap(s.x), change, q);
      const auto binds = a < binding;
      if (!any(binds)) continue;
      const R rate = R(1) / select(binds, -change, R(1));
      const R by_x = select(binds, R(q.filter_eta) * rate, R(0)), by_step = select(binds, a * rate, R(0));
      dx = {select(binds, by_x * plane.n.x, dx.x), select(binds, by_x * plane.n.y, dx.y),
            select(binds, by_x * plane.n.z, dx.z)};
      dstep = {select(binds, by_step * plane.n.x, dstep.x), select(binds, by_step * plane.n.y, dstep.y),
               select(binds, by_step * plane.n.z, dstep.z)};
      binding = select(binds, a, binding);
    }
    const R live = select(R(0) < alpha, alpha_bar, R(0));
    x_bar += live * dx;
    step_bar += live * dstep;
  }
};

}  // namespace diffvbd
