// The system of one vertex: what its update reads, its gradient and its 3x3 block.
#pragma once

#include "../core/frame.h"
#include "../core/vec.h"
#include "../core/views.h"
#include "../energies/energies.h"

namespace diffvbd {

// The part that pairs add to the block, computed color by color before the color moves (contact/passes.h). Limits of
// the motion come after the update (contact/limit.h).
template <class R>
struct ContactTerm {
  Vec3<R> g;
  Sym3<R> H;
};
constexpr int kContactScalars = 9;

// The inputs of one block update besides its star.
template <class R>
struct Block {
  VertexState<R> state;
  Vec3<R> y;                       // predictor [m]
  R mass;                          // [kg]
  const R* data[kVertexEnergies];  // of each energy that is present
  int data_count[kVertexEnergies];
  ContactTerm<R> contact;  // where the set has contact, unless the star has it
};

// The axes in which a set's blocks are factored.
template <class Set, class R>
using Axes = std::conditional_t<Set::filters && !Set::well_conditioned, Frame<R>, NoFrame<R>>;

// g and H in these axes, and what no pivot of H lies below.
template <class Set, class R>
struct System {
  Vec3<R> g;
  Sym3<R> H;
  Axes<Set, R> axes;
  R least;
};

// Energies only add semidefinite parts to the mass.
template <class R, class T>
DIFFVBD_FN R least_eigenvalue(const Block<R>& b, const StepParameters<T>& q) {
  return b.mass + R(q.regularization);
}

// The planes that turn the axes are those of the one energy with a step filter.
template <class T, class Set, class R>
DIFFVBD_FN Axes<Set, R> axes_of(const Block<R>& b) {
  Axes<Set, R> axes;
  Set::for_each([&](auto energy, int k) {
    using E = decltype(energy);
    if constexpr (E::has_filter && !Set::well_conditioned)
      axes = E::template frame<T>(b.state, b.data[k], b.data_count[k]);
  });
  return axes;
}

// Which of the first two diagonal entries a plane does not stand on alone (1, else 0): what it puts there does no harm
// to the other entries.
template <class R>
struct Shared {
  R first, second;
};
template <class Set, class R>
DIFFVBD_FN Shared<R> shared_entries(const Block<R>& b, const Axes<Set, R>& axes) {
  Shared<R> out{R(1), R(1)};
  if constexpr (Set::filters) {
    Set::for_each([&](auto energy, int k) {
      using E = decltype(energy);
      if constexpr (E::has_filter) {
        E::leave_out(b.state, b.data[k], b.data_count[k], out.first, out.second);
        if constexpr (!Set::well_conditioned) {
          if (axes.turned) {  // where the nearest plane has the first axis
            const auto turns = R(0) < axes.tiny;
            out = {select(turns, R(0), out.first), select(turns, R(1), out.second)};
          }
        }
      }
    });
  }
  return out;
}
// Whether planes ask for axes other than those of the mesh; and whether there are any near at x.
template <class Set, class R>
DIFFVBD_FN bool is_oblique(const Block<R>& b, const Vec3<R>& x, bool or_near = false) {
  bool out = false;
  VertexState<R> s = b.state;
  s.x = x;
  Set::for_each([&](auto energy, int k) {
    using E = decltype(energy);
    if constexpr (E::has_filter) {
      out = or_near ? any(R(0) < E::near(s, b.data[k], b.data_count[k])) : E::is_oblique(s, b.data[k], b.data_count[k]);
    }
  });
  return out;
}

// The system of a vertex; of its masses, anchors and contact alone where `all` is false.
template <class Set, bool all = true, class R, class T, class Star>
DIFFVBD_FN System<Set, R> assemble(const Block<R>& b, const Star& star, const StepParameters<T>& q) {
  const R h2 = R(q.time_step) * R(q.time_step);
  const R least = least_eigenvalue(b, q);
  System<Set, R> out{b.mass * (b.state.x - b.y), diagonal(least), Axes<Set, R>::none(), least};
  if constexpr (all) {
    TetSums<R> tets = sum_tets<typename Set::Elastic>(star, b.state.x);
    star.total(tets.g, tets.h_diagonal, tets.h_outer);
    out.g += h2 * tets.g;
    add_diagonal(tets.h_outer, tets.h_diagonal);
    const Sym3<R> scaled = h2 * tets.h_outer;
    out.H = {out.H.xx + scaled.xx, scaled.xy, scaled.xz, out.H.yy + scaled.yy, scaled.yz, out.H.zz + scaled.zz};
  }
  Set::for_each([&](auto energy, int k) {
    using E = decltype(energy);
    if constexpr (!E::has_filter) E::block(b.state, b.data[k], b.data_count[k], out.g, out.H);
  });
  if constexpr (Set::contact) {
    const ContactTerm<R> contact = star.contact(b);
    out.g += contact.g;
    out.H += contact.H;
  }
  if constexpr (Set::filters) {
    out.axes = axes_of<T, Set>(b);
    if constexpr (!Set::well_conditioned) {
      if (out.axes.turned) {  // which rounds every entry by the largest ones
        const R rounding = R(0.5) * out.axes.tiny * (out.H.xx + out.H.yy + out.H.zz);
        out.least = select(least < rounding, rounding, least);
      }
    }
    out.g = out.axes.to(out.g);
    out.H = out.axes.to(out.H);
    Set::for_each([&](auto energy, int k) {
      using E = decltype(energy);
      if constexpr (E::has_filter && Set::well_conditioned) {
        E::block(b.state, b.data[k], b.data_count[k], out.g, out.H);
      } else if constexpr (E::has_filter && all) {
        E::block(b.state, b.data[k], b.data_count[k], out.g, out.H, out.axes);
      }
    });
  }
  return out;
}

// What a tape keeps of one update: step filters and contact need the old position, a compact tape leaves H (and with
// them d_raw) to be assembled again.
template <class R>
struct Recalled {
  Vec3<R> x_old, d;  // d_raw, and H, in the axes of the block: there a small n . d keeps its digits
  Factor<R> H;
  R fraction;  // with a step filter, see Update
};

}  // namespace diffvbd
