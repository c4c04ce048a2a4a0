// The algorithm: one block update of Vertex Block Descent (paper, eqs. 2-3) and its exact transpose (eqs. 7-12).
// Loops, memory and launches belong to cpu/ and cuda/; a Star gives this file the incident tets of one vertex, and
// where several threads share them, total() sums over the threads.
#pragma once

#include "../energies/energies.h"
#include "bounds.h"
#include "safeguards.h"
#include "views.h"

namespace diffvbd {

// Everything one block update reads besides its star.
template <class R>
struct Block {
  VertexState<R> state;
  Vec3<R> y;                       // predictor [m]
  R mass;                          // [kg]
  const R* data[kVertexEnergies];  // of each energy that is present
  int data_count[kVertexEnergies];
  ContactTerm<R> contact;  // where the set has contact
};

template <class R>
struct System {
  Vec3<R> g;
  Sym3<R> H;
};

// Energies only add semidefinite parts to the mass.
template <class R, class T>
DIFFVBD_FN R least_eigenvalue(const Block<R>& b, const StepParameters<T>& q) {
  return b.mass + R(q.regularization);
}

template <class Set, class R, class T, class Star>
DIFFVBD_FN System<R> assemble(const Block<R>& b, const Star& star, const StepParameters<T>& q) {
  const R h2 = R(q.time_step) * R(q.time_step);
  System<R> out{b.mass * (b.state.x - b.y), diagonal(least_eigenvalue(b, q))};
  if constexpr (Set::elastic) {
    Vec3<R> g = zero3<R>();
    R h_diagonal = R(0);
    Sym3<R> h_outer = diagonal(R(0));
    for (int e = 0; e < star.size(); ++e) {
      Set::Elastic::block(star.pair(e), b.state.x, g, h_diagonal, h_outer);
    }
    star.total(g, h_diagonal, h_outer);
    out.g += h2 * g;
    add_diagonal(h_outer, h_diagonal);
    const Sym3<R> scaled = h2 * h_outer;
    out.H = {out.H.xx + scaled.xx, scaled.xy, scaled.xz, out.H.yy + scaled.yy, scaled.yz, out.H.zz + scaled.zz};
  }
  Set::for_each([&](auto energy, int k) {
    using E = decltype(energy);
    E::block(b.state, b.data[k], b.data_count[k], out.g, out.H);
  });
  if constexpr (Set::contact) {
    out.g += b.contact.g;
    out.H += b.contact.H;
  }
  return out;
}

template <class R, class T>
DIFFVBD_FN Factor<R> factored(const Block<R>& b, const System<R>& system, const StepParameters<T>& q) {
  return factor<T>(system.H, least_eigenvalue(b, q));
}

template <class R>
DIFFVBD_FN Vec3<R> newton_step(const System<R>& system, const Factor<R>& H) {
  return -solve(H, system.g);
}

// Saturated, then relaxed.
template <class R, class T>
DIFFVBD_FN Vec3<R> relaxed(const Vec3<R>& d_raw, const StepParameters<T>& q) {
  return R(q.relaxation) * (q.saturates ? saturate(d_raw, q) : d_raw);
}

// From the Newton step to the executed one.
template <class Set, class R, class T>
DIFFVBD_FN Update<R> safeguarded(const Block<R>& b, const Vec3<R>& d_raw, const StepParameters<T>& q) {
  Update<R> out{d_raw, relaxed(d_raw, q), R(1)};
  if constexpr (Set::contact) out.step = bounded(b.state.x, out.step, b.contact.bound);
  Set::for_each([&](auto energy, int k) {
    using E = decltype(energy);
    if constexpr (E::has_filter) {
      const R alpha = E::filter(b.state, b.data[k], b.data_count[k], out.step, q);
      out.alpha = select(alpha < out.alpha, alpha, out.alpha);
    }
  });
  return out;
}

template <class Set, class R>
DIFFVBD_FN Vec3<R> moved(const Vec3<R>& x, const Update<R>& u) {
  if constexpr (Set::filters) return x + u.alpha * u.step;
  return x + u.step;
}

// What a tape keeps of one update: step filters and contact need the old position, a compact tape leaves H (and with
// them d_raw) to be assembled again.
template <class R>
struct Recalled {
  Vec3<R> x_old, d_raw;
  Factor<R> H;
};

// The update that was executed. Puts b.state.x back to where it was before it, and completes what the tape left out.
template <class Set, class R, class T, class Star>
DIFFVBD_FN Update<R> replayed(Block<R>& b, const Star& star, Recalled<R>& r, bool full, const StepParameters<T>& q) {
  Update<R> u;
  if constexpr (Set::keeps_positions) {
    b.state.x = r.x_old;
  } else {
    u = safeguarded<Set>(b, r.d_raw, q);
    b.state.x -= u.step;
  }
  if (!full) {
    const System<R> system = assemble<Set>(b, star, q);
    r.H = factored(b, system, q);
    if (Set::keeps_positions) r.d_raw = newton_step(system, r.H);
  }
  if constexpr (Set::keeps_positions) u = safeguarded<Set>(b, r.d_raw, q);
  return u;
}

// Calls get() for each scalar that a tape keeps of one update, in the order in which the forward put them.
template <class Set, class R, class Get>
DIFFVBD_FN Recalled<R> recall(bool full, Get&& get) {
  Recalled<R> r{};
  if (Set::keeps_positions) r.x_old = {get(), get(), get()};
  if (full || !Set::keeps_positions) r.d_raw = {get(), get(), get()};
  if (full) r.H = {get(), get(), get(), get(), get(), get()};
  return r;
}
template <class Set, class R, class Put>
DIFFVBD_FN void record(bool full, const Block<R>& before, const Update<R>& u, const Factor<R>& H, Put&& put) {
  if (Set::keeps_positions) put(before.state.x.x), put(before.state.x.y), put(before.state.x.z);
  if (full || !Set::keeps_positions) put(u.d_raw.x), put(u.d_raw.y), put(u.d_raw.z);
  if (full) put(H.l21), put(H.l31), put(H.l32), put(H.inv1), put(H.inv2), put(H.inv3);
}

// Adjoints of what one update read, except those of its star, which go through star.add().
template <class R>
struct BlockAdjoint {
  Vec3<R> x, y, x_prev;
  R mass;
  Vec3<R> p;       // H^-1 of what reaches the Newton step: what the adjoint of pairs starts from
  Bound<R> bound;  // where the set has contact
};

// Transpose of one block update. `b` holds the state before it, `x_bar` the adjoint of the position after it.
// add_data(k, i, value) receives the adjoint of b.data[k][i]; it is called only if `wants_data`.
template <class Set, int wanted, class R, class T, class Star, class AddData>
DIFFVBD_FN BlockAdjoint<R> reverse_vertex(const Block<R>& b, const Star& star, const Update<R>& u, const Factor<R>& H,
                                          const Vec3<R>& x_bar, const StepParameters<T>& q, bool wants_data,
                                          AddData&& add_data) {
  const R h = R(q.time_step), minus_h2 = -(h * h);
  BlockAdjoint<R> out{x_bar, zero3<R>(), zero3<R>(), R(0), zero3<R>(), {zero3<R>(), R(0)}};
  Vec3<R> step_bar = x_bar;
  R alpha_bar = R(0);
  if constexpr (Set::filters) {
    alpha_bar = dot(u.step, x_bar);
    step_bar = u.alpha * x_bar;
    Set::for_each([&](auto energy, int k) {
      using E = decltype(energy);
      if constexpr (E::has_filter) {
        E::filter_vjp(b.state, b.data[k], b.data_count[k], u.step, q, u.alpha, alpha_bar, out.x, step_bar);
      }
    });
  }
  if constexpr (Set::contact) {
    bounded_vjp(b.state.x, relaxed(u.d_raw, q), b.contact.bound, step_bar, out.x, out.bound);
  }
  Vec3<R> z = R(q.relaxation) * step_bar;
  if (q.saturates) z = saturate_vjp(u.d_raw, z, q);
  const Vec3<R> p = solve(H, z);
  out.p = p;

  out.y = b.mass * p;
  out.x -= out.y;
  out.mass = -(dot(b.state.x - b.y, p) + dot(u.d_raw, p));
  if constexpr (Set::elastic) {
    Vec3<R> own = zero3<R>();
    for (int e = 0; e < star.size(); ++e) {
      const auto pair = Set::Elastic::template block_vjp<wanted>(star.pair(e), b.state.x, u.d_raw, p, minus_h2);
      own += pair.xi;
      star.template add<wanted>(e, pair);
    }
    star.total(own);
    out.x += own;
  }
  Set::for_each([&](auto energy, int k) {
    using E = decltype(energy);
    const R* data = b.data[k];
    vertex_energy_vjp<E>(b.state, data, b.data_count[k], p, u.d_raw, out.x, out.x_prev);
    if (wants_data) {
      vertex_energy_data_vjp<E>(b.state, data, b.data_count[k], p, u, q, alpha_bar,
                                [&](int i, const R& value) { add_data(k, i, value); });
    }
  });
  return out;
}

}  // namespace diffvbd
