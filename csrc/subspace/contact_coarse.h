// The coarse correction of bodies that touch (docs/method.md, section 16): one Newton step of the incremental potential
// in the coarse functions of all bodies of a scene together, and its transpose. With P the functions at the vertices
// and A the matrix without vertex energies and pairs (coarse_matrix.h),
//
//     (A + P' H P) a = P' g,        x <- x - s P a,
//
// where s is the first of 1, 1/2, ... that lowers the potential enough and that nothing blocks, for each island of
// bodies. In double precision. The factors and solutions in between are those of torch.
//
// A Run makes the loops, those of trials.h and more: run.each(n, f) calls f(i); run.lanes(n, f) calls f(i, lane), where
// lane.each(count, f) shares items that lane.meet() ends; run.teams(n, f) calls f(i, team).
#pragma once

#include "contact_rigid_reverse.h"
#include "trials.h"

#ifdef __CUDACC__
#define DIFFVBD_LAMBDA [=] __device__
#else
#define DIFFVBD_LAMBDA [=]
#endif

namespace diffvbd::contact {

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

// Memory of the system. forces are written where `acts`.
struct SystemMemory {
  uint8_t* acts;             // [rows]
  CornerForce* forces;       // [rows]
  double *gradient, *block;  // [B, V, 3], [B, V, 6]  the blocks without inertia

  // take(pointer, items), for so many rows, and vertices of all scenes
  template <class Take>
  void parts(Take& take, int64_t rows, int64_t vertices) {
    take(forces, rows), take(gradient, 3 * vertices), take(block, 6 * vertices), take(acts, rows);
  }
};

template <class T>
DIFFVBD_FN bool force_at_corners(const Rows<T>& s, int64_t row, CornerForce& out) {
  const RigidInputs<T>& in = s.in;
  const CornerPoints<T> at{in, false};
  PairForce known;
  if (!s.exists(row) || !s.force(row, at, known)) return false;
  out.force = known.force, out.stiffness = known.stiffness;
  const int64_t pair = s.pair_of(row);
  if (!s.is_listed(row)) {
    const Lag<T> lag(in.lag + kLagScalars * pair);
    for (int k = 0; k < 4; ++k) out.w[k] = lag.w[k], out.pull[k] = Vector{};
    return true;
  }
  const int32_t* record = s.record(row);
  const int64_t scene = record[5];
  Corners<double> c;
  const Vector origin = at(scene, record[0]);
  for (int k = 0; k < 4; ++k) c.x[k] = at(scene, record[k]) - origin;
  const double h2 = in.scene.time_step * in.scene.time_step, kappa = in.kappa.data[scene * in.kappa.scene];
  const ForceTerms<double> a =
      barrier_terms(record[4], c, PairConstants<T>(in.gate.constants + kConstants * pair), h2 * kappa);
  for (int k = 0; k < 4; ++k) out.w[k] = a.w[k], out.pull[k] = a.at_corner[k];
  return true;
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
void coarse_system(const Run& run, const CoarseInputs<T>& c, const Batched<const T>& packed, const RowMemory& all,
                   const SystemMemory& m, double* r, double* matrix) {
  const int64_t V = c.vertices(), F = c.space.functions, n = c.size();
  const Rows<T> rows{c.in, all};
  run.each(all.rows(), DIFFVBD_LAMBDA(int64_t row) { m.acts[row] = force_at_corners(rows, row, m.forces[row]); });
  run.each(
      c.scenes() * V, DIFFVBD_LAMBDA(int64_t item) {
        const int64_t scene = item / V, v = item % V;
        const Body<T> b = c.body_of(scene, v);
        Vector g = b.mass(v) * (b.position(v) - b.target(v)) + c.h2() * elastic_gradient(c, b, v);
        Sym3<double> H{};
        if (!c.in.gate.pinned[v]) add_vertex_energies(c, b, v, g, H);
        rows.list(scene, v, [&](int64_t row, int k) {
          const CornerForce& a = m.forces[row];
          if (m.acts[row]) g += a.w[k] * a.force + a.pull[k];
          return m.acts[row];
        });
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
          rows.each_listed(scene, v, [&](int64_t row, int k) {
            const CornerForce& a = m.forces[row];
            const int32_t* record = rows.record(row);
            for (int j = 0; a.w[k] != 0 && j < 4; ++j) {
              if (record[j] < V) add(record[j], weight * a.w[k] * a.w[j], a.stiffness);
            }
          });
        }
        if (lane.leads()) put(r + 3 * item, sum);
      });
}

// --- the length of the step

// Memory of the length of the step beyond that of its trials.
struct CoarseMemory {
  double *displacement, *coefficients;  // [B, V, 3], [B, V, kDegree]  -P a; of the change of tets
  double* slope;                        // [B, bodies]  of the potential

  // take(pointer, items), for so many vertices and bodies of all scenes
  template <class Take>
  void parts(Take& take, int64_t vertices, int64_t units) {
    take(displacement, 3 * vertices), take(coefficients, coarse::kDegree * vertices), take(slope, units);
  }
};

// The part of a vertex of the change by the displacement, a polynomial in s: the tets that it is first in.
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
  for (int i = 0; i < coarse::kDegree; ++i) out[i] = c.h2() * sum[i];
}

template <class T>
struct CoarseStep : TrialStep<T> {
  CoarseInputs<T> c;
  CoarseMemory own;
  const double *a, *r;  // [B, F, 3]
  const int32_t* info;  // [B]

  DIFFVBD_FN Vector displacement(const Body<T>& b, int32_t v, double fraction) const {
    return fraction * wide_at(own.displacement + 3 * b.row(v));
  }
  DIFFVBD_FN double smooth_change(const Body<T>& b, int32_t v, double fraction, double& size) const {
    coarse::Change change{};
    for (int k = 0; k < coarse::kDegree; ++k) change.c[k] = own.coefficients[coarse::kDegree * b.row(v) + k];
    size += change.size(fraction);
    return change.at(fraction);
  }
  DIFFVBD_FN double length(const Body<T>& b, int32_t v) const {
    const Vector d = displacement(b, v, 1);
    return square_root(dot(d, d));
  }
  DIFFVBD_FN double slope(int64_t unit) const { return own.slope[unit]; }
  DIFFVBD_FN bool moves(int64_t unit) const { return this->fraction[unit] > 0; }
};

struct BeginTrials {  // each scene
  template <class T>
  DIFFVBD_FN void operator()(const CoarseStep<T>& s, int64_t scene, int64_t) const {
    s.m.active[scene] = s.info[scene] == 0;
  }
};
struct Displace {  // each vertex
  template <class T>
  DIFFVBD_FN void operator()(const CoarseStep<T>& s, int64_t scene, int64_t v) const {
    const double* a = s.a + scene * s.c.size();
    put(s.own.displacement + 3 * (scene * s.c.vertices() + v), -s.c.moved_by(a, v));
  }
};
struct FindCoefficients {  // each vertex
  template <class T>
  DIFFVBD_FN void operator()(const CoarseStep<T>& s, int64_t scene, int64_t v) const {
    double* to = s.own.coefficients + coarse::kDegree * (scene * s.c.vertices() + v);
    coefficients_of(s.c, scene, v, s.own.displacement, to);
  }
};
struct FindSlope {  // bodies
  template <class T, class Team>
  DIFFVBD_FN void operator()(const CoarseStep<T>& s, const Body<T>& b, const Team& team) const {
    const CoarseSpace& space = s.c.space;
    const int32_t first = space.body_ptr[b.body], count = space.body_ptr[b.body + 1] - first;
    double sum[1];
    team.template sum<1>(count, sum, [&](int32_t i, double* to) {
      const int64_t at = b.scene * s.c.size() + 3 * space.body_function[first + i];
      to[0] -= dot(wide_at(s.a + at), wide_at(s.r + at));
    });
    if (team.leads()) s.own.slope[s.unit(b.scene, b.body)] = sum[0];
  }
};

// x_end after the fraction of -P a that each island takes; a solves for r. info: not 0 where the matrix was not
// positive definite.
template <class T, class Run>
void coarse_move(const Run& run, const CoarseStep<T>& s) {
  run.each(BeginTrials{}, s, 1);
  run.rows(FindForce{}, s);
  run.each(Displace{}, s, s.c.vertices());
  run.each(FindCoefficients{}, s, s.c.vertices());
  run.bodies(FindSlope{}, s);
  run.bodies(FindReach{}, s);
  find_islands(run, s);
  run.each(ListNear{}, s, s.c.vertices());
  for (int trial = 0; trial < kFractions; ++trial) {
    if (try_fraction(run, s, fraction_of(trial))) break;
  }
  run.each(EndVertex{}, s, s.c.vertices());
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
