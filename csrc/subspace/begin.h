// The begin of a step: the predictor y = x + h v + h^2 a, the start of the sweeps, and the adjoint. Corrected bodies
// are extrapolated, all vertices by one fraction of their displacements (sweep/extrapolation.h) that planes admit, and
// then corrected. Every other vertex, and in short steps those of a blocked body that is released, moves toward x + h v
// or y as far as planes admit (docs/method.md, sections 6 and 14).
#pragma once

#include "../energies/floor_start.h"
#include "../sweep/extrapolation.h"
#include "rigid.h"

namespace diffvbd::start {

// The start of bodies that are not corrected. kLower: for each body the one of lower potential.
enum From { kInertia = 0, kPredictor = 1, kLower = 2 };

using rigid::Body, rigid::kCorrected, rigid::Vector;

template <class T>
struct Inputs {
  rigid::Inputs<T> bodies;  // the corrected ones: x extrapolated, y the predictor
  Batched<const T> x, v, acceleration,
      prescribed;                 // [B, V, 3]; acceleration also [B, 1, 3] (item 0); prescribed may be null
  const bool* pinned;             // [V]
  const uint8_t* from_predictor;  // [B, others]  with kLower: whether a body starts from y
  const uint8_t* alone;           // [B, bodies]  corrected bodies that are released; null: none
  int32_t others;
  int from;
  bool some_alone;  // whether some vertices are in no corrected body
  bool filters;     // whether planes limit a start
  double lookback;  // lookback ratio (sweep/extrapolation.h)
  StepParameters<T> parameters;

  DIFFVBD_FN static Vec3<T> at(const Batched<const T>& a, int64_t scene, int32_t v) {
    return vector_at(a.data + scene * a.scene + 3 * a.item * v);
  }
  DIFFVBD_FN int64_t row(int64_t scene, int32_t v) const { return scene * bodies.vertices + v; }
  DIFFVBD_FN const T* planes(int64_t scene) const { return bodies.data.data + scene * bodies.data.scene; }
  DIFFVBD_FN int plane_scalars() const { return bodies.data_count[0]; }  // FloorBarrier is the first energy
  DIFFVBD_FN VertexState<T> state(int64_t scene, int32_t v, const Vec3<T>& x) const {
    return {x, x, bodies.origin.data ? at(bodies.origin, scene, v) : zero3<T>(), T(bodies.time_step)};
  }
  DIFFVBD_FN bool starts_from_y(int64_t scene, int32_t v) const {
    return from == kPredictor ||
           (from == kLower && bodies.other[v] >= 0 && from_predictor[scene * others + bodies.other[v]] != 0);
  }
};

// Positions before the step, after h v, and the predictor.
template <class T>
struct Motion {
  Vec3<T> x, inertial, y;
  DIFFVBD_FN Motion(const Inputs<T>& in, int64_t scene, int32_t v) : x(in.at(in.x, scene, v)) {
    const double h = in.bodies.time_step;
    if (in.pinned[v]) {
      inertial = y = in.prescribed.data ? in.at(in.prescribed, scene, v) : x;
    } else {
      inertial = x + T(h) * in.at(in.v, scene, v);
      y = inertial + T(h * h) * in.at(in.acceleration, scene, v);
    }
  }
};

// The position of a single vertex moved from x toward a goal.
template <class T>
DIFFVBD_FN Vec3<T> toward(const Inputs<T>& in, int64_t scene, int32_t v, const Vec3<T>& x, const Vec3<T>& goal) {
  if (!in.filters || in.pinned[v]) return goal;
  return x + FloorStart::moved(in.state(scene, v, x), in.planes(scene), in.plane_scalars(), goal - x, in.parameters);
}

// A vertex of a body that is not corrected. With kLower x_start is the start from x + h v, and `from_y` (null where
// that is y itself) the one from y.
template <class T>
DIFFVBD_FN void begin_vertex(const Inputs<T>& in, T* x_start, T* from_y, T* y, int64_t scene, int32_t v) {
  if (in.bodies.other[v] == kCorrected) return;
  const Motion<T> m(in, scene, v);
  const int64_t at = 3 * in.row(scene, v);
  put(y + at, m.y);
  put(x_start + at, toward(in, scene, v, m.x, in.from == kPredictor ? m.y : m.inertial));
  if (from_y) put(from_y + at, toward(in, scene, v, m.x, m.y));
}
template <class T>
DIFFVBD_FN void choose_vertex(const Inputs<T>& in, T* x_start, const T* from_y, int64_t scene, int32_t v) {
  if (in.bodies.other[v] < 0 || !in.starts_from_y(scene, v)) return;
  const int64_t at = 3 * in.row(scene, v);
  put(x_start + at, vector_at(from_y + at));
}

template <class T>
struct Adjoints {
  const T *x_start, *y;          // of the outputs [B, V, 3]
  T *x, *v;                      // [B, V, 3]
  T *acceleration, *prescribed;  // [B, V, 3], null where not wanted
  T *mass, *planes;              // [B, V]; [B, V, scalars of planes], zero at first, null where not wanted
  T *shared, *own, *x_prev;      // of a rigid correction's data, and scratch [B, V, 3]
  int32_t shared_count, own_count;
};

// A single vertex that moves to y or to x + h v.
template <class T>
DIFFVBD_FN void reverse_alone(const Inputs<T>& in, const Adjoints<T>& a, int64_t scene, int32_t v, bool from_y) {
  const int64_t row = in.row(scene, v);
  const auto store = [&](T* to, const Vec3<T>& value) {
    if (to) put(to + 3 * row, value);
  };
  const Vec3<T> start_bar = vector_at(a.x_start + 3 * row), y_bar = vector_at(a.y + 3 * row), none = zero3<T>();
  if (in.pinned[v]) {
    store(a.x, in.prescribed.data ? none : start_bar + y_bar);
    store(a.prescribed, start_bar + y_bar);
    store(a.v, none);
    store(a.acceleration, none);
    return;
  }
  const double h = in.bodies.time_step;
  Vec3<T> goal_bar = start_bar, x_bar = start_bar + y_bar;
  if (in.filters) {
    const Motion<T> m(in, scene, v);
    T* planes = a.planes ? a.planes + row * in.plane_scalars() : nullptr;
    FloorStart::moved_vjp(in.state(scene, v, m.x), in.planes(scene), in.plane_scalars(),
                          (from_y ? m.y : m.inertial) - m.x, in.parameters, goal_bar, x_bar, planes);
  }
  store(a.x, x_bar);
  store(a.prescribed, none);
  store(a.v, T(h) * (goal_bar + y_bar));
  store(a.acceleration, T(h * h) * (from_y ? goal_bar + y_bar : y_bar));
}
template <class T>
DIFFVBD_FN void reverse_vertex(const Inputs<T>& in, const Adjoints<T>& a, int64_t scene, int32_t v) {
  if (in.bodies.other[v] != kCorrected) reverse_alone(in, a, scene, v, in.starts_from_y(scene, v));
}

// A body by its state before the step and the displacements h v.
template <class T>
struct BeforeStep {
  const Inputs<T>& in;
  const Body<T>& b;
  DIFFVBD_FN int32_t size() const { return b.size(); }
  DIFFVBD_FN double mass(int32_t i) const { return b.mass(b.vertex(i)); }
  DIFFVBD_FN static Vector wide(const Vec3<T>& a) { return {double(a.x), double(a.y), double(a.z)}; }
  DIFFVBD_FN Vector position(int32_t i) const { return wide(in.at(in.x, b.scene, b.vertex(i))); }
  DIFFVBD_FN Vector displacement(int32_t i) const {
    return in.bodies.time_step * wide(in.at(in.v, b.scene, b.vertex(i)));
  }
};

// The fractions of the displacement of an extrapolated vertex that planes admit.
template <class T>
struct PlaneFractions {
  using Plane = FloorBarrier::Plane<double>;
  const Inputs<T>& in;
  const Body<T>& b;
  Vector x, step;
  double slack;  // rounding of a motion along a plane
  int32_t v;

  DIFFVBD_FN PlaneFractions(const BeforeStep<T>& body, const rigid::Extrapolation& extrapolation, int32_t i)
      : in(body.in), b(body.b), x(body.position(i)), step(extrapolation.displacement(body, i)), v(body.b.vertex(i)) {
    slack = 8 * double(std::numeric_limits<T>::epsilon()) * std::sqrt(dot(step, step));
  }
  // calls f(plane, its number, its fraction)
  template <class F>
  DIFFVBD_FN void each(F&& f) const {
    const VertexState<double> s = b.state(v, x);
    b.energies(v, [&](auto energy, int, const double* data, int count) {
      if constexpr (std::is_same_v<decltype(energy), FloorBarrier>) {
        for (int k = 0; k < count; k += FloorBarrier::stride) {
          const Plane plane(data + k, s);
          const double wide = plane.gap(x) - plane.dhat, closing = -dot(plane.n, step);
          const double allowance = wide > 0 ? double(in.parameters.filter_eta) * wide : 0;
          f(plane, k, closing > allowance + slack ? allowance / closing : 1.0);
        }
      }
    });
  }
  // the number of planes whose side is uncertain after a fraction of the step
  DIFFVBD_FN double lost(double fraction) const {
    const VertexState<double> s = b.state(v, x + fraction * step);
    double count = 0;
    each([&](const Plane& plane, int, double) {
      if (!(plane.template guard<T>(s) < plane.gap(s.x))) count += 1;
    });
    return count;
  }
};

// The fraction of the displacements of all vertices of a body; 0 where rounding would close a gap.
template <class T, class Team>
DIFFVBD_FN double fraction_of_body(const BeforeStep<T>& b, const rigid::Extrapolation& extrapolation,
                                   const Team& team) {
  const double fraction = team.least(b.size(), [&](int32_t i) {
    double least = 1;
    PlaneFractions<T>(b, extrapolation, i).each([&](const auto&, int, double own) {
      least = own < least ? own : least;
    });
    return least;
  });
  double lost[1];
  team.template sum<1>(b.size(), lost,
                       [&](int32_t i, double* to) { to[0] += PlaneFractions<T>(b, extrapolation, i).lost(fraction); });
  return lost[0] > 0 ? 0 : fraction;
}

struct Extrapolated {
  rigid::Extrapolation displacements;
  double fraction;  // of them
};

// Writes y and the extrapolated positions of a body, which b reads after meet().
template <bool energies, class T, class Team>
DIFFVBD_FN Extrapolated extrapolate(const Inputs<T>& in, const Body<T>& b, const Team& team, T* x, T* y) {
  const BeforeStep<T> body{in, b};
  rigid::Extrapolation displacements = rigid::extrapolation_of(body, team, in.lookback);
  double fraction = energies && in.filters ? fraction_of_body(body, displacements, team) : 1;
  if (fraction < 1) {  // blocked: the correction would add the turn at the plane, and the body would rebound
    displacements.keep();
    fraction = fraction_of_body(body, displacements, team);
  }
  team.each(b.size(), [&](int32_t i) {
    const int32_t v = b.vertex(i);
    const int64_t at = 3 * b.row(v);
    const Motion<T> m(in, b.scene, v);
    put(x + at, body.position(i) + fraction * displacements.displacement(body, i));
    y[at] = m.y.x, y[at + 1] = m.y.y, y[at + 2] = m.y.z;
  });
  team.meet();
  return {displacements, fraction};
}

// blocked, if not null, receives whether planes block the body.
template <bool energies, class T, class Team>
DIFFVBD_FN void begin_body(const Inputs<T>& in, const Body<T>& b, const Team& team, T* x_start, T* y,
                           uint8_t* blocked) {
  const double fraction = extrapolate<energies>(in, b, team, x_start, y).fraction;
  if (blocked != nullptr && team.leads()) blocked[b.scene * in.bodies.bodies + b.body] = fraction < 1;
  rigid::correct<energies>(b, team, nullptr, x_start);
}

// The adjoint of a fraction: of x, the displacements [B, V, 3] and the planes that set it, evenly where several do.
template <class T, class Team>
DIFFVBD_FN void reverse_fraction(const BeforeStep<T>& body, const Team& team, const Extrapolated& c,
                                 double fraction_bar, T* displacement_bar, const Adjoints<T>& a) {
  const Inputs<T>& in = body.in;
  const Body<T>& b = body.b;
  const double fraction = c.fraction;
  const auto ties = [&](const PlaneFractions<T>& planes_of) {
    int count = 0;
    planes_of.each([&](const auto&, int, double own) { count += own == fraction; });
    return count;
  };
  double binding[1];
  team.template sum<1>(b.size(), binding, [&](int32_t i, double* to) {
    to[0] += ties(PlaneFractions<T>(body, c.displacements, i)) > 0 ? 1 : 0;
  });
  team.each(b.size(), [&](int32_t i) {
    const int32_t v = b.vertex(i);
    const int64_t row = b.row(v);
    const PlaneFractions<T> planes_of(body, c.displacements, i);
    const int tied = ties(planes_of);
    if (tied == 0) return;
    const double bar = fraction_bar / (binding[0] * tied);
    planes_of.each([&](const auto& plane, int k, double own) {
      if (own != fraction) return;
      const double closing = -dot(plane.n, planes_of.step), wide = plane.gap(planes_of.x) - plane.dhat;
      const double closing_bar = -bar * fraction / closing;
      const double gap_bar = wide >= 0 ? double(in.parameters.filter_eta) * bar / closing : 0;
      add_to(a.x + 3 * row, gap_bar * plane.n);
      add_to(displacement_bar + 3 * row, (-closing_bar) * plane.n);
      if (a.planes == nullptr) return;
      const Vector world = planes_of.x + b.state(v, planes_of.x).origin,
                   n_bar = gap_bar * world + (-closing_bar) * planes_of.step;
      const double values[] = {n_bar.x, n_bar.y, n_bar.z, -gap_bar, 0, -gap_bar};
      T* to = a.planes + row * in.plane_scalars() + k;
      for (int c = 0; c < 6; ++c) to[c] += static_cast<T>(values[c]);
    });
  });
}

// Transpose of begin_body() and release_body(). x and y, [B, V, 3], receive what b reads, and then y the adjoint of the
// displacements; a.v holds the adjoint of y by the correction first, and then all of it.
template <bool energies, class T, class Team>
DIFFVBD_FN void reverse_body(const Inputs<T>& in, const Body<T>& b, const Team& team, rigid::Iteration* record, T* x,
                             T* y, const Adjoints<T>& a) {
  if (energies && in.alone != nullptr && in.alone[b.scene * in.bodies.bodies + b.body] != 0) {  // released
    team.each(b.size(), [&](int32_t i) {
      reverse_alone(in, a, b.scene, b.vertex(i), true);
      a.mass[b.row(b.vertex(i))] = T(0);
    });
    return;
  }
  const BeforeStep<T> body{in, b};
  const Extrapolated c = extrapolate<energies>(in, b, team, x, y);
  const double fraction = c.fraction, h = in.bodies.time_step;
  rigid::reverse<energies>(b, team, record,
                           {a.x_start, nullptr, a.x, energies ? a.x_prev : nullptr, a.v, a.mass, a.shared, a.own,
                            a.shared_count, a.own_count});
  double fraction_bar[1];
  T* displacement_bar = y;
  team.meet();
  team.template sum<1>(b.size(), fraction_bar, [&](int32_t i, double* to) {
    const int32_t v = b.vertex(i);
    const int64_t row = b.row(v);
    const Vector extrapolated = wide_at(a.x + 3 * row), y_bar = wide_at(a.v + 3 * row) + wide_at(a.y + 3 * row);
    if (fraction < 1) to[0] += dot(extrapolated, c.displacements.displacement(body, i));
    put(a.x + 3 * row, extrapolated + y_bar + (energies ? wide_at(a.x_prev + 3 * row) : Vector{}));
    put(displacement_bar + 3 * row, fraction * extrapolated);
    put(a.v + 3 * row, y_bar);
    if (a.acceleration) put(a.acceleration + 3 * row, (h * h) * y_bar);
    if (a.prescribed) put(a.prescribed + 3 * row, Vector{});
  });
  if constexpr (energies) {
    if (0 < fraction && fraction < 1) reverse_fraction(body, team, c, fraction_bar[0], displacement_bar, a);
  }
  double mean_bar[3];
  const auto bend_bar = [&](int32_t i) { return wide_at(displacement_bar + 3 * b.row(b.vertex(i))); };
  team.template sum<3>(b.size(), mean_bar, [&](int32_t i, double* to) {
    const Vector bar = bend_bar(i);
    add_to(to, bar);
  });
  rigid::reverse_extrapolation(body, team, c.displacements, {mean_bar[0], mean_bar[1], mean_bar[2]}, bend_bar,
                               [&](int32_t i, const Vector& x_bar, const Vector& bar, double mass_bar) {
                                 const int64_t row = b.row(b.vertex(i));
                                 add_to(a.x + 3 * row, x_bar);
                                 put(a.v + 3 * row, h * (bar + wide_at(a.v + 3 * row)));
                                 a.mass[row] = static_cast<T>(a.mass[row] + mass_bar);
                               });
}

// The start of lower incremental potential, of two.

template <class T>
struct Candidates {
  rigid::Inputs<T> bodies;                            // x: one state; y the predictor
  const T* other;                                     // [B, V, 3]  the other state
  const int32_t *tets, *tet_ptr;                      // [listed tets, 5]: its number, its corners; [bodies + 1]
  Batched<const T> material[kMaterialScalars], rest;  // [B, T] or [B, 1] each, [B, T, kRestScalars]; null: no tets
};

// Bodies whose start is chosen (null for none), their second state, and what receives whether each takes it.
template <class T>
struct StartChoice {
  const Candidates<T>* two;
  T* second;
  uint8_t* taken;
};

// The ratio of Path from which on tets resist. Each corner has all of its mass in each of its tets, some 24: there h^2
// times the stiffness of a layer of vertices is half of their mass.
constexpr double kSoft = 0.02;

// The change of a body along the straight path d from x to `other`.
struct Path {
  double increase;  // of the potential
  double ratio;     // h^2 d . K d over the d . M d of its corners, of each tet; their mean, weighted by d . K d
  // Whether tets hardly turn vertices back within a step. d . M d of the whole body would hide a few that do.
  DIFFVBD_FN bool is_soft() const { return ratio < kSoft; }
};
// The ratio only where it is asked for: a generated law has to find it apart.
template <bool has_ratio = true, class T, class Team>
DIFFVBD_FN Path path_between(const Candidates<T>& in, const rigid::Body<T>& b, const Team& team) {
  const auto other = [&](int32_t v) { return wide_at(in.other + 3 * b.row(v)); };
  double vertices[1];
  team.template sum<1>(b.size(), vertices, [&](int32_t i, double* to) {
    const int32_t v = b.vertex(i);
    const rigid::Vector one = b.position(v), two = other(v), displacement = two - one;
    if (dot(displacement, displacement) == 0) return;
    to[0] += b.mass(v) * dot(displacement, 0.5 * (one + two) - b.target(v));
    b.energies(v, [&](auto energy, int, const double* data, int count) {
      using E = decltype(energy);
      to[0] += E::value(b.state(v, two), data, count) - E::value(b.state(v, one), data, count);
    });
  });
  if (in.rest.data == nullptr) return {vertices[0], 0};
  double tets[3];  // increase, size of the quadratic part, weighted ratios
  const int32_t first = in.tet_ptr[b.body];
  team.template sum<3>(in.tet_ptr[b.body + 1] - first, tets, [&](int32_t i, double* to) {
    const int32_t* tet = in.tets + 5 * int64_t{first + i};
    rigid::Vector one[4], displacement[4];
    for (int c = 0; c < 4; ++c) one[c] = b.position(tet[1 + c]), displacement[c] = other(tet[1 + c]) - one[c];
    double rest[kRestScalars], material[kMaterialScalars];
    const T* of_tet = in.rest.data + b.scene * in.rest.scene + kRestScalars * int64_t{tet[0]};
    for (int c = 0; c < kRestScalars; ++c) rest[c] = of_tet[c];
    for (int m = 0; m < kMaterialScalars; ++m) {
      material[m] = in.material[m].data[b.scene * in.material[m].scene + in.material[m].item * tet[0]];
    }
    double slope, bend, inertia = 0;  // bend: half of d . K d, K averaged over the path
    TetLaw::template path<has_ratio>(one, displacement, rest, material, slope, bend);
    for (int c = 0; c < 4; ++c) inertia += b.mass(tet[1 + c]) * dot(displacement[c], displacement[c]);
    to[0] += slope + bend;
    if (inertia > 0) to[1] += std::abs(bend), to[2] += bend * bend / inertia;
  });
  const double h2 = b.in.time_step * b.in.time_step;
  return {vertices[0] + h2 * tets[0], tets[1] > 0 ? 2 * h2 * tets[2] / tets[1] : 0};
}

// A corrected body that planes block, in short steps. Its support vertex stops the whole body far from where inertia
// takes the other vertices, and few sweeps do not undo that where h^2 times the stiffness is small relative to the
// mass. Its vertices are then released: each moves by itself, as those of other bodies do (docs/method.md, section 14).

// alone: on entry whether planes block the body, on return whether it is released. two: x is x_start and `other` is
// apart [B, V, 3], which the body writes.
template <class T, class Team>
DIFFVBD_FN void release_body(const Inputs<T>& in, const Candidates<T>& two, const Body<T>& b, const Team& team,
                             T* x_start, T* apart, uint8_t* alone) {
  const int64_t item = b.scene * in.bodies.bodies + b.body;
  if (alone[item] == 0) return;
  team.each(b.size(), [&](int32_t i) {
    const int32_t v = b.vertex(i);
    const Motion<T> m(in, b.scene, v);
    put(apart + 3 * b.row(v), toward(in, b.scene, v, m.x, m.y));
  });
  team.meet();
  const Path path = path_between(two, b, team);
  const bool releases = path.increase < 0 && path.is_soft();
  if (team.leads()) alone[item] = releases;
  if (!releases) return;
  team.each(b.size(), [&](int32_t i) {
    const int64_t at = 3 * b.row(b.vertex(i));
    put(x_start + at, vector_at(apart + at));
  });
}

}  // namespace diffvbd::start
