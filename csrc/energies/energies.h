// THE list of energies. A scene's energies form a mask; each mask is a compiled variant, so an absent energy costs no
// instruction, but for one that is optional: on the CPU it costs a test. An energy of one vertex is a struct with
// stride, per_vertex, has_filter, reads_x_prev, optional, block() and value(); with a block_vjp() too it is hot,
// without one Dual derives its adjoint.
#pragma once

#include <type_traits>

#include "../core/dual.h"
#include "../core/frame.h"
#include "../core/safeguards.h"
#include "../core/views.h"
#include "anchor.h"
#include "floor_barrier.h"
#ifdef DIFFVBD_LAW_HEADER
#include "own_law.h"
#else
#include "stable_neo_hookean.h"
#endif

namespace diffvbd {

template <class... E>
struct EnergyList {
  static constexpr int size = sizeof...(E);
};

using VertexEnergies = EnergyList<FloorBarrier, Anchor>;
constexpr int kVertexEnergies = VertexEnergies::size;
// Bits of a mask: the elastic block, contact, then the energies of the list, so that a new one moves no other bit.
// Twins stand in diffvbd/_common/constants.py.
enum ElasticBits { kExactBlock = 1, kPaperBlock = 2 };
constexpr int kElastic = kExactBlock | kPaperBlock;
constexpr int kContact = 4;
#ifdef DIFFVBD_LAW_HEADER
constexpr bool kOwnLaw = true;
template <bool>
using ElasticLaw = OwnLaw;
#else
constexpr bool kOwnLaw = false;
template <bool exact>
using ElasticLaw = StableNeoHookean<exact>;
#endif
constexpr int kAllAdjoints =
    kOwnLaw ? kRest : kMaterial | kRest;  // a generated law has its parameters in the rest shape
using TetLaw = ElasticLaw<true>;          // for what both blocks share: the potential and the stiffness at rest
constexpr int kFirstVertexBit = 3;

// The compiled variants are numbered (elastic, the bits above): mask of the n-th, and back; and of those without
// contact. A scene without an elastic energy runs the first, with no tet in any star.
constexpr int kElasticVariants = 2;                                     // exact, paper
constexpr int kFreeSets = kElasticVariants << kVertexEnergies;          // without contact
constexpr int kEnergySets = kElasticVariants << (kVertexEnergies + 1);  // and with it
#ifdef DIFFVBD_ONE_VARIANT  // everything at once, for all sets: tells whether the sources compile, and runs nothing
constexpr int energy_mask(int) { return kExactBlock | kContact | ((1 << kVertexEnergies) - 1) << kFirstVertexBit; }
constexpr int free_mask(int) { return energy_mask(0) & ~kContact; }
#else
constexpr int energy_mask(int n) { return 1 + n % kElasticVariants + (n / kElasticVariants) * kContact; }
constexpr int free_mask(int n) { return 1 + n % kElasticVariants + (n / kElasticVariants << kFirstVertexBit); }
#endif
constexpr int elastic_index(int mask) { return (mask & kPaperBlock) != 0 ? 1 : 0; }
constexpr int energy_index(int mask) { return elastic_index(mask) + mask / kContact * kElasticVariants; }
constexpr int free_index(int mask) { return elastic_index(mask) + (mask >> kFirstVertexBit) * kElasticVariants; }
// A quick build, for work on an energy (docs/guides/extend.md), leaves out the paper's block, and a generated law has
// none.
#if defined(DIFFVBD_LAW_HEADER) || defined(DIFFVBD_QUICK)
constexpr bool is_compiled(int mask) { return (mask & kPaperBlock) == 0; }
#else
constexpr bool is_compiled(int) { return true; }
#endif
// Bits of the optional energies. The CPU compiles them into every variant, where an absent one is a loop of no
// turns: variants then double with hot energies alone.
template <class... E>
constexpr int optional_bits(EnergyList<E...>) {
  int k = kFirstVertexBit, bits = 0;
  ((bits |= int(E::optional) << k++), ...);
  return bits;
}
constexpr int with_optional(int mask) { return mask | optional_bits(VertexEnergies{}); }
// What CUDA compiles for a mask: a generated law, compiled at its first use, has half the variants so.
constexpr int compiled_mask(int mask) { return kOwnLaw ? with_optional(mask) : mask; }
constexpr int kMaxEnergyData = 64;  // scalars that the energies of one vertex may read

// One block update, from the Newton step to the executed one.
template <class R>
struct Update {
  Vec3<R> d_raw;  // Newton step before the safeguards
  Vec3<R> step;   // relaxed and saturated, before the step filter
  R alpha;        // step filter
  R fraction;     // of what is left, 1, 1/2, ...: as much as does not raise the vertex's own potential
};

template <class... E>
constexpr bool is_per_vertex(int k, EnergyList<E...>) {
  const bool flags[] = {E::per_vertex...};
  return flags[k];
}
// what is wrong with one record of the k-th energy's data, or null
template <class T, class... E>
const char* invalid_data(int k, const T* record, EnergyList<E...>) {
  const char* (*const checks[])(const T*) = {&E::template invalid<T>...};
  return checks[k](record);
}
template <class... E>
constexpr int data_stride(int k, EnergyList<E...>) {
  const int strides[] = {E::stride...};
  return strides[k];
}
template <class... E>
constexpr bool any_filter(int mask, EnergyList<E...>) {
  int k = kFirstVertexBit;
  return ((((mask >> k++) & 1) && E::has_filter) || ...);
}
// Whether updates take fractions of their steps (sweep/vertex.h): with a step filter, or where a vertex's own potential
// is not quadratic.
constexpr bool takes_fractions(int mask) { return !TetLaw::quadratic || any_filter(mask, VertexEnergies{}); }
// Whether a vertex must come back to its old position exactly in the reverse: gaps depend on it to the bit, and an undo
// by subtraction is an ulp off at times.
constexpr bool keeps_positions(int mask) { return (mask & kContact) != 0 || takes_fractions(mask); }
// What a tape keeps for that: the old position and, where they are decided, the fraction of the update.
constexpr int kept_scalars(int mask) { return takes_fractions(mask) ? 4 : keeps_positions(mask) ? 3 : 0; }
constexpr bool has_vertex_energy(int mask) { return (mask >> kFirstVertexBit) != 0; }
template <class... E>
constexpr bool any_x_prev(int mask, EnergyList<E...>) {
  int k = kFirstVertexBit;
  return ((((mask >> k++) & 1) && E::reads_x_prev) || ...);
}

template <int mask>
struct EnergySet {
  static constexpr bool well_conditioned = false;
  static constexpr bool contact = (mask & kContact) != 0;
  static constexpr bool of_vertices = has_vertex_energy(mask);
  using Elastic = ElasticLaw<(mask & kExactBlock) != 0>;

  // calls f(energy, its position in the list) for each energy of one vertex that is present
  template <class F>
  DIFFVBD_FN static void for_each(F&& f) {
    visit<0>(f, VertexEnergies{});
  }
  static constexpr bool filters = any_filter(mask, VertexEnergies{});
  static constexpr bool takes_fractions = diffvbd::takes_fractions(mask);
  static constexpr bool keeps_positions = diffvbd::keeps_positions(mask);
  static constexpr int kept_scalars = diffvbd::kept_scalars(mask);
  static constexpr bool reads_x_prev = any_x_prev(mask, VertexEnergies{});

 private:
  template <int k, class F>
  DIFFVBD_FN static void visit(F&, EnergyList<>) {}
  template <int k, class F, class E, class... Rest>
  DIFFVBD_FN static void visit(F& f, EnergyList<E, Rest...>) {
    if constexpr ((mask >> (kFirstVertexBit + k)) & 1) f(E{}, k);
    visit<k + 1>(f, EnergyList<Rest...>{});
  }
};

// The same energies for blocks that need neither axes along planes nor a refined solve (core/frame.h, sweep/refine.h):
// nearly all of them. CUDA does these first, with fewer registers, and the others once more by themselves.
template <class Set>
struct WellConditioned : Set {
  static constexpr bool well_conditioned = true;
};

template <class E, class = void>
struct has_block_vjp : std::false_type {};
template <class E>
struct has_block_vjp<E, std::void_t<decltype(&E::template block_vjp<double>)>> : std::true_type {};

// A plane after a step: out of line, so that no compiler fuses its products in one place and not in another.
template <class E, class R>
struct PlanePush {
  Vec3<R> n;
  R curvature, reaction;  // slope + curvature n . d_raw
};
template <class E, class R>
DIFFVBD_COLD PlanePush<E, R> push_of(const VertexState<R>& s, const R* record, const Frame<R>& axes,
                                     const Vec3<R>& d_raw) {
  const auto f = E::push(s, record, axes);
  return {f.n, f.curvature, f.slope + f.curvature * dot(f.n, d_raw)};
}
// The axes of p and d_raw, and a small part of d_raw that is kept apart (sweep/refine.h). The reaction of a plane is
// the small difference of a large slope and a large answer to it: that part gives it its digits.
template <class R>
struct PlaneStep {
  Frame<R> axes;
  Vec3<R> d_low;
  template <class E>
  DIFFVBD_FN R reaction(const VertexState<R>& s, const R* record, const Vec3<R>& d_raw) const {
    const PlanePush<E, R> f = push_of<E>(s, record, axes, d_raw);
    return f.reaction + f.curvature * dot(f.n, d_low);
  }
};
template <class R>
DIFFVBD_FN PlaneStep<R> plane_step(const Frame<R>& axes, const Vec3<R>& d_low) {
  return {axes, d_low};
}
template <class R>
DIFFVBD_FN NoFrame<R> plane_step(const NoFrame<R>& axes, const Vec3<R>&) {
  return axes;
}

// Adjoint of phi = p . (g + H d_raw) for one record of an energy's data, by one Dual evaluation for each input. The
// records of an energy only add up. Kept out of line: it is shared by all variants and seldom wanted.
template <class E, class R, class Planes = NoFrame<R>>
struct DualAdjoint {
  const VertexState<R>& s;
  const R* record;
  const Vec3<R>&p, &d_raw;
  Planes planes = {};

  DIFFVBD_FN R derivative(const VertexState<Dual<R>>& state, const Dual<R>* values) const {
    if constexpr (std::is_same_v<Planes, PlaneStep<R>>) {
      const auto f = E::push(state, values, constant(planes.axes));
      Dual<R> reaction = f.slope + f.curvature * dot(f.n, constant(d_raw));
      reaction.value = planes.template reaction<E>(s, record, d_raw);
      return (reaction * dot(f.n, constant(p))).derivative;
    }
    Vec3<Dual<R>> g = zero3<Dual<R>>();
    Sym3<Dual<R>> H = diagonal(Dual<R>(0));
    E::block(state, values, E::stride, g, H);
    return dot(constant(p), g + H * constant(d_raw)).derivative;
  }
  DIFFVBD_FN VertexState<Dual<R>> lifted() const {
    return {constant(s.x), constant(s.x_prev), constant(s.origin), Dual<R>(s.h)};
  }
  DIFFVBD_FN void lift(Dual<R>* values) const {
    for (int i = 0; i < E::stride; ++i) values[i] = Dual<R>(record[i]);
  }
  DIFFVBD_APART void subtract_from(Vec3<R>& bar, Vec3<Dual<R>> VertexState<Dual<R>>::* which) const {
    Dual<R> values[E::stride];
    lift(values);
    R* out[3] = {&bar.x, &bar.y, &bar.z};
    for (int c = 0; c < 3; ++c) {
      VertexState<Dual<R>> state = lifted();
      Vec3<Dual<R>>& v = state.*which;
      (c == 0 ? v.x : c == 1 ? v.y : v.z).derivative = R(1);
      *out[c] = *out[c] - derivative(state, values);
    }
  }
};

// -d phi / d(x, x_prev), derived from block() by dual numbers: out of line, and for copies of what the update works
// with, which would leave its registers for the address of one that is seldom there.
template <class R>
struct DerivedAdjoint {
  Vec3<R> x, x_prev;
};
template <class E, class R>
DIFFVBD_APART DerivedAdjoint<R> derived_vjp(const VertexState<R>& s, const R* data, int count, const Vec3<R>& p,
                                            const Vec3<R>& d_raw) {
  DerivedAdjoint<R> out{zero3<R>(), zero3<R>()};
  for (int k = 0; k < count; k += E::stride) {
    const DualAdjoint<E, R> adjoint{s, data + k, p, d_raw};
    adjoint.subtract_from(out.x, &VertexState<Dual<R>>::x);
    if constexpr (E::reads_x_prev) adjoint.subtract_from(out.x_prev, &VertexState<Dual<R>>::x_prev);
  }
  return out;
}

// x_bar, x_prev_bar -= d phi / d(x, x_prev)
template <class E, class R, class Planes = NoFrame<R>>
DIFFVBD_FN void vertex_energy_vjp(const VertexState<R>& s, const R* data, int count, const Vec3<R>& p,
                                  const Vec3<R>& d_raw, Vec3<R>& x_bar, Vec3<R>& x_prev_bar,
                                  const Planes& planes = {}) {
  if constexpr (std::is_same_v<Planes, PlaneStep<R>>) {
    E::block_vjp(s, data, count, p, d_raw, x_bar, x_prev_bar, planes.axes);
  } else if constexpr (has_block_vjp<E>::value) {
    E::block_vjp(s, data, count, p, d_raw, x_bar, x_prev_bar);
  } else if (count > 0) {
    const VertexState<R> s_copy = s;
    const Vec3<R> p_copy = p, d_copy = d_raw;
    const DerivedAdjoint<R> bar = derived_vjp<E>(s_copy, data, count, p_copy, d_copy);
    x_bar += bar.x;
    if constexpr (E::reads_x_prev) x_prev_bar += bar.x_prev;
  }
}

// data_bar[i] = alpha_bar d alpha / d data_i - d phi / d data_i for one record; binds = 1 if it set alpha, else 0
template <class E, class R, class T, class Planes>
DIFFVBD_APART void record_vjp(const VertexState<R>& s, const R* record, const Vec3<R>& p, const Vec3<R>& d_raw,
                              const Vec3<R>& step, const StepParameters<T>& q, const R& binds, const R& alpha_bar,
                              const Planes& planes, R* data_bar) {
  const DualAdjoint<E, R, Planes> adjoint{s, record, p, d_raw, planes};
  Dual<R> values[E::stride];
  adjoint.lift(values);
  const VertexState<Dual<R>> state = adjoint.lifted();
  for (int i = 0; i < E::stride; ++i) {
    values[i].derivative = R(1);
    data_bar[i] = -adjoint.derivative(state, values);
    if constexpr (E::has_filter) {
      const R rate = E::filter(state, values, E::stride, constant(step), q).derivative;
      data_bar[i] = data_bar[i] + select(R(0) < binds, alpha_bar * rate, R(0));
    }
    values[i].derivative = R(0);
  }
}

// Calls add(i, data_bar[i]) for all data of one energy.
template <class E, class R, class T, class Add, class Planes = NoFrame<R>>
DIFFVBD_FN void vertex_energy_data_vjp(const VertexState<R>& s, const R* data, int count, const Vec3<R>& p,
                                       const Update<R>& u, const StepParameters<T>& q, const R& alpha_bar, Add&& add,
                                       const Planes& planes = {}) {
  R alpha = R(1);
  for (int k = 0; k < count; k += E::stride) {
    R data_bar[E::stride];
    if constexpr (E::has_filter) {
      // The record that set alpha is the first of the smallest fraction; a vertex that was stopped (0) depends on no
      // datum.
      const R own = E::fraction(s, data + k, u.step, q);
      const R same = select(own < u.alpha, R(0), select(u.alpha < own, R(0), R(1)));
      const R binds = select(own < alpha, same, R(0));
      alpha = select(own < alpha, own, alpha);
      record_vjp<E>(s, data + k, p, u.d_raw, u.step, q, binds, alpha_bar, planes, data_bar);
    } else {
      record_vjp<E>(s, data + k, p, u.d_raw, u.step, q, R(0), alpha_bar, planes, data_bar);
    }
    for (int i = 0; i < E::stride; ++i) add(k + i, data_bar[i]);
  }
}

}  // namespace diffvbd
