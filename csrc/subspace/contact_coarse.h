// The coarse correction of bodies that touch (docs/method.md, section 16): one Newton step of the incremental potential
// in the coarse functions of all bodies of a scene together, and its transpose. With P the functions at the vertices
// and A the matrix without vertex energies and pairs (coarse_matrix.h),
//
//     (A + P' H P) a = P' g,        x <- x - s P a,
//
// where s is the first of 1, 1/2, ... that lowers the potential enough and that nothing blocks, for each island of
// bodies. In double precision. The factors and solutions in between are those of torch.
//
// A Run makes the loops: run.each(n, f) calls f(i); run.lanes(n, f) calls f(i, lane), where lane.each(count, f) shares
// items that lane.meet() ends; run.teams(n, f) calls f(i, team).
#pragma once

#include "coarse.h"
#include "contact_rigid.h"
#include "contact_rigid_reverse.h"

#ifdef __CUDACC__
#define DIFFVBD_LAMBDA [=] __device__
#else
#define DIFFVBD_LAMBDA [=]
#endif

namespace diffvbd::contact {

using rigid::Body;

// The coarse functions of a Model, by vertex and by function (CoarseIndex in diffvbd/step/contact_coarse.py).
struct CoarseSpace {
  const int32_t *vertex_ptr, *function;  // [V + 1], [entries]  functions of a vertex
  const int32_t *function_ptr, *entry;   // [F + 1], [entries]  entries of a function
  const int32_t *vertex, *own;  // [entries], [F, 4]  mesh body, the first of its functions and their end, cells before
  const int32_t *body_ptr, *body_function;  // [bodies + 1], [F]  functions of a mesh body
  int32_t functions, cells;                 // cells: nine of them make the matrices of all bodies
};

template <class T>
struct CoarseInputs {
  RigidInputs<T> in;  // its bodies are all of the mesh
  CoarseSpace space;
  const T* weight;                 // [entries]
  const int64_t *tets, *star_ptr;  // [tets, 4], [V + 1]
  const int32_t* star;             // [4 tets]  4 tet + corner, by vertex
  int64_t num_tets;                // 0 where they have no energy
  Batched<const T> material[kMaterialScalars], rest;

  DIFFVBD_FN int64_t vertices() const { return in.scene.vertices; }
  DIFFVBD_FN int64_t scenes() const { return in.scene.scenes; }
  DIFFVBD_FN double h2() const { return in.scene.time_step * in.scene.time_step; }
  DIFFVBD_FN int64_t size() const { return int64_t{3} * space.functions; }
  DIFFVBD_FN Body<T> body_of(int64_t scene, int64_t v) const { return {in.scene, scene, in.gate.body[v]}; }
  // P a [F, 3] at a vertex
  DIFFVBD_FN Vector moved_by(const double* a, int64_t v) const {
    Vector sum{};
    for (int32_t e = space.vertex_ptr[v]; e < space.vertex_ptr[v + 1]; ++e) {
      sum += double(weight[e]) * wide_at(a + 3 * int64_t{space.function[e]});
    }
    return sum;
  }
  // The tets of a vertex: calls f(tet, corner).
  template <class F>
  DIFFVBD_FN void each_tet(int64_t v, const F& f) const {
    if (num_tets == 0) return;
    for (int64_t e = star_ptr[v]; e < star_ptr[v + 1]; ++e) f(int64_t{star[e] >> 2}, star[e] & 3);
  }
  DIFFVBD_FN void scalars_of(int64_t scene, int64_t tet, double* own_material, double* own_rest) const {
    for (int m = 0; m < kMaterialScalars; ++m) {
      own_material[m] = material[m].data[scene * material[m].scene + tet * material[m].item];
    }
    for (int i = 0; i < kRestScalars; ++i) own_rest[i] = rest.data[scene * rest.scene + kRestScalars * tet + i];
  }
  // A tet as one of its corners sees it; at(v): positions.
  template <class At>
  DIFFVBD_FN TetPair<double> pair_of(int64_t scene, int64_t tet, int corner, const At& at) const {
    double own_material[kMaterialScalars], own_rest[kRestScalars];
    scalars_of(scene, tet, own_material, own_rest);
    const auto other = [&](int i) { return at(tets[4 * tet + other_corner(corner, i)]); };
    TetPair<double> out{other(0), other(1), other(2), {}, {}};
    for (int i = 0; i < kPairRest; ++i) out.rest[i] = own_rest[TetLayout::rest_index(corner, i)];
    for (int m = 0; m < kMaterialScalars; ++m) out.material[m] = own_material[m];
    return out;
  }
};

// --- gradient and matrix

// A pair's gradient by the motion of its weighted corners, its derivative, and its weight's part at the corners.
struct CornerForce {
  Vector force;
  Sym3<double> stiffness;
  double w[4];
  Vector pull[4];
};

// Rows of listed pairs, and then of lagged ones. forces are written where `acts`.
struct SystemMemory {
  int64_t listed, lagged;
  uint8_t* acts;             // [rows]
  CornerForce* forces;       // [rows]
  double *gradient, *block;  // [B, V, 3], [B, V, 6]  the blocks without inertia
  int32_t *acting, *count;   // [4 rows], [B, V, 2]  entries of a vertex that act, where those of the lists begin

  // take(pointer, items), for so many vertices of all scenes
  template <class Take>
  void parts(Take& take, int64_t vertices) {
    const int64_t rows = listed + lagged;
    take(forces, rows), take(gradient, 3 * vertices), take(block, 6 * vertices);
    take(acting, 4 * rows), take(count, 2 * vertices), take(acts, rows);
  }
};

template <class T>
DIFFVBD_FN bool force_of_listed(const RigidInputs<T>& in, int64_t pair, CornerForce& out) {
  PairForce known;
  const CornerPoints<T> at{in, false};
  if (pair >= in.first_listed(in.scene.scenes) || !barrier_force(in, pair, at, known)) return false;
  const int32_t* record = in.gate.listed.pairs + kPairRow * pair;
  const int64_t scene = record[5];
  Corners<double> c;
  const Vector origin = at(scene, record[0]);
  for (int k = 0; k < 4; ++k) c.x[k] = at(scene, record[k]) - origin;
  const double h2 = in.scene.time_step * in.scene.time_step, kappa = in.kappa.data[scene * in.kappa.scene];
  const ForceTerms<double> a =
      barrier_terms(record[4], c, PairConstants<T>(in.gate.constants + kConstants * pair), h2 * kappa);
  out.force = known.force, out.stiffness = known.stiffness;
  for (int k = 0; k < 4; ++k) out.w[k] = a.w[k], out.pull[k] = a.at_corner[k];
  return true;
}
template <class T>
DIFFVBD_FN bool force_of_lagged(const RigidInputs<T>& in, int64_t pair, CornerForce& out) {
  PairForce a;
  if (pair >= in.first_lagged(in.scene.scenes)) return false;
  if (!lagged_force(in, pair, CornerPoints<T>{in, false}, a)) return false;
  const Lag<T> lag(in.lag + kLagScalars * pair);
  out.force = a.force, out.stiffness = a.stiffness;
  for (int k = 0; k < 4; ++k) out.w[k] = lag.w[k], out.pull[k] = Vector{};
  return true;
}

// Finds the entries of a vertex that act, and calls f(row, corner) for each.
template <class T, class F>
DIFFVBD_FN void find_acting(const RigidInputs<T>& in, const SystemMemory& m, int64_t scene, int64_t v, const F& f) {
  for (int list = 0; list < 2; ++list) {
    int32_t& found = m.count[2 * (scene * in.gate.vertices + v) + list];
    found = 0;
    if ((list == 0 ? m.listed : m.lagged) == 0) continue;
    const PairList& pairs = list == 0 ? in.gate.listed : in.lagged;
    const int64_t corner = scene * in.gate.corners + v, first = list == 0 ? 0 : m.listed;
    for (int32_t e = pairs.ptr[corner]; e < pairs.ptr[corner + 1]; ++e) {
      const int32_t entry = pairs.entry[e];
      if (!m.acts[first + (entry >> 2)]) continue;
      m.acting[4 * first + pairs.ptr[corner] + found++] = entry;
      f(first + (entry >> 2), entry & 3);
    }
  }
}
// Calls f(force, corner, record) for those that were found.
template <class T, class F>
DIFFVBD_FN void each_acting(const RigidInputs<T>& in, const SystemMemory& m, int64_t scene, int64_t v, const F& f) {
  for (int list = 0; list < 2; ++list) {
    const PairList& pairs = list == 0 ? in.gate.listed : in.lagged;
    const int32_t count = m.count[2 * (scene * in.gate.vertices + v) + list];
    const int64_t first = list == 0 ? 0 : m.listed;
    for (int32_t i = 0; i < count; ++i) {
      const int32_t entry = m.acting[4 * first + pairs.ptr[scene * in.gate.corners + v] + i], pair = entry >> 2;
      f(m.forces[first + pair], entry & 3, pairs.pairs + kPairRow * int64_t{pair});
    }
  }
}

// Energies of a vertex and its friction on planes: gradient and block, which are added to.
template <class T>
DIFFVBD_FN void add_vertex_energies(const CoarseInputs<T>& c, const Body<T>& b, int32_t v, Vector& g, Sym3<double>& H) {
  const VertexState<double> s = b.state(v, b.position(v));
  b.energies(v,
             [&](auto energy, int, const double* data, int count) { decltype(energy)::block(s, data, count, g, H); });
  add_floor_friction(c.in, b, v, g, H);
}

template <class T>
DIFFVBD_FN Vector elastic_gradient(const CoarseInputs<T>& c, const Body<T>& b, int64_t v) {
  Vector g{};
  const Vector x = b.position(v);
  c.each_tet(v, [&](int64_t tet, int corner) {
    const auto pair = c.pair_of(b.scene, tet, corner, [&](int64_t u) { return b.position(u); });
    double diagonal = 0;
    Sym3<double> outer{};
    TetLaw::block(pair, x, g, diagonal, outer);
  });
  return g;
}

// r = P' g [B, F, 3] and the matrix [B, 3F, 3F], from the matrices of all bodies [1 | B, 9 cells].
template <class T, class Run>
void coarse_system(const Run& run, const CoarseInputs<T>& c, const Batched<const T>& packed, const SystemMemory& m,
                   double* r, double* matrix) {
  const int64_t V = c.vertices(), F = c.space.functions, n = c.size();
  run.each(
      m.listed + m.lagged, DIFFVBD_LAMBDA(int64_t row) {
        m.acts[row] = row < m.listed ? force_of_listed(c.in, row, m.forces[row])
                                     : force_of_lagged(c.in, row - m.listed, m.forces[row]);
      });
  run.each(
      c.scenes() * V, DIFFVBD_LAMBDA(int64_t item) {
        const int64_t scene = item / V, v = item % V;
        const Body<T> b = c.body_of(scene, v);
        Vector g = b.mass(v) * (b.position(v) - b.target(v)) + c.h2() * elastic_gradient(c, b, v);
        Sym3<double> H{};
        if (!c.in.gate.pinned[v]) add_vertex_energies(c, b, v, g, H);
        find_acting(c.in, m, scene, v,
                    [&](int64_t row, int k) { g += m.forces[row].w[k] * m.forces[row].force + m.forces[row].pull[k]; });
        put(m.gradient + 3 * item, c.in.gate.pinned[v] ? Vector{} : g);
        const double entries[] = {H.xx, H.xy, H.xz, H.yy, H.yz, H.zz};
        for (int i = 0; i < 6; ++i) m.block[6 * item + i] = entries[i];
      });
  run.lanes(
      c.scenes() * F, DIFFVBD_LAMBDA(int64_t item, const typename Run::Lane& lane) {
        const int64_t scene = item / F, f = item % F;
        const CoarseSpace& space = c.space;
        double* const to = matrix + (scene * n + 3 * f) * n;
        const int32_t* own = space.own + 4 * f;
        const int64_t width = 3 * (own[2] - own[1]);
        for (int i = 0; i < 3; ++i) {
          const T* from = packed.data + scene * packed.scene + 9 * int64_t{own[3]} + (3 * (f - own[1]) + i) * width;
          lane.each(n, [&](int64_t j) {
            const int64_t k = j - 3 * own[1];
            to[i * n + j] = 0 <= k && k < width ? double(from[k]) : 0.0;
          });
        }
        lane.meet();
        // adds weight H at the functions of a vertex
        const auto add = [&](int64_t u, double weight, const Sym3<double>& H) {
          const double rows[3][3] = {{H.xx, H.xy, H.xz}, {H.xy, H.yy, H.yz}, {H.xz, H.yz, H.zz}};
          const int32_t first = space.vertex_ptr[u];
          lane.each(space.vertex_ptr[u + 1] - first, [&](int64_t e) {
            double* block = to + 3 * int64_t{space.function[first + e]};
            const double part = weight * double(c.weight[first + e]);
            for (int i = 0; i < 3; ++i) {
              for (int j = 0; j < 3; ++j) block[i * n + j] += part * rows[i][j];
            }
          });
          lane.meet();
        };
        Vector sum{};
        for (int32_t e = space.function_ptr[f]; e < space.function_ptr[f + 1]; ++e) {
          const int64_t v = space.vertex[space.entry[e]], at = scene * V + v;
          const double weight = c.weight[space.entry[e]];
          sum += weight * wide_at(m.gradient + 3 * at);
          const double* b = m.block + 6 * at;
          const Sym3<double> H{b[0], b[1], b[2], b[3], b[4], b[5]};
          if (b[0] != 0 || b[3] != 0 || b[5] != 0) add(v, weight, H);
          each_acting(c.in, m, scene, v, [&](const CornerForce& a, int k, const int32_t* record) {
            for (int j = 0; a.w[k] != 0 && j < 4; ++j) {
              if (record[j] < V) add(record[j], weight * a.w[k] * a.w[j], a.stiffness);
            }
          });
        }
        if (lane.leads()) put(r + 3 * item, sum);
      });
}

// --- the length of the step

// Memory of the trials: of vertices, of bodies and of pairs.
template <class T>
struct TrialMemory {
  int64_t listed, lagged;
  T* move;                              // [B, V, 3], that of the inputs
  double* fraction;                     // [B, bodies]
  double *displacement, *coefficients;  // [B, V, 3], [B, V, kDegree]  -P a; of the change of tets and inertia
  double *own, *size;                   // [B, V]  change of the energies of a vertex, and the sizes of their terms
  double *before, *after;               // [rows]  potentials of pairs
  double *body, *change;                // [B, bodies, kDegree + 1], [B, bodies, 2]  summed; the last one is the slope
  int32_t* lead;                        // [B, bodies]  the first body of the island of each
  uint8_t* decided;                     // [B, bodies]
  AdvanceState<T> state;
  Motion<T>* motions;  // [B, V], that of `state`

  // take(pointer, items), for so many scenes, and vertices and bodies of all of them
  template <class Take>
  void parts(Take& take, int64_t scenes, int64_t vertices, int64_t units) {
    take(displacement, 3 * vertices), take(coefficients, coarse::kDegree * vertices);
    take(own, vertices), take(size, vertices), take(before, listed + lagged), take(after, listed + lagged);
    take(body, (coarse::kDegree + 1) * units), take(change, 2 * units), take(motions, vertices), take(lead, units);
    take(state.fraction, units), take(state.now, units), take(state.blocked, units), take(state.stamp, units);
    take(state.failed, scenes), take(decided, units);
  }
};

// The sides of a listed pair that may act within the trust regions, or of an active lagged one, are of one island.
template <class Run, class T>
DIFFVBD_FN void join(const RigidInputs<T>& in, int32_t* lead, int64_t pair, bool listed) {
  const int32_t* record = (listed ? in.gate.listed.pairs : in.lagged.pairs) + kPairRow * pair;
  if (listed && PairHints<T>(in.gate.constants + kConstants * pair).gap == std::numeric_limits<double>::infinity())
    return;
  if (!listed && !Lag<T>(in.lag + kLagScalars * pair).active()) return;
  const int32_t a = moving_body(in, record[0]), b = moving_body(in, record[sides(record[4])]);
  if (0 <= a && 0 <= b && a != b) Run::unite(lead, a, b);
}

template <class T>
DIFFVBD_FN double value_of_pair(const RigidInputs<T>& in, int64_t pair, bool listed, bool moved) {
  const CornerPoints<T> at{in, moved};
  PairForce a;
  const bool acts = listed ? barrier_force(in, pair, at, a) : lagged_force(in, pair, at, a);
  return acts ? a.value : 0;
}

// The part of a vertex of the change by the displacement, a polynomial in s: inertia, and the tets that it is first in.
template <class T>
DIFFVBD_FN void coefficients_of(const CoarseInputs<T>& c, int64_t scene, int64_t v, const double* displacement,
                                double* out) {
  const Body<T> b = c.body_of(scene, v);
  double sum[TetLayout::line_degree] = {};
  const auto move = [&](int64_t u) { return wide_at(displacement + 3 * (scene * c.vertices() + u)); };
  c.each_tet(v, [&](int64_t tet, int corner) {
    if (corner != 0) return;
    double material[kMaterialScalars], rest[kRestScalars];
    c.scalars_of(scene, tet, material, rest);
    Vector at[4], to[4];
    for (int k = 0; k < 4; ++k) at[k] = b.position(c.tets[4 * tet + k]), to[k] = move(c.tets[4 * tet + k]);
    TetLaw::line(at, to, rest, material, sum);
  });
  const Vector d = move(v);
  for (int i = 0; i < coarse::kDegree; ++i) out[i] = c.h2() * sum[i];
  out[0] += b.mass(v) * dot(b.position(v) - b.target(v), d);
  out[1] += 0.5 * b.mass(v) * dot(d, d);
}

// x_end [B, V, 3] after the fraction of -P a that each island takes; a solves for r [B, F, 3]. info [B]: not 0 where
// the matrix was not positive definite.
template <class T, class Run>
void coarse_move(const Run& run, const CoarseInputs<T>& c, const double* a, const double* r, const int32_t* info,
                 const TrialMemory<T>& m, T* x_end) {
  const int64_t V = c.vertices(), n = c.in.bodies(), F = c.space.functions, rows = m.listed + m.lagged;
  using Team = typename Run::Team;
  constexpr int kSums = coarse::kDegree + 1;
  AdvanceState<T> state = m.state;
  state.motion = m.motions, state.first = false;
  run.each(
      c.scenes() * n, DIFFVBD_LAMBDA(int64_t unit) {
        m.lead[unit] = static_cast<int32_t>(unit % n);
        m.fraction[unit] = 0, m.decided[unit] = info[unit / n] != 0;
        state.fraction[unit] = T(0), state.now[unit] = T(1), state.blocked[unit] = state.stamp[unit] = 0;
      });
  run.each(
      c.scenes() * V,
      DIFFVBD_LAMBDA(int64_t item) { put(m.displacement + 3 * item, -c.moved_by(a + item / V * 3 * F, item % V)); });
  run.each(
      c.scenes() * V, DIFFVBD_LAMBDA(int64_t item) {
        coefficients_of(c, item / V, item % V, m.displacement, m.coefficients + item * coarse::kDegree);
      });
  run.teams(
      c.scenes(), DIFFVBD_LAMBDA(int64_t scene, const Team& team) {
        for (int list = 0; list < 2; ++list) {
          const bool listed = list == 0;
          const int64_t first = listed ? c.in.first_listed(scene) : c.in.first_lagged(scene),
                        end = listed ? c.in.first_listed(scene + 1) : c.in.first_lagged(scene + 1);
          team.each(static_cast<int32_t>(end - first),
                    [&](int32_t i) { join<Run>(c.in, m.lead + scene * n, first + i, listed); });
        }
      });
  run.each(
      rows, DIFFVBD_LAMBDA(int64_t row) {
        const bool listed = row < m.listed;
        const int64_t pair = listed ? row : row - m.listed;
        if (pair < (listed ? c.in.first_listed(c.scenes()) : c.in.first_lagged(c.scenes()))) {
          m.before[row] = value_of_pair(c.in, pair, listed, false);
        }
      });
  run.teams(
      c.scenes() * n, DIFFVBD_LAMBDA(int64_t unit, const Team& team) {
        const int64_t scene = unit / n;
        const Body<T> b{c.in.scene, scene, static_cast<int32_t>(unit % n)};
        double sum[kSums], slope[1];
        team.template sum<kSums>(b.size(), sum, [&](int32_t i, double* to) {
          const double* own = m.coefficients + (scene * V + b.vertex(i)) * coarse::kDegree;
          for (int k = 0; k < coarse::kDegree; ++k) to[k] += own[k];
        });
        const int32_t first = c.space.body_ptr[b.body], count = c.space.body_ptr[b.body + 1] - first;
        team.template sum<1>(count, slope, [&](int32_t i, double* to) {
          const int64_t at = 3 * (scene * F + c.space.body_function[first + i]);
          to[0] -= dot(wide_at(a + at), wide_at(r + at));
        });
        if (!team.leads()) return;
        m.lead[unit] = Run::root_of(m.lead + scene * n, b.body);
        for (int k = 0; k < coarse::kDegree; ++k) m.body[unit * kSums + k] = sum[k];
        m.body[unit * kSums + coarse::kDegree] = slope[0];
      });
  for (int trial = 0; trial < kFractions; ++trial) {
    const double s = fraction_of(trial);
    run.each(
        c.scenes() * V, DIFFVBD_LAMBDA(int64_t item) {
          const int64_t scene = item / V;
          const auto v = static_cast<int32_t>(item % V);
          const Body<T> b = c.body_of(scene, v);
          const int64_t unit = scene * n + b.body;
          if (m.decided[unit]) return;
          const Vector d = s * wide_at(m.displacement + 3 * item);
          put(m.move + 3 * item, d);
          m.motions[item] = motion_of(c.in.gate, state, scene, v);
          m.own[item] = m.size[item] = 0;
          if (c.in.gate.pinned[v]) return;
          m.own[item] = change_of_vertex(c.in, b, v, d, m.size[item]);
          stay(c.in.gate, state, scene, v, 0);
        });
    run.each(
        rows, DIFFVBD_LAMBDA(int64_t row) {
          const bool listed = row < m.listed;
          const int64_t pair = listed ? row : row - m.listed;
          if (pair >= (listed ? c.in.first_listed(c.scenes()) : c.in.first_lagged(c.scenes()))) return;
          const int32_t* record = (listed ? c.in.gate.listed.pairs : c.in.lagged.pairs) + kPairRow * pair;
          const int32_t owner = owner_of(c.in, record);
          if (owner < 0 || m.decided[record[5] * n + owner]) return;
          m.after[row] = value_of_pair(c.in, pair, listed, true);
          if (listed) test_pair(c.in.gate, state, pair, 0);
        });
    run.teams(
        c.scenes() * n, DIFFVBD_LAMBDA(int64_t unit, const Team& team) {
          if (m.decided[unit]) return;
          const int64_t scene = unit / n;
          const Body<T> b{c.in.scene, scene, static_cast<int32_t>(unit % n)};
          double sum[2];
          team.template sum<2>(b.size(), sum, [&](int32_t i, double* to) {
            const int32_t v = b.vertex(i);
            to[0] += m.own[scene * V + v], to[1] += m.size[scene * V + v];
            // the pairs that it is the first vertex of
            const auto add = [&](const PairList& list, int64_t first) {
              const PairList::Entries all = list.of(scene * c.in.gate.corners + v);
              for (int e = 0; e < all.count; ++e) {
                const int64_t pair = all.first[e] >> 2, row = first + pair;
                const int32_t* record = list.pairs + kPairRow * pair;
                const int at = all.first[e] & 3;
                if (at != (0 <= moving_body(c.in, record[0]) ? 0 : sides(record[4]))) continue;
                to[0] += m.after[row] - m.before[row], to[1] += absolute(m.after[row]) + absolute(m.before[row]);
              }
            };
            if (m.listed > 0) add(c.in.gate.listed, 0);
            if (m.lagged > 0) add(c.in.lagged, m.listed);
          });
          if (team.leads()) m.change[2 * unit] = sum[0], m.change[2 * unit + 1] = sum[1];
        });
    run.each(
        c.scenes() * n, DIFFVBD_LAMBDA(int64_t unit) {
          const int64_t first = unit / n * n;
          if (m.decided[unit] || m.lead[unit] != unit - first) return;
          double increase = 0, size = 0, slope = 0;
          bool fits = true;
          for (int64_t k = first; k < first + n; ++k) {
            if (m.lead[k] != unit - first) continue;
            coarse::Change change;
            for (int i = 0; i < coarse::kDegree; ++i) change.c[i] = m.body[k * kSums + i];
            increase += change.at(s) + m.change[2 * k], size += change.size(s) + m.change[2 * k + 1];
            slope += m.body[k * kSums + coarse::kDegree];
            fits = fits && !state.blocked[k];
            state.blocked[k] = 0;
          }
          const double slack = kRounding * double(std::numeric_limits<T>::epsilon()) * size;
          const bool good = fits && slope <= 0 && increase <= coarse::kDecrease * s * slope + slack;
          for (int64_t k = first; (good || !(slope <= 0)) && k < first + n; ++k) {
            if (m.lead[k] == unit - first) m.fraction[k] = good ? s : 0, m.decided[k] = 1;
          }
        });
    if (run.is_done(m.decided, c.scenes() * n)) break;
  }
  run.each(
      c.scenes() * V, DIFFVBD_LAMBDA(int64_t item) {
        const int64_t scene = item / V, v = item % V;
        const double s = m.fraction[scene * n + c.in.gate.body[v]];
        const Vector x = c.body_of(scene, v).position(v);
        if (s > 0) {  // a displacement that was refused may be no number
          put(x_end + 3 * item, x + s * wide_at(m.displacement + 3 * item));
        } else {
          put(x_end + 3 * item, x);
        }
      });
}

// --- the transpose. With l the solution for P' (adjoint of the displacement -P a), everything that g and H read gets
// the adjoint of -W, where W = p . (g + H q), p = P l and q = -P a; and A that of l a'.

// P' of the adjoint of the displacement [B, F, 3]. fraction [B, bodies].
template <class T, class Run>
void coarse_restrict(const Run& run, const CoarseInputs<T>& c, const T* x_bar, const double* fraction, double* to) {
  const int64_t V = c.vertices(), F = c.space.functions, n = c.in.bodies();
  run.each(
      c.scenes() * F, DIFFVBD_LAMBDA(int64_t item) {
        const int64_t scene = item / F, f = item % F;
        const double s = fraction[scene * n + c.space.own[4 * f]];
        Vector sum{};
        for (int32_t e = c.space.function_ptr[f]; s > 0 && e < c.space.function_ptr[f + 1]; ++e) {
          const int32_t entry = c.space.entry[e];
          sum += double(c.weight[entry]) * wide_at(x_bar + 3 * (scene * V + c.space.vertex[entry]));
        }
        put(to + 3 * item, s * sum);
      });
}

// p and q of all corner points [B, N, 3].
template <class T, class Run>
void coarse_motions(const Run& run, const CoarseInputs<T>& c, const double* a, const double* l, const double* fraction,
                    T* p, T* q) {
  const int64_t N = c.in.gate.corners, F = c.space.functions, n = c.in.bodies();
  run.each(
      c.scenes() * N, DIFFVBD_LAMBDA(int64_t item) {
        const int64_t scene = item / N, v = item % N;
        const bool moves = v < c.vertices() && fraction[scene * n + c.in.gate.body[v]] > 0;
        put(p + 3 * item, moves ? c.moved_by(l + scene * 3 * F, v) : Vector{});
        put(q + 3 * item, moves ? -c.moved_by(a + scene * 3 * F, v) : Vector{});
      });
}

// Adjoints beyond those of the rigid correction: of the tets' material and rest shape, or null, and of A.
template <class T>
struct CoarseAdjoints {
  CorrectionAdjoints<T> bars;   // all are written
  T *material, *rest, *packed;  // [B, tets, 2], [B, tets, 7], [B, 9 cells]
};

// The adjoint of -W seen from a vertex, without pairs and tets.
template <class T>
DIFFVBD_FN VertexAdjoint coarse_vertex_adjoint(const RigidInputs<T>& in, const Body<T>& b, int32_t v, const Vector& P,
                                               const Vector& Q, T* floor_lag) {
  const double mass = b.mass(v), h = in.scene.time_step;
  const Vector x = b.position(v);
  const VertexState<double> s = b.state(v, x);
  VertexAdjoint out{-mass * P, Vector{}, mass * P, Vector{}, -dot(P, x - b.target(v))};
  b.energies(v, [&](auto energy, int, const double* data, int count) {
    vertex_energy_vjp<decltype(energy)>(s, data, count, P, Q, out.x, out.x_prev);
  });
  add_friction_adjoint(in, b, v, x - s.x_prev, P, Q, h * h, floor_lag, out);
  return out;
}

// scattered: the adjoints of pairs at corner points. x_bar [B, V, 3]: of the end.
template <class T, class Run>
void coarse_reverse(const Run& run, const CoarseInputs<T>& c, const double* a, const double* l, const double* fraction,
                    const T* x_bar, const VirtualMotions<T>& given, const PointWork<T>& scattered,
                    const CoarseAdjoints<T>& out) {
  const int64_t V = c.vertices(), N = c.in.gate.corners, n = c.in.bodies();
  const double minus_h2 = -c.h2();
  run.each(
      c.scenes() * V, DIFFVBD_LAMBDA(int64_t item) {
        const int64_t scene = item / V, corner = 3 * (scene * N + item % V);
        const auto v = static_cast<int32_t>(item % V);
        const Body<T> b = c.body_of(scene, v);
        const rigid::Adjoints<T>& to = out.bars.vertices;
        Vector x = wide_at(x_bar + 3 * item) - wide_at(scattered.x + corner),
               x_prev = scattered.since ? wide_at(scattered.since + corner) : Vector{};
        VertexAdjoint bar{};
        if (fraction[scene * n + b.body] > 0) {
          const auto p_of = [&](int64_t u) { return wide_at(given.p + 3 * (scene * N + u)); };
          const Vector at = b.position(v), P = p_of(v);
          c.each_tet(v, [&](int64_t tet, int local) {
            const auto pair = c.pair_of(scene, tet, local, [&](int64_t u) { return b.position(u); });
            const auto view = TetLaw::view(pair, at, Vector{}, P);
            const auto other = [&](int i) { return p_of(c.tets[4 * tet + other_corner(local, i)]); };
            x += minus_h2 * TetLaw::product(pair, view, P, other(0), other(1), other(2));
          });
          if (!c.in.gate.pinned[v]) {
            bar = coarse_vertex_adjoint(
                c.in, b, v, P, wide_at(given.q + corner),
                out.bars.floor_lag ? out.bars.floor_lag + item * c.in.planes * kFloorLag : nullptr);
          }
        }
        put(to.x + 3 * item, x + bar.x), put(to.y + 3 * item, bar.y), put(to.x_prev + 3 * item, x_prev + bar.x_prev);
        to.mass[item] = T(bar.mass);
      });
  if (out.material || out.rest) {
    run.each(
        c.scenes() * c.num_tets, DIFFVBD_LAMBDA(int64_t item) {
          const int64_t scene = item / c.num_tets, tet = item % c.num_tets;
          const Body<T> b = c.body_of(scene, c.tets[4 * tet]);
          double material[kMaterialScalars] = {}, rest[kRestScalars] = {};
          for (int local = 0; local < 4; ++local) {
            const int64_t v = c.tets[4 * tet + local];
            const Vector P = wide_at(given.p + 3 * (scene * N + v));
            const auto pair = c.pair_of(scene, tet, local, [&](int64_t u) { return b.position(u); });
            const auto view = TetLaw::view(pair, b.position(v), Vector{}, P);
            double own_material[kMaterialScalars], own_rest[kPairRest];
            TetLaw::material_vjp(pair, view, Vector{}, P, minus_h2, own_material);
            TetLaw::rest_vjp(pair, view, Vector{}, P, minus_h2, own_rest);
            for (int k = 0; k < kMaterialScalars; ++k) material[k] += own_material[k];
            for (int k = 0; k < kPairRest; ++k) rest[TetLayout::rest_index(local, k)] += own_rest[k];
          }
          for (int k = 0; out.material && k < kMaterialScalars; ++k)
            out.material[kMaterialScalars * item + k] = T(material[k]);
          for (int k = 0; out.rest && k < kRestScalars; ++k) out.rest[kRestScalars * item + k] = T(rest[k]);
        });
  }
  if (out.packed) {
    const int64_t F = c.space.functions;
    run.lanes(
        c.scenes() * F, DIFFVBD_LAMBDA(int64_t item, const typename Run::Lane& lane) {
          const int64_t scene = item / F, f = item % F;
          const int32_t* own = c.space.own + 4 * f;
          const int64_t width = 3 * (own[2] - own[1]), first = 3 * (scene * F + own[1]);
          const bool moves = fraction[scene * n + own[0]] > 0;
          for (int i = 0; i < 3; ++i) {
            T* to = out.packed + scene * 9 * c.space.cells + 9 * int64_t{own[3]} + (3 * (f - own[1]) + i) * width;
            lane.each(width, [&](int64_t j) { to[j] = moves ? T(l[3 * item + i] * a[first + j]) : T(0); });
          }
        });
  }
  if (out.bars.vertices.shared || out.bars.vertices.own) {
    run.teams(
        c.scenes() * n, DIFFVBD_LAMBDA(int64_t unit, const typename Run::Team& team) {
          const Body<T> b{c.in.scene, unit / n, static_cast<int32_t>(unit % n)};
          if (!(fraction[unit] > 0)) return;
          rigid::reverse_data(b, team, out.bars.vertices, [&](int32_t v) {
            const int64_t corner = 3 * (b.scene * N + v);
            return rigid::VertexMotions{b.position(v), wide_at(given.p + corner), wide_at(given.q + corner)};
          });
        });
  }
  const int64_t colliders = N - V;
  run.each(
      c.scenes() * colliders, DIFFVBD_LAMBDA(int64_t item) {
        reverse_collider(c.in, item / colliders, static_cast<int32_t>(item % colliders), scattered, out.bars);
      });
}

}  // namespace diffvbd::contact
