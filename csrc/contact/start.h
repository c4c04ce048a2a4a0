// The start of a substep, and its adjoint: each vertex moves with its island, with its body as a whole, toward its
// target, then by its gravity move; of all but the first a decided fraction. A floor limits the last two
// (docs/method.md, section 12).
#pragma once

#include "../energies/floor_start.h"
#include "../sweep/body.h"
#include "above_floor.h"
#include "passes.h"

namespace diffvbd::contact {

template <class T>
struct StartInputs {
  rigid::Inputs<T> scene;              // x, origin and the vertices of all bodies
  const T *move, *gravity_move;        // [B, V, 3]  wanted displacement from x, then that of gravity
  const T* u;                          // [B, bodies, 3]  translation of each body's island
  const T* body_move;                  // [B, V, 3]  displacement of its body relative to u, limited by a floor
  const T* rigid_fraction;             // [B, bodies]  fraction of `body_move`
  const T *fraction, *last_fraction;   // [B, V]  of the displacement to the target, and of the gravity move
  Batched<const T> floor;              // [1 | B, data of the planes], or null
  const bool *pinned, *pinned_bodies;  // [V], [bodies]  pinned or prescribed vertices; bodies with one
  const int32_t* body;                 // [V]
  int32_t floor_scalars;
  StepParameters<T> parameters;

  DIFFVBD_FN int64_t row(int64_t scene_index, int32_t v) const { return scene_index * scene.vertices + v; }
  DIFFVBD_FN int64_t body_row(int64_t scene_index, int32_t v) const { return scene_index * scene.bodies + body[v]; }
  DIFFVBD_FN const T* planes(int64_t scene_index) const { return floor.data + scene_index * floor.scene; }
  DIFFVBD_FN VertexState<T> state(const Vec3<T>& x, int64_t scene_index, int32_t v) const {
    const Batched<const T>& o = scene.origin;
    return {x, x, o.data ? vector_at(o.data + scene_index * o.scene + 3 * int64_t{v}) : zero3<T>(),
            parameters.time_step};
  }
  DIFFVBD_FN bool is_free(int32_t v) const { return floor.data == nullptr || pinned[v]; }  // of a floor
};

// The path of one vertex, for known fractions.
template <class T>
struct StartPath {
  const StartInputs<T>& in;
  int64_t scene;
  int32_t v;
  int64_t row = in.row(scene, v), body = in.body_row(scene, v);

  DIFFVBD_FN Vec3<T> x() const { return vector_at(in.scene.x + 3 * row); }
  DIFFVBD_FN Vec3<T> move() const { return vector_at(in.move + 3 * row); }
  DIFFVBD_FN Vec3<T> gravity_move() const { return vector_at(in.gravity_move + 3 * row); }
  DIFFVBD_FN Vec3<T> u() const { return vector_at(in.u + 3 * body); }
  // The end of a displacement from `from`, limited by the floor.
  DIFFVBD_FN Vec3<T> filtered(const Vec3<T>& from, const Vec3<T>& displacement) const {
    return from +
           FloorStart::moved(in.state(from, scene, v), in.planes(scene), in.floor_scalars, displacement, in.parameters);
  }
  DIFFVBD_FN Vec3<T> target() const { return in.is_free(v) ? x() + move() : filtered(x() + u(), move() - u()); }
  DIFFVBD_FN Vec3<T> base(const Vec3<T>& target) const {
    return in.pinned[v] ? target : x() + u() + in.rigid_fraction[body] * vector_at(in.body_move + 3 * row);
  }
  DIFFVBD_FN Vec3<T> at(const Vec3<T>& target, T fraction) const {
    const Vec3<T> from = base(target);
    return in.pinned[v] ? target : from + fraction * (target - from);
  }
  DIFFVBD_FN Vec3<T> last_target(const Vec3<T>& at) const {
    return in.is_free(v) ? at + gravity_move() : filtered(at, gravity_move());
  }
  DIFFVBD_FN Vec3<T> end() const {
    const Vec3<T> from = at(target(), in.fraction[row]), to = last_target(from);
    return in.pinned[v] ? to : from + in.last_fraction[row] * (to - from);
  }
};

template <class T>
struct StartAdjoints {
  const T* end;                                // of the output
  T *x, *move, *gravity_move, *u, *body_move;  // [B, V, 3] each, u for each vertex
  T* floor;                                    // [B, V, floor_scalars], or null where not wanted
};

template <class T>
DIFFVBD_FN void reverse_start(const StartInputs<T>& in, const StartAdjoints<T>& a, int64_t scene, int32_t v) {
  const StartPath<T> path{in, scene, v};
  T* floor_bar = a.floor ? a.floor + path.row * in.floor_scalars : nullptr;
  for (int k = 0; floor_bar && k < in.floor_scalars; ++k) floor_bar[k] = T(0);
  // bar: of the end of a limited displacement on entry, of the displacement on return; returns that of its begin
  const auto reverse_filtered = [&](const Vec3<T>& from, const Vec3<T>& displacement, Vec3<T>& bar) {
    Vec3<T> from_bar = bar;
    if (!in.is_free(v)) {
      FloorStart::moved_vjp(in.state(from, scene, v), in.planes(scene), in.floor_scalars, displacement, in.parameters,
                            bar, from_bar, floor_bar);
    }
    return from_bar;
  };
  const bool pinned = in.pinned[v];
  const T last = pinned ? T(1) : in.last_fraction[path.row], fraction = pinned ? T(1) : in.fraction[path.row];
  const Vec3<T> end_bar = vector_at(a.end + 3 * path.row), at = path.at(path.target(), fraction);
  Vec3<T> gravity_bar = last * end_bar, at_bar = reverse_filtered(at, path.gravity_move(), gravity_bar);
  if (!pinned) at_bar += (T(1) - last) * end_bar;
  const Vec3<T> base_bar = pinned ? zero3<T>() : (T(1) - fraction) * at_bar;
  Vec3<T> move_bar = fraction * at_bar;
  const Vec3<T> start_bar = reverse_filtered(path.x() + path.u(), path.move() - path.u(), move_bar);
  put(a.x + 3 * path.row, start_bar + base_bar);
  put(a.move + 3 * path.row, move_bar);
  put(a.gravity_move + 3 * path.row, gravity_bar);
  put(a.u + 3 * path.row, start_bar - move_bar + base_bar);
  put(a.body_move + 3 * path.row, in.rigid_fraction[path.body] * base_bar);
}

// Decisions at the start of a substep: which bodies move by displacements of their own. Step fractions
// (contact/advance.h) and energy increases are found in between; nothing is differentiated (docs/method.md, section
// 12). Functors on bodies take a body and its team, those on vertices a scene and a vertex.

constexpr double kBent = 0.1;      // fraction of its deformation radius that a body may always bend by
constexpr double kDeepBent = 0.5;  // the largest one for a body that planes or pairs block

// State of the own displacement of a vertex. Pending: frozen unless the potential of its body decreases.
enum MoveState : uint8_t { kMoving, kFrozen, kPending };

// The largest fraction s <= 1 of a rigid motion with s displacement + s^2 stretch <= radius: sweeps can take back the
// stretch [m] of straight paths.
DIFFVBD_FN double fraction_within(double displacement, double stretch, double trust_radius, double tiny) {
  const double sum = displacement + square_root(displacement * displacement + 4 * stretch * trust_radius),
               fraction = 2 * trust_radius / (sum < tiny ? tiny : sum);
  return 1 < fraction ? 1 : fraction;  // or no number
}

// Displacements of bodies as wholes, within the radii.
template <class T>
struct RigidMoves {
  StartInputs<T> in;
  const T* displacement;                       // [B, V, 3]  of the rigid motions of bodies
  const T* stretch;                            // [B, bodies]  stretch of a body by straight paths [m]
  const T *trust_radius, *deformation_radius;  // [B, bodies + 1]; the latter may be null
  T* limit;                                    // [B, bodies]  fraction of the displacement relative to u
  T *displacements, *center;                   // [B, V, 3]
  T *trust_radii, *deformation_radii;          // [B, V]

  template <class Team>
  DIFFVBD_FN void operator()(const rigid::Body<T>& b, const Team& team) const {
    const double infinity = std::numeric_limits<double>::infinity(), tiny = std::numeric_limits<T>::min();
    const int64_t index = b.scene * b.in.bodies + b.body, place = index + b.scene;
    const Vec3<T> u = vector_at(in.u + 3 * index);
    const double square = most(team, b.size(), [&](int32_t i) {
      const int32_t v = b.vertex(i);
      const Vec3<T> relative = vector_at(displacement + 3 * b.row(v)) - u;
      const double own = in.pinned[v] ? 0 : double(dot(relative, relative));
      return own < infinity ? own : infinity;
    });
    const double longest = 0 < square ? square_root(square) : 0;
    double fraction = fraction_within(longest, stretch[index], trust_radius[place], tiny);
    if (deformation_radius)
      fraction = smaller(fraction, fraction_within(0, stretch[index], deformation_radius[place], tiny));
    if (!(longest < infinity)) fraction = std::numeric_limits<double>::quiet_NaN();  // as is the displacement
    if (team.leads()) limit[index] = T(fraction);
    team.each(b.size(), [&](int32_t i) {
      const int32_t v = b.vertex(i);
      const int64_t row = b.row(v);
      const Vec3<T> x = vector_at(in.scene.x + 3 * row);
      put(displacements + 3 * row,
          in.pinned[v] ? vector_at(in.move + 3 * row) : u + T(fraction) * vector_at(in.body_move + 3 * row));
      put(center + 3 * row, in.pinned[v] ? x : x + u);
      trust_radii[row] = trust_radius[place];
      if (deformation_radius) deformation_radii[row] = deformation_radius[place];
    });
  }
};

// Positions after the bodies have moved as wholes, and the displacements from there to the targets.
template <class T>
struct Wishes {
  StartInputs<T> in;
  T *base, *target, *displacement;  // [B, V, 3]

  DIFFVBD_FN void operator()(int64_t scene, int32_t v) const {
    const StartPath<T> path{in, scene, v};
    const Vec3<T> to = path.target(), from = path.base(to);
    put(base + 3 * path.row, from);
    put(target + 3 * path.row, to);
    put(displacement + 3 * path.row, to - from);
  }
};

// The decision which of these displacements bend a free body. A body that a floor stops or a radius truncates is
// frozen, and so is a blocked one that bends deeply; with self-contact any other bent body is pending.
template <class T>
struct Deformations {
  StartInputs<T> in;
  const T *limit, *deformation_radius;  // [B, bodies], and [B, bodies + 1] or null
  const bool* stopped;                  // [B, bodies]
  T* displacement;                      // [B, V, 3]  set to zero where frozen
  uint8_t* state;                       // [B, V]

  template <class Team>
  DIFFVBD_FN void operator()(const rigid::Body<T>& b, const Team& team) const {
    const int64_t index = b.scene * b.in.bodies + b.body;
    const bool free = !in.pinned_bodies[b.body], up = stopped[index] || in.rigid_fraction[index] < T(kTruncated);
    bool frozen = free && (stopped[index] || limit[index] < T(kTruncated)), pending = false;
    if (deformation_radius && free) {
      const double trust_radius = deformation_radius[index + b.scene];
      const double square = most(team, b.size(), [&](int32_t i) {
        const Vec3<T> own = vector_at(displacement + 3 * b.row(b.vertex(i)));
        const double size = dot(own, own);
        return 0 < size ? size : 0;  // not for NaN
      });
      frozen = frozen || (up && (kDeepBent * trust_radius) * (kDeepBent * trust_radius) < square);
      pending = (kBent * trust_radius) * (kBent * trust_radius) < square;
    }
    team.each(b.size(), [&](int32_t i) {
      const int64_t row = b.row(b.vertex(i));
      state[row] = frozen ? kFrozen : pending ? kPending : kMoving;
      if (frozen) put(displacement + 3 * row, zero3<T>());
    });
  }
};

// The decision for pending vertices.
template <class T>
struct Freeze {
  StartInputs<T> in;
  const T* displacement;  // [B, V, 3]
  const uint8_t* state;   // [B, V]
  const bool* increases;  // [B, V]
  T* displacement_out;
  uint8_t* state_out;

  DIFFVBD_FN void operator()(int64_t scene, int32_t v) const {
    const int64_t row = in.row(scene, v);
    const bool pending = state[row] == kPending, freezes = pending && increases[row];
    state_out[row] = pending && !freezes ? uint8_t{kMoving} : state[row];
    put(displacement_out + 3 * row, freezes ? zero3<T>() : vector_at(displacement + 3 * row));
  }
};

// Free bodies that pairs have bent by blocking some of their vertices: these are pending.
template <class T>
struct BlockedBodies {
  StartInputs<T> in;
  const T *base, *displacement;  // [B, V, 3]
  const uint8_t* state;          // [B, V]
  T* to;                         // [B, V, 3]
  uint8_t* state_out;

  template <class Team>
  DIFFVBD_FN void operator()(const rigid::Body<T>& b, const Team& team) const {
    const auto fraction_of_body = [&](int64_t row) { return state[row] == kMoving ? in.fraction[row] : T(0); };
    const double least = team.least(b.size(), [&](int32_t i) { return double(fraction_of_body(b.row(b.vertex(i)))); });
    const bool bent = !in.pinned_bodies[b.body] && T(least) < T(kTruncated);
    team.each(b.size(), [&](int32_t i) {
      const int64_t row = b.row(b.vertex(i));
      state_out[row] = state[row] != kMoving ? kFrozen : bent ? kPending : kMoving;
      put(to + 3 * row, vector_at(base + 3 * row) + fraction_of_body(row) * vector_at(displacement + 3 * row));
    });
  }
};

// Positions on the way to the targets, and the gravity displacements from there.
template <class T>
struct GravityMoves {
  StartInputs<T> in;     // fraction: of what moves
  const uint8_t* state;  // [B, V]
  T* fraction;           // [B, V]  of all
  T *at, *displacement;  // [B, V, 3]

  DIFFVBD_FN void operator()(int64_t scene, int32_t v) const {
    const StartPath<T> path{in, scene, v};
    const T went = state[path.row] == kMoving ? in.fraction[path.row] : T(0);
    const Vec3<T> from = path.at(path.target(), went);
    fraction[path.row] = went;
    put(at + 3 * path.row, from);
    put(displacement + 3 * path.row, path.last_target(from) - from);
  }
};

// The start of the substep, and the vertices truncated by pairs; what a floor stops is not tried again.
template <class T>
struct Starts {
  StartInputs<T> in;
  const bool* stopped;  // [B, bodies]
  T* end;               // [B, V, 3]
  bool* is_truncated;   // [B, V]

  DIFFVBD_FN void operator()(int64_t scene, int32_t v) const {
    const StartPath<T> path{in, scene, v};
    put(end + 3 * path.row, path.end());
    const bool again = !in.pinned[v] && (in.pinned_bodies[in.body[v]] || !stopped[path.body]);
    is_truncated[path.row] =
        again && (in.fraction[path.row] < T(kTruncated) || in.last_fraction[path.row] < T(kTruncated));
  }
};

template <class T>
struct ReverseStarts {
  StartInputs<T> in;
  StartAdjoints<T> out;
  DIFFVBD_FN void operator()(int64_t scene, int32_t v) const { reverse_start(in, out, scene, v); }
};

}  // namespace diffvbd::contact
