// Trust-region radii of bodies until the next detection, shared by CPU and CUDA. Islands depend on the radii and the
// radii on what an island leaves of a motion, hence rounds: from displacements to radii and islands, then radii
// relative to these (docs/method.md, section 12). Not differentiated.
#pragma once

#include <cstdint>

#include "islands.h"
#include "motion.h"
#include "passes.h"

namespace diffvbd::contact {

constexpr int kRadiusRounds = 3;     // rounds of radii relative to islands, and islands by these radii
constexpr double kGrid = 0.125;      // of dhat: cells that the translation of an island is rounded to
constexpr double kMostCells = 1e15;  // integers hold them
constexpr double kSpare = 2;         // of dhat, added to what a body asks for: others may push it

template <class T>
struct RadiusInputs {
  MotionInputs<T> motion;
  IslandInputs<T> islands;                            // without the radius
  const T *displacements, *sums;                      // of find_motion
  const T *most, *most_alone, *most_own, *least_own;  // [bodies] [m] bounds of the radii: see ContactSurface
  T fraction, least, dhat;                            // of a displacement, and added to it [m]
  bool self_contact;

  DIFFVBD_FN T displacement(DisplacementKind which, int64_t place) const {
    return displacements[which * motion.scenes * motion.bodies + place];
  }
};

// Memory of the rounds. Radii have a last column, the largest of the scene.
template <class T>
struct RadiusWork {
  T* pushed;                             // [B]  longest displacement of a collider's point
  T* most;                               // [B, bodies]
  int32_t* island;                       // [B, bodies]  results from here on
  T* u;                                  // [B, bodies, 3]
  T *trust_radius, *deformation_radius;  // [B, bodies + 1]
};

template <class T, class Team>
DIFFVBD_FN void prepare_scene(const RadiusInputs<T>& in, int64_t scene, const Team& team, const RadiusWork<T>& work) {
  const int32_t points = in.islands.colliders();
  double pushed[1];
  team.template most<1>(points, pushed, [&](int32_t j, double* of) {
    const int64_t row = 3 * (scene * points + j);
    of[0] = length(wide_at(in.islands.collider_next + row) - wide_at(in.islands.collider + row));
  });
  if (team.leads()) work.pushed[scene] = T(pushed[0]);
}

// The radius that a body asks for which moves so far relative to its island.
template <class T>
DIFFVBD_FN T asked(const RadiusInputs<T>& in, int64_t place, T relative) {
  return in.fraction * relative + T(2) * in.displacement(kGravity, place) + in.least;  // sweeps may take back gravity
}
// The radius that it gets. Prescribed vertices are not limited: their pairs are listed however far they go.
template <class T>
DIFFVBD_FN T trust_radius_of(const RadiusInputs<T>& in, const RadiusWork<T>& work, int64_t place, T relative, T most) {
  const T wished = asked(in, place, relative) + T(kSpare) * in.dhat;
  const T trust_radius = larger(smaller(wished, most), in.displacement(kDriven, place));
  return trust_radius + work.pushed[place / in.motion.bodies];
}
template <class T>
DIFFVBD_FN T& radius_at(const RadiusInputs<T>& in, T* trust_radii, int64_t scene, int32_t body) {
  return trust_radii[scene * (in.motion.bodies + 1) + body];
}

// The radius that a body asks for if it touches nothing.
template <class T>
DIFFVBD_FN void wish_of_body(const RadiusInputs<T>& in, int64_t scene, int32_t body, const RadiusWork<T>& work) {
  const int64_t place = scene * in.motion.bodies + body;
  const T bends = in.displacement(kBends, place);
  radius_at(in, work.trust_radius, scene, body) = trust_radius_of(in, work, place, bends, in.most_alone[body]);
}

// Whether a body asks for more than the bound of one with neighbours.
template <class T>
DIFFVBD_FN bool wants_more(const RadiusInputs<T>& in, const RadiusWork<T>& work, int64_t scene, int32_t body) {
  const int64_t place = scene * in.motion.bodies + body;
  const T wanted = asked(in, place, in.displacement(kBends, place)) + in.fraction * in.displacement(kStretched, place);
  return !(wanted <= in.most[body]);
}

// A body that is alone in a larger radius has it: it costs no pairs.
template <class T>
DIFFVBD_FN void radius_among_others(const RadiusInputs<T>& in, const RadiusWork<T>& work, int64_t scene, int32_t body,
                                    bool looked) {
  const int32_t* island = work.island + scene * in.motion.bodies;
  const int64_t place = scene * in.motion.bodies + body;
  bool alone = looked && island[body] >= 0;
  for (int32_t b = 0; b < in.motion.bodies && alone; ++b) alone = b == body || island[b] != island[body];
  work.most[place] = alone ? in.most_alone[body] : in.most[body];
  radius_at(in, work.trust_radius, scene, body) =
      trust_radius_of(in, work, place, in.displacement(kBends, place), work.most[place]);
}

// The translation of a body's island: the mean of the wanted displacements, rounded to a grid and so discrete.
template <class T, class Team>
DIFFVBD_FN Vector island_translation(const RadiusInputs<T>& in, const MovingBody<T>& b, const Team& team,
                                     const RadiusWork<T>& work) {
  const int64_t first = b.scene * in.motion.bodies;
  const int32_t own = work.island[b.place()];
  double sum[4];
  team.template sum<4>(own < 0 ? 0 : in.motion.bodies, sum, [&](int32_t k, double* to) {
    if (work.island[first + k] != own) return;
    for (int i = 0; i < 4; ++i) to[i] += in.sums[4 * (first + k) + i];
  });
  const double mass = larger(sum[3], double(std::numeric_limits<T>::min())), grid = kGrid * double(in.dhat);
  const auto rounded = [&](double momentum) {
    const double cells = momentum / mass / grid;
    return absolute(cells) < kMostCells ? grid * double(static_cast<int64_t>(cells)) : 0.0;  // NaN: 0
  };
  return {rounded(sum[0]), rounded(sum[1]), rounded(sum[2])};
}
template <class T, class Team>
DIFFVBD_FN void write_translation(const RadiusInputs<T>& in, const MovingBody<T>& b, const Team& team,
                                  const RadiusWork<T>& work) {
  const Vector u = island_translation(in, b, team, work);
  if (team.leads()) put(work.u + 3 * b.place(), u);
}

// The radius relative to a moving island.
template <class T, class Team>
DIFFVBD_FN void radius_beside_island(const RadiusInputs<T>& in, const MovingBody<T>& b, const Team& team,
                                     const RadiusWork<T>& work) {
  const int64_t place = b.place();
  const Vector u = island_translation(in, b, team, work);
  double far[1];
  team.template most<1>(b.size(), far,
                        [&](int32_t i, double* of) { of[0] = b.is_free(i) ? length(b.displacement(i) - u) : 0.0; });
  if (!team.leads()) return;
  const T relative = T(far[0]), stretched = in.displacement(kStretched, place), most = work.most[place];
  T& trust_radius = radius_at(in, work.trust_radius, b.scene, b.body);
  trust_radius = larger(trust_radius, trust_radius_of(in, work, place, relative, most));
  T deformation_radius = T(0);
  if (in.self_contact) {
    deformation_radius = (in.fraction + T(1)) * (in.displacement(kApart, place) + stretched) +
                         T(2) * in.displacement(kGravity, place) + in.least;
    deformation_radius =
        larger(smaller(deformation_radius, in.most_own[b.body]), smaller(trust_radius, in.least_own[b.body]));
    deformation_radius = larger(deformation_radius, in.displacement(kDriven, place));
  }
  radius_at(in, work.deformation_radius, b.scene, b.body) = deformation_radius;
}

// The end: no collider pushes an island that may translate. Then the last column of both radii.
template <class T, class Team>
DIFFVBD_FN void finish_radii(const RadiusInputs<T>& in, int64_t scene, const Team& team, const RadiusWork<T>& work) {
  double most[2];
  team.template most<2>(in.motion.bodies, most, [&](int32_t k, double* of) {
    T& trust_radius = radius_at(in, work.trust_radius, scene, k);
    if (0 <= work.island[scene * in.motion.bodies + k]) trust_radius -= work.pushed[scene];
    of[0] = trust_radius, of[1] = radius_at(in, work.deformation_radius, scene, k);
  });
  if (!team.leads()) return;
  radius_at(in, work.trust_radius, scene, in.motion.bodies) = T(most[0]);
  radius_at(in, work.deformation_radius, scene, in.motion.bodies) = T(most[1]);
}

// Radii of the sweeps of a substep: by the displacements that the substep has wanted, within what is left of the radii
// of the detection.

template <class T>
struct SweepRadiusInputs {
  const T *x, *start, *begin, *move, *gravity_move;  // [B, V, 3] [m]: where the sweeps begin, where the start of the
                                                     // part led, where the part began, and what it wanted of a vertex
  const T *apart, *stretched;                        // [B, bodies] [m]
  const T *center, *trust_radius;                    // [B, V, 3], [B, V] [m]
  const T *deformation_center,
      *deformation_radius;     // the same relative to the rigid motion; null without self-contact
  const bool* pinned;          // [V]
  const int32_t *order, *ptr;  // [V], [bodies + 1]
  int64_t scenes, vertices, bodies;
  T more, least;  // factor of what sweeps take back, and what is added [m]
};

// Squares of the longest displacements: truncated by pairs, made by a correction, and by gravity.
template <class T>
struct SweepDisplacements {
  T truncated, corrected, fallen;
  DIFFVBD_FN void keep(const SweepDisplacements& other) {
    truncated = larger(truncated, other.truncated), corrected = larger(corrected, other.corrected);
    fallen = larger(fallen, other.fallen);
  }
};

// The squares of every `stride`-th vertex of a body from `first` on.
template <class T>
DIFFVBD_FN SweepDisplacements<T> displacements_of_body(const SweepRadiusInputs<T>& in, int64_t scene, int64_t body,
                                                       int32_t first, int32_t stride) {
  SweepDisplacements<T> out{T(0), T(0), T(0)};
  for (int64_t k = int64_t{in.ptr[body]} + first; k < in.ptr[body + 1]; k += stride) {
    const int32_t v = in.order[k];
    if (in.pinned[v]) continue;
    const int64_t i = scene * in.vertices + v;
    const Vec3<T> start = vector_at(in.start + 3 * i), gravity_move = vector_at(in.gravity_move + 3 * i);
    const Vec3<T> left = vector_at(in.begin + 3 * i) + vector_at(in.move + 3 * i) + gravity_move - start,
                  displacement = vector_at(in.x + 3 * i) - start;
    out.keep({dot(left, left), dot(displacement, displacement), dot(gravity_move, gravity_move)});
  }
  return out;
}

template <class T>
DIFFVBD_FN T wish_of_body(const SweepRadiusInputs<T>& in, const SweepDisplacements<T>& displacements, int64_t row) {
  return square_root(displacements.fallen) + in.apart[row] + in.more * square_root(displacements.truncated) +
         square_root(displacements.corrected) + in.more * in.stretched[row];
}

// The most of every `stride`-th body of a scene: bodies push one another.
template <class T>
DIFFVBD_FN T most_of_scene(const SweepRadiusInputs<T>& in, const T* wishes, int64_t scene, int32_t first,
                           int32_t stride) {
  T out = T(0);
  for (int64_t body = first; body < in.bodies; body += stride) out = larger(out, wishes[scene * in.bodies + body]);
  return out;
}

// The radius of one vertex, where `most` is that of its scene.
template <class T>
DIFFVBD_FN T sweep_radius(const SweepRadiusInputs<T>& in, T most, int64_t scene, int64_t v) {
  if (in.pinned[v]) return T(0);
  const int64_t i = scene * in.vertices + v;
  const Vec3<T> x = vector_at(in.x + 3 * i), displacement = x - vector_at(in.center + 3 * i);
  T trust_radius = smaller(in.trust_radius[i] - square_root(dot(displacement, displacement)), in.least + most);
  if (in.deformation_radius) {
    const Vec3<T> own = x - vector_at(in.deformation_center + 3 * i);
    trust_radius = smaller(trust_radius, in.deformation_radius[i] - square_root(dot(own, own)));
  }
  return trust_radius < T(0) ? T(0) : trust_radius;
}

}  // namespace diffvbd::contact
