// Where a step begins: the predictor y = x + h v + h^2 a, and where the sweeps start. The vertices of a body that is
// corrected coast together, one share s of their ways (rigid/coast.h), as far as planes let them, and are corrected;
// every other vertex, and in short steps those of a body that planes hold back (part.h), goes toward x + h v or y as
// far as planes let it alone (docs/method.md, sections 6 and 14). With the adjoint.
#pragma once

#include "../energies/floor_start.h"
#include "../sweep/extrapolation.h"
#include "rigid.h"

namespace diffvbd::start {

// Where the vertices of bodies that are not corrected start from. kLower: for each body the lower potential of the two.
enum From { kInertia = 0, kPredictor = 1, kLower = 2 };

using rigid::Body, rigid::kCorrected, rigid::put, rigid::Vector;

template <class T>
struct Inputs {
  rigid::Inputs<T> bodies;  // that are corrected: x is where they have coasted to, y the predictor
  Batched<const T> x, v, acceleration,
      prescribed;        // [B, V, 3]; acceleration also [B, 1, 3] (item 0); prescribed may be null
  const bool* pinned;    // [V]
  const uint8_t* falls;  // [B, others]  with kLower: whether a body starts from y
  const uint8_t* alone;  // [B, bodies]  whether the vertices of a corrected body start each by itself; null: none
  int32_t others;
  int from;
  bool some_alone;  // whether some vertices are in no body that is corrected
  bool filters;     // whether planes hold back a start
  double chord;     // of rigid/coast.h
  StepParameters<T> parameters;

  DIFFVBD_FN static Vec3<T> at(const Batched<const T>& a, int64_t scene, int32_t v) {
    const T* p = a.data + scene * a.scene + 3 * a.item * v;
    return {p[0], p[1], p[2]};
  }
  DIFFVBD_FN int64_t row(int64_t scene, int32_t v) const { return scene * bodies.vertices + v; }
  DIFFVBD_FN const T* planes(int64_t scene) const { return bodies.data.data + scene * bodies.data.scene; }
  DIFFVBD_FN int plane_scalars() const { return bodies.data_count[0]; }  // FloorBarrier is the first energy
  DIFFVBD_FN VertexState<T> state(int64_t scene, int32_t v, const Vec3<T>& x) const {
    return {x, x, bodies.origin.data ? at(bodies.origin, scene, v) : zero3<T>(), T(bodies.time_step)};
  }
  DIFFVBD_FN bool starts_from_y(int64_t scene, int32_t v) const {
    return from == kPredictor ||
           (from == kLower && bodies.other[v] >= 0 && falls[scene * others + bodies.other[v]] != 0);
  }
};

// Positions before the step, after coasting, and the predictor.
template <class T>
struct Motion {
  Vec3<T> x, coasting, y;
  DIFFVBD_FN Motion(const Inputs<T>& in, int64_t scene, int32_t v) : x(in.at(in.x, scene, v)) {
    const double h = in.bodies.time_step;
    if (in.pinned[v]) {
      coasting = y = in.prescribed.data ? in.at(in.prescribed, scene, v) : x;
    } else {
      coasting = x + T(h) * in.at(in.v, scene, v);
      y = coasting + T(h * h) * in.at(in.acceleration, scene, v);
    }
  }
};

// How far a vertex goes alone from x toward a goal.
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
  const auto store = [&](T* to, const Vec3<T>& a) { to[at] = a.x, to[at + 1] = a.y, to[at + 2] = a.z; };
  store(y, m.y);
  store(x_start, toward(in, scene, v, m.x, in.from == kPredictor ? m.y : m.coasting));
  if (from_y) store(from_y, toward(in, scene, v, m.x, m.y));
}
template <class T>
DIFFVBD_FN void choose_vertex(const Inputs<T>& in, T* x_start, const T* from_y, int64_t scene, int32_t v) {
  if (in.bodies.other[v] < 0 || !in.starts_from_y(scene, v)) return;
  const int64_t at = 3 * in.row(scene, v);
  for (int c = 0; c < 3; ++c) x_start[at + c] = from_y[at + c];
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

template <class T>
DIFFVBD_FN Vec3<T> vector_of(const T* p, int64_t row) {
  return {p[3 * row], p[3 * row + 1], p[3 * row + 2]};
}

// A vertex that goes alone, to y or to x + h v.
template <class T>
DIFFVBD_FN void reverse_alone(const Inputs<T>& in, const Adjoints<T>& a, int64_t scene, int32_t v, bool from_y) {
  const int64_t row = in.row(scene, v);
  const auto store = [&](T* to, const Vec3<T>& value) {
    if (to) to[3 * row] = value.x, to[3 * row + 1] = value.y, to[3 * row + 2] = value.z;
  };
  const Vec3<T> start_bar = vector_of(a.x_start, row), y_bar = vector_of(a.y, row), none = zero3<T>();
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
                          (from_y ? m.y : m.coasting) - m.x, in.parameters, goal_bar, x_bar, planes);
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

// A body by its state before the step and the ways h v of its vertices.
template <class T>
struct Leaving {
  const Inputs<T>& in;
  const Body<T>& b;
  DIFFVBD_FN int32_t size() const { return b.size(); }
  DIFFVBD_FN double mass(int32_t i) const { return b.mass(b.vertex(i)); }
  DIFFVBD_FN static Vector wide(const Vec3<T>& a) { return {double(a.x), double(a.y), double(a.z)}; }
  DIFFVBD_FN Vector position(int32_t i) const { return wide(in.at(in.x, b.scene, b.vertex(i))); }
  DIFFVBD_FN Vector way(int32_t i) const { return in.bodies.time_step * wide(in.at(in.v, b.scene, b.vertex(i))); }
};

// What planes leave of the share 1 of its way that a vertex of a body coasts.
template <class T>
struct Room {
  using Plane = FloorBarrier::Plane<double>;
  const Inputs<T>& in;
  const Body<T>& b;
  Vector x, step;
  double slack;  // a motion along a plane is none toward it, however it rounds
  int32_t v;

  DIFFVBD_FN Room(const Leaving<T>& body, const rigid::Coasting& coasting, int32_t i)
      : in(body.in), b(body.b), x(body.position(i)), step(coasting.way(body, i)), v(body.b.vertex(i)) {
    slack = 8 * double(std::numeric_limits<T>::epsilon()) * std::sqrt(dot(step, step));
  }
  // calls f(plane, its number, the share that it leaves)
  template <class F>
  DIFFVBD_FN void each(F&& f) const {
    const VertexState<double> s = b.state(v, x);
    b.energies(v, [&](auto energy, int, const double* data, int count) {
      if constexpr (std::is_same_v<decltype(energy), FloorBarrier>) {
        for (int k = 0; k < count; k += FloorBarrier::stride) {
          const Plane plane(data + k, s);
          const double wide = plane.gap(x) - plane.dhat, closing = -dot(plane.n, step);
          const double room = wide > 0 ? double(in.parameters.filter_eta) * wide : 0;
          f(plane, k, closing > room + slack ? room / closing : 1.0);
        }
      }
    });
  }
  // the number of planes whose side is not sure after a share of the step
  DIFFVBD_FN double lost(double share) const {
    const VertexState<double> s = b.state(v, x + share * step);
    double count = 0;
    each([&](const Plane& plane, int, double) {
      if (!(plane.template guard<T>(s) < plane.gap(s.x))) count += 1;
    });
    return count;
  }
};

// The share of their ways that all vertices of a body take; 0 where rounding would close a gap.
template <class T, class Team>
DIFFVBD_FN double share_of(const Leaving<T>& b, const rigid::Coasting& coasting, const Team& team) {
  const double share = team.least(b.size(), [&](int32_t i) {
    double least = 1;
    Room<T>(b, coasting, i).each([&](const auto&, int, double own) { least = own < least ? own : least; });
    return least;
  });
  double lost[1];
  team.template sum<1>(b.size(), lost, [&](int32_t i, double* to) { to[0] += Room<T>(b, coasting, i).lost(share); });
  return lost[0] > 0 ? 0 : share;
}

struct Coasted {
  rigid::Coasting ways;
  double share;  // of them
};

// Writes y and where a body has coasted to. b reads what is written here once the team has met.
template <bool energies, class T, class Team>
DIFFVBD_FN Coasted coast(const Inputs<T>& in, const Body<T>& b, const Team& team, T* x, T* y) {
  const Leaving<T> body{in, b};
  rigid::Coasting ways = rigid::coasting_of(body, team, in.chord);
  double share = energies && in.filters ? share_of(body, ways, team) : 1;
  if (share < 1) {  // planes hold it back: the correction would bring the turn in at the plane, at the cost of rebounds
    ways.keep();
    share = share_of(body, ways, team);
  }
  team.each(b.size(), [&](int32_t i) {
    const int32_t v = b.vertex(i);
    const int64_t at = 3 * b.row(v);
    const Motion<T> m(in, b.scene, v);
    put(x + at, body.position(i) + share * ways.way(body, i));
    y[at] = m.y.x, y[at + 1] = m.y.y, y[at + 2] = m.y.z;
  });
  team.meet();
  return {ways, share};
}

// held, if not null, receives whether planes hold the body back.
template <bool energies, class T, class Team>
DIFFVBD_FN void begin_body(const Inputs<T>& in, const Body<T>& b, const Team& team, T* x_start, T* y, uint8_t* held) {
  const double share = coast<energies>(in, b, team, x_start, y).share;
  if (held != nullptr && team.leads()) held[b.scene * in.bodies.bodies + b.body] = share < 1;
  rigid::correct<energies>(b, team, nullptr, x_start);
}

// The adjoint of a share: of x, the ways [B, V, 3] and the planes that set it, evenly where several do.
template <class T, class Team>
DIFFVBD_FN void reverse_share(const Leaving<T>& body, const Team& team, const Coasted& c, double share_bar, T* way_bar,
                              const Adjoints<T>& a) {
  const Inputs<T>& in = body.in;
  const Body<T>& b = body.b;
  const double share = c.share;
  const auto ties = [&](const Room<T>& room) {
    int count = 0;
    room.each([&](const auto&, int, double own) { count += own == share; });
    return count;
  };
  double binding[1];
  team.template sum<1>(b.size(), binding,
                       [&](int32_t i, double* to) { to[0] += ties(Room<T>(body, c.ways, i)) > 0 ? 1 : 0; });
  team.each(b.size(), [&](int32_t i) {
    const int32_t v = b.vertex(i);
    const int64_t row = b.row(v);
    const Room<T> room(body, c.ways, i);
    const int tied = ties(room);
    if (tied == 0) return;
    const double bar = share_bar / (binding[0] * tied);
    room.each([&](const auto& plane, int k, double own) {
      if (own != share) return;
      const double closing = -dot(plane.n, room.step), wide = plane.gap(room.x) - plane.dhat;
      const double closing_bar = -bar * share / closing;
      const double gap_bar = wide >= 0 ? double(in.parameters.filter_eta) * bar / closing : 0;
      rigid::add_to(a.x + 3 * row, gap_bar * plane.n);
      rigid::add_to(way_bar + 3 * row, (-closing_bar) * plane.n);
      if (a.planes == nullptr) return;
      const Vector world = room.x + b.state(v, room.x).origin, n_bar = gap_bar * world + (-closing_bar) * room.step;
      const double values[] = {n_bar.x, n_bar.y, n_bar.z, -gap_bar, 0, -gap_bar};
      T* to = a.planes + row * in.plane_scalars() + k;
      for (int c = 0; c < 6; ++c) to[c] += static_cast<T>(values[c]);
    });
  });
}

// Transpose of begin_body() and part_body(). x and y, [B, V, 3], receive what b reads, and then y the adjoint of the
// ways; a.v holds what the correction sends to y first, and then all that y has.
template <bool energies, class T, class Team>
DIFFVBD_FN void reverse_body(const Inputs<T>& in, const Body<T>& b, const Team& team, rigid::Iteration* record, T* x,
                             T* y, const Adjoints<T>& a) {
  if (energies && in.alone != nullptr && in.alone[b.scene * in.bodies.bodies + b.body] != 0) {  // planes hold it back
    team.each(b.size(), [&](int32_t i) {
      reverse_alone(in, a, b.scene, b.vertex(i), true);
      a.mass[b.row(b.vertex(i))] = T(0);
    });
    return;
  }
  const Leaving<T> body{in, b};
  const Coasted c = coast<energies>(in, b, team, x, y);
  const double share = c.share, h = in.bodies.time_step;
  rigid::reverse<energies>(b, team, record,
                           {a.x_start, nullptr, a.x, energies ? a.x_prev : nullptr, a.v, a.mass, a.shared, a.own,
                            a.shared_count, a.own_count});
  double share_bar[1];
  T* way_bar = y;
  team.meet();
  team.template sum<1>(b.size(), share_bar, [&](int32_t i, double* to) {
    const int32_t v = b.vertex(i);
    const int64_t row = b.row(v);
    const Vector coasted = Body<T>::at(a.x + 3 * row), y_bar = Body<T>::at(a.v + 3 * row) + Body<T>::at(a.y + 3 * row);
    if (share < 1) to[0] += dot(coasted, c.ways.way(body, i));
    put(a.x + 3 * row, coasted + y_bar + (energies ? Body<T>::at(a.x_prev + 3 * row) : Vector{}));
    put(way_bar + 3 * row, share * coasted);
    put(a.v + 3 * row, y_bar);
    if (a.acceleration) put(a.acceleration + 3 * row, (h * h) * y_bar);
    if (a.prescribed) put(a.prescribed + 3 * row, Vector{});
  });
  if constexpr (energies) {
    if (0 < share && share < 1) reverse_share(body, team, c, share_bar[0], way_bar, a);
  }
  double mean_bar[3];
  const auto bend_bar = [&](int32_t i) { return Body<T>::at(way_bar + 3 * b.row(b.vertex(i))); };
  team.template sum<3>(b.size(), mean_bar, [&](int32_t i, double* to) {
    const Vector bar = bend_bar(i);
    to[0] += bar.x, to[1] += bar.y, to[2] += bar.z;
  });
  rigid::reverse_coasting(body, team, c.ways, {mean_bar[0], mean_bar[1], mean_bar[2]}, bend_bar,
                          [&](int32_t i, const Vector& x_bar, const Vector& bar, double mass_bar) {
                            const int64_t row = b.row(b.vertex(i));
                            rigid::add_to(a.x + 3 * row, x_bar);
                            put(a.v + 3 * row, h * (bar + Body<T>::at(a.v + 3 * row)));
                            a.mass[row] = static_cast<T>(a.mass[row] + mass_bar);
                          });
}

// From which of two states a body's sweeps start: the one of lower incremental potential.

template <class T>
struct Candidates {
  rigid::Inputs<T> bodies;                            // x: one state; y the predictor
  const T* other;                                     // [B, V, 3]  the other state
  const int32_t *tets, *tet_ptr;                      // [listed tets, 5]: its number, its corners; [bodies + 1]
  Batched<const T> material[kMaterialScalars], rest;  // [B, T] or [B, 1] each, [B, T, kRestScalars]; null: no tets
};

// From which ratio of Way on tets resist. Each corner has all of its mass in each of its tets, some 24, so that this is
// where h^2 times the stiffness of a layer of vertices is half of their mass.
constexpr double kSoft = 0.02;

// What happens to a body on the straight way d from x to `other`.
struct Way {
  double rise;   // of the potential
  double ratio;  // h^2 d . K d over the d . M d of its corners, of each tet; their mean, weighted by d . K d
  // Whether tets hardly turn vertices back within a step. Over the whole body d . M d would hide a few that do.
  DIFFVBD_FN bool is_soft() const { return ratio < kSoft; }
};
template <class T, class Team>
DIFFVBD_FN Way way_between(const Candidates<T>& in, const rigid::Body<T>& b, const Team& team) {
  const auto other = [&](int32_t v) { return rigid::Body<T>::at(in.other + 3 * b.row(v)); };
  double vertices[1];
  team.template sum<1>(b.size(), vertices, [&](int32_t i, double* to) {
    const int32_t v = b.vertex(i);
    const rigid::Vector one = b.position(v), two = other(v), way = two - one;
    if (dot(way, way) == 0) return;
    to[0] += b.mass(v) * dot(way, 0.5 * (one + two) - b.target(v));
    b.energies(v, [&](auto energy, int, const double* data, int count) {
      using E = decltype(energy);
      to[0] += E::value(b.state(v, two), data, count) - E::value(b.state(v, one), data, count);
    });
  });
  if (in.rest.data == nullptr) return {vertices[0], 0};
  double tets[3];  // rise, size of bends, what their ratios weigh
  const int32_t first = in.tet_ptr[b.body];
  team.template sum<3>(in.tet_ptr[b.body + 1] - first, tets, [&](int32_t i, double* to) {
    const int32_t* tet = in.tets + 5 * int64_t{first + i};
    rigid::Vector one[4], way[4];
    for (int c = 0; c < 4; ++c) one[c] = b.position(tet[1 + c]), way[c] = other(tet[1 + c]) - one[c];
    double rest[kRestScalars], material[kTetScalars];
    const T* of_tet = in.rest.data + b.scene * in.rest.scene + kRestScalars * int64_t{tet[0]};
    for (int c = 0; c < kRestScalars; ++c) rest[c] = of_tet[c];
    for (int m = 0; m < kMaterialScalars; ++m) {
      material[m] = in.material[m].data[b.scene * in.material[m].scene + in.material[m].item * tet[0]];
    }
    if constexpr (TetLayout::reads_x_prev) {
      for (int c = 0; c < 4; ++c) {
        const rigid::Vector before = b.state(tet[1 + c], one[c]).x_prev;
        double* at = material + kMaterialScalars + 3 * c;
        at[0] = before.x, at[1] = before.y, at[2] = before.z;
      }
    }
    double rise[TetLayout::line_degree]{};
    TetLaw::line(one, way, rest, material, rise);
    double bend = 0, inertia = 0;  // half of d . K d, K averaged over the way: what the energy rises beyond its slope
    for (int k = 1; k < TetLayout::line_degree; ++k) bend += rise[k];
    for (int c = 0; c < 4; ++c) inertia += b.mass(tet[1 + c]) * dot(way[c], way[c]);
    to[0] += rise[0] + bend;
    if (inertia > 0) to[1] += std::abs(bend), to[2] += bend * bend / inertia;
  });
  const double h2 = b.in.time_step * b.in.time_step;
  return {vertices[0] + h2 * tets[0], tets[1] > 0 ? 2 * h2 * tets[2] / tets[1] : 0};
}

// A corrected body that planes hold back, in short steps. Its lowest vertex stops all of it far from where inertia
// takes the others, and few sweeps do not undo that where h^2 times the stiffness is small beside the mass: then its
// vertices go each by itself, as those of other bodies do (docs/method.md, section 14).

// alone: on entry whether planes hold the body back, on return whether its vertices have started each by itself. two:
// x is x_start and `other` is apart [B, V, 3], which the body writes.
template <class T, class Team>
DIFFVBD_FN void part_body(const Inputs<T>& in, const Candidates<T>& two, const Body<T>& b, const Team& team, T* x_start,
                          T* apart, uint8_t* alone) {
  const int64_t item = b.scene * in.bodies.bodies + b.body;
  if (alone[item] == 0) return;
  team.each(b.size(), [&](int32_t i) {
    const int32_t v = b.vertex(i);
    const Motion<T> m(in, b.scene, v);
    const Vec3<T> to = toward(in, b.scene, v, m.x, m.y);
    put(apart + 3 * b.row(v), {double(to.x), double(to.y), double(to.z)});
  });
  team.meet();
  const Way way = way_between(two, b, team);
  const bool parts = way.rise < 0 && way.is_soft();
  if (team.leads()) alone[item] = parts;
  if (!parts) return;
  team.each(b.size(), [&](int32_t i) {
    const int64_t at = 3 * b.row(b.vertex(i));
    for (int c = 0; c < 3; ++c) x_start[at + c] = apart[at + c];
  });
}

}  // namespace diffvbd::start
