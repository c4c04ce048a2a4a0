// The coarse space of a Model (diffvbd/model/coarse.py) as the loops read it: functions, groups and tets of each body.
#pragma once

#include <cmath>
#include <limits>

#include "../core/safeguards.h"
#include "../core/views.h"
#include "../energies/tet.h"
#include "rigid.h"

namespace diffvbd::coarse {

// Functions count from 0 over all bodies; body b has function_ptr[b] ... function_ptr[b + 1] - 1. A position is where a
// vertex stands in sweep order; twin of CoarsePlan in diffvbd/model/coarse_plan.py.
struct Plan {
  int32_t bodies, functions, groups, width, entries, tet_blocks, moments, positions, listed;
  int32_t cells, most, parts, places, vertices;  // of all matrices; functions of a body at most
  int32_t large;                                 // bodies of more than kTile unknowns, the last ones
  int32_t every, begun;                          // sweeps after each correction; sweeps before the first that is run
  const int32_t* function_ptr;                   // [bodies + 1]
  const int32_t* mass_ptr;                       // [bodies + 1]  sums of squares of the numbers of functions
  const int32_t* function_body;                  // [functions]
  const int32_t* position_body;                  // [positions]  -1: none with a vertex to move
  const int32_t *position_ptr, *function;        // [positions + 1], [entries]  the functions of a position
  const int32_t *row_ptr, *row;                  // [functions + 1], [entries]  the positions of a function
  const int32_t* block_ptr;                      // [bodies + 1]  blocks of kLanes tets of a body
  const int32_t* part_ptr;                       // [bodies + 1]  parts of a body: sums over its tets are made of theirs
  const int32_t *release_body, *part_begin;      // [parts], [parts + 1]  blocks of a part
  const int32_t* corner;                         // [tet_blocks, 4, kLanes]  positions times kRow
  const int32_t* tet;             // [tet_blocks, kLanes]  any at padding, which has one corner four times
  const int32_t* group_ptr;       // [bodies + 1]  groups of a body
  const int32_t* group_body;      // [groups]
  const int32_t* group_function;  // [groups, width]  -1 beyond the last
  // the reverse, [groups], [places]: for each function of a body its place in a group, -1: none
  const int32_t *place_ptr, *place;
  const int32_t* tet_ptr;  // [groups + 1]  tets of a group, which are one after the other in its body's blocks
  // what the mean deformation of a group is made of: [groups + 1], [moments] twice; and by vertex: [vertices + 1],
  // [moments]
  const int32_t *moment_ptr, *moment_vertex, *moment_group, *vertex_ptr, *vertex_moment;
  const int32_t *list_ptr, *list, *list_position;  // [bodies + 1], [listed] twice  the vertices of a body that move
};
constexpr int kSizes = 17;
constexpr int kTile = 32;  // unknowns that CUDA takes at once; twin of TILE in diffvbd/model/coarse_plan.py

// sizes [kSizes]: those of Plan in their order. Returns the number of int32 behind p through `used`.
DIFFVBD_FN Plan view_plan(const int64_t* sizes, const int32_t* p, int64_t& used) {
  const int32_t* const start = p;
  const auto size = [&](int i) { return static_cast<int32_t>(sizes[i]); };
  Plan out{size(0), size(1),  size(2),  size(3),  size(4),  size(5),  size(6),  size(7), size(8),
           size(9), size(10), size(11), size(12), size(13), size(14), size(15), size(16)};
  const auto take = [&](int64_t count) {
    const int32_t* at = p;
    p += count;
    return at;
  };
  out.function_ptr = take(out.bodies + 1);
  out.mass_ptr = take(out.bodies + 1);
  out.function_body = take(out.functions);
  out.position_body = take(out.positions);
  out.position_ptr = take(out.positions + 1);
  out.function = take(out.entries);
  out.row_ptr = take(out.functions + 1);
  out.row = take(out.entries);
  out.block_ptr = take(out.bodies + 1);
  out.part_ptr = take(out.bodies + 1);
  out.release_body = take(out.parts);
  out.part_begin = take(out.parts + 1);
  out.corner = take(int64_t{4} * out.tet_blocks * kLanes);
  out.tet = take(int64_t{out.tet_blocks} * kLanes);
  out.group_ptr = take(out.bodies + 1);
  out.group_body = take(out.groups);
  out.group_function = take(int64_t{out.groups} * out.width);
  out.place_ptr = take(out.groups);
  out.place = take(out.places);
  out.tet_ptr = take(out.groups + 1);
  out.moment_ptr = take(out.groups + 1);
  out.moment_vertex = take(out.moments);
  out.moment_group = take(out.moments);
  out.vertex_ptr = take(out.vertices + 1);
  out.vertex_moment = take(out.moments);
  out.list_ptr = take(out.bodies + 1);
  out.list = take(out.listed);
  out.list_position = take(out.listed);
  used = p - start;
  return out;
}

// The inputs of the corrections of a step besides the scene.
template <class T>
struct Inputs {
  Plan plan;
  const T *weight, *row_weight;  // [entries] each, by position and by function
  Batched<const T> rest;         // [B, tet_blocks, kRestScalars, kLanes]
  Batched<const T>
      factor;             // [B, 9 cells]  L of A = L L^T of each body, n x n; on CUDA the inverse; A with vertex blocks
  Batched<const T> mass;  // [B, mass_ptr[bodies]]
  int corrections;
  T* tape;        // [B, corrections, tape_size()]
  T* matrix_bar;  // [B, 9 mass_ptr[bodies]], reverse only; null where not wanted

  bool keeps_positions;
  bool has_vertex_blocks;  // whether energies of vertices act: each correction then adds their blocks to A

  // of a correction: the coarse vector, the length of each body and, where gaps must come back to the bit, what it read
  DIFFVBD_FN int64_t tape_size() const {
    return int64_t{3} * plan.functions + plan.bodies + (keeps_positions ? int64_t{3} * plan.positions : 0);
  }
};

// How many corrections so many sweeps have, and whether one comes before sweep k, which is `sweeps` at the end of a
// short step; twin of CoarseSpace.corrections. begun: 1 where these sweeps go on after the first of a step.
DIFFVBD_FN int corrections_of(int sweeps, int every, int begun) {
  const int after = sweeps + begun - 1;  // sweeps that follow a correction
  return after <= 0 ? 1 : (after - 1) / every + 1;
}
DIFFVBD_FN bool corrects_before(int k, int sweeps, int every, int begun) {
  const int after = k + begun - 1;
  return sweeps + begun <= 1 ? k == sweeps : after >= 0 && k < sweeps && after % every == 0;
}

// --- the length of a correction: the longest of a few that lowers the potential enough

constexpr int kDegree = TetLayout::line_degree;
constexpr double kDecrease = 1e-4;  // of the decrease that the slope promises
constexpr int kFailures = 2;        // lengths of 0 after which a body's corrections are over

// The smooth part of the change of the potential, c[0] s + ... + c[5] s^6, and the sum of its terms' sizes. Of a law
// that is no polynomial: c are changes between trial fractions (OwnLaw::line()), and inertia stands apart.
struct Change {
  double c[kDegree];
  double slope, bend;

  DIFFVBD_FN double at(double s) const {
    if constexpr (!TetLayout::polynomial) {
      double sum = (slope + bend * s) * s;
      for (int i = kDegree - 1; i >= 0 && fraction_of(i) <= s; --i) sum += c[i];
      return sum;
    }
    double sum = 0;
    for (int i = kDegree - 1; i >= 0; --i) sum = (sum + c[i]) * s;
    return sum;
  }
  DIFFVBD_FN double size(double s) const {
    if constexpr (!TetLayout::polynomial) {
      double sum = (std::abs(slope) + bend * s) * s;
      for (int i = kDegree - 1; i >= 0 && fraction_of(i) <= s; --i) sum += std::abs(c[i]);
      return sum;
    }
    double sum = 0;
    for (int i = kDegree - 1; i >= 0; --i) sum = (sum + std::abs(c[i])) * s;
    return sum;
  }
};

// slope: of the whole potential at s = 0. more(s, size): the change of what is no polynomial, which adds to `size` and
// is infinite where s is not admissible.
template <class T, class More>
DIFFVBD_FN double length(const Change& change, double slope, const More& more) {
  if (!(slope <= 0)) return 0;  // at rest it is 0: the whole correction is taken, for its derivative
  for (int trial = 0; trial < kFractions; ++trial) {
    const double s = fraction_of(trial);
    double size = change.size(s);
    const double increase = change.at(s) + more(s, size);
    if (increase <= kDecrease * s * slope + kRounding * double(std::numeric_limits<T>::epsilon()) * size) return s;
  }
  return 0;
}

// --- the potential of a body along a correction, and the length of the step. Sums belong to a Team (sweep/body.h).

using rigid::Vector;

// One body of one scene. In: StepInputs of a backend; x, displacement: rows of its positions.
template <class T, class In>
struct Line {
  const In& in;
  const Inputs<T>& c;
  const int64_t* data_start;  // of each energy among the data of a scene
  int64_t scene;
  int32_t body;
  const T *x, *displacement;

  DIFFVBD_FN int32_t size() const { return c.plan.list_ptr[body + 1] - c.plan.list_ptr[body]; }
  DIFFVBD_FN int32_t vertex(int32_t i) const { return c.plan.list[c.plan.list_ptr[body] + i]; }
  DIFFVBD_FN int64_t row(int32_t i) const { return int64_t{kRow} * c.plan.list_position[c.plan.list_ptr[body] + i]; }
  DIFFVBD_FN static Vector at(const T* a) { return {double(a[0]), double(a[1]), double(a[2])}; }

  // Vertex i's part of the slope of the inertial potential.
  DIFFVBD_FN double inertia(int32_t i) const {
    const int64_t v = vertex(i);
    const double mass = in.mass.data[scene * in.mass.scene + v];
    return mass * dot(at(x + row(i)) - at(in.y.data + scene * in.y.scene + 3 * v), at(displacement + row(i)));
  }

  DIFFVBD_FN VertexState<double> state(int32_t i) const {
    const int64_t v = vertex(i);
    VertexState<double> out{at(x + row(i)),
                            at(in.x_prev.data + scene * in.x_prev.scene + 3 * v),
                            {0, 0, 0},
                            double(in.parameters.time_step)};
    if (in.origin.data) out.origin = at(in.origin.data + scene * in.origin.scene + 3 * v);
    return out;
  }
  // calls f(energy, its data for vertex i, their count) for the energies that are present
  template <class F>
  DIFFVBD_FN void each_energy(int32_t i, F&& f) const {
    rigid::each_energy(
        [&](auto energy, int k) {
          const int count = in.data_count[k];
          if (count == 0) return;
          const T* own = in.data.data + scene * in.data.scene + data_start[k] +
                         (decltype(energy)::per_vertex ? int64_t{vertex(i)} * count : 0);
          double data[kMaxEnergyData];
          for (int d = 0; d < count; ++d) data[d] = own[d];
          f(energy, data, count);
        },
        VertexEnergies{});
  }

  // The increase of the energies of vertex i: infinite where one of them does not admit the motion. Adds their sizes to
  // `size`.
  DIFFVBD_FN double energies(int32_t i, double s, double& size) const {
    const VertexState<double> before = state(i);
    VertexState<double> after = before;
    after.x += s * at(displacement + row(i));
    double increase = 0;
    bool admitted = true;
    each_energy(i, [&](auto energy, const double* data, int count) {
      using E = decltype(energy);
      if constexpr (E::has_filter) {
        admitted = admitted && E::template admits<T>(after, before.x, data, count, rigid::kLeastGapFraction);
        increase += E::change(before, s * at(displacement + row(i)), data, count, size);
      } else {
        const double now = E::value(before, data, count), then = E::value(after, data, count);
        increase += then - now;
        size += std::abs(now) + std::abs(then);
      }
    });
    return admitted ? increase : std::numeric_limits<double>::infinity();
  }

  // Their part of the block of vertex i.
  DIFFVBD_FN Sym3<double> block(int32_t i) const {
    const VertexState<double> now = state(i);
    Vector g{};
    Sym3<double> H{};
    each_energy(i,
                [&](auto energy, const double* data, int count) { decltype(energy)::block(now, data, count, g, H); });
    return H;
  }
};

DIFFVBD_FN bool acts(const Sym3<double>& H) { return H.xx + H.yy + H.zz > 0; }  // of a semidefinite block

// The length of a correction a, where `restricted` is what it was solved from; tets [parts, kDegree]: coefficients of
// the tets' energy along it, by part.
template <class T, class In, class Team>
DIFFVBD_FN double decide(const Line<T, In>& line, const T* a, const T* restricted, const double* tets,
                         const Team& team) {
  const Plan& p = line.c.plan;
  const int32_t first = p.function_ptr[line.body], count = p.function_ptr[line.body + 1] - first;
  double slope[1], inertial[1], inertia[1];  // the second: a . (P' M P) a
  team.template sum<1>(3 * count, slope, [&](int32_t i, double* out) {
    out[0] -= double(a[3 * first + i]) * double(restricted[3 * first + i]);
  });
  const T* mass = line.c.mass.data + line.scene * line.c.mass.scene + p.mass_ptr[line.body];
  team.template sum<1>(count * count, inertial, [&](int32_t cell, double* out) {
    const T *one = a + 3 * (first + cell / count), *two = a + 3 * (first + cell % count);
    out[0] += double(mass[cell]) * dot(line.at(one), line.at(two));
  });
  Change change{};
  team.template sum<kDegree>(p.part_ptr[line.body + 1] - p.part_ptr[line.body], change.c,
                             [&](int32_t part, double* out) {
                               const double* own = tets + (p.part_ptr[line.body] + part) * kDegree;
                               for (int i = 0; i < kDegree; ++i) out[i] += own[i];
                             });
  const double h2 = double(line.in.parameters.time_step) * double(line.in.parameters.time_step);
  for (double& c : change.c) c *= h2;
  (TetLayout::polynomial ? change.c[1] : change.bend) += 0.5 * inertial[0];
  bool others = !TetLayout::polynomial;
  for (int k = 0; k < kVertexEnergies; ++k) others = others || line.in.data_count[k] > 0;
  if (!others) {
    change.c[0] = slope[0];
    return length<T>(change, slope[0], [](double, double&) { return 0.0; });
  }
  team.template sum<1>(line.size(), inertia, [&](int32_t i, double* out) { out[0] += line.inertia(i); });
  (TetLayout::polynomial ? change.c[0] : change.slope) += inertia[0];
  return length<T>(change, slope[0], [&](double s, double& size) {
    double sums[2];
    team.template sum<2>(line.size(), sums, [&](int32_t i, double* out) { out[0] += line.energies(i, s, out[1]); });
    size += sums[1];
    return sums[0];
  });
}

// --- the increase of the potential of all bodies (subspace/rigid.h)

constexpr int kBlockTets = 8;  // of a block of MovingBodies; at padding one vertex four times

template <class T>
struct IncreaseInputs {
  rigid::Inputs<T> bodies;            // x is where the displacements begin,
  const T* to;                        // [B, V, 3] and this where they end
  const int32_t *corner, *block_ptr;  // [blocks, 4, kBlockTets] four times a vertex; [bodies + 1]
  Batched<const T> rest, material;    // of the tets by block, [blocks, 7 | 2, kBlockTets]
  int64_t blocks, listed;             // and vertices in the order of bodies
};

}  // namespace diffvbd::coarse
