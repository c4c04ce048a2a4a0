// Trust-region radii of bodies until the next detection, shared by CPU and CUDA. Islands depend on the radii and the
// radii on what an island leaves of a motion: from displacements to radii and islands, then radii relative to these and
// islands again (docs/method.md, section 12). Not differentiated.
#pragma once

#include <cstdint>

#include "islands.h"
#include "motion.h"
#include "passes.h"

namespace diffvbd::contact {

constexpr double kGrid = 0.125;      // of dhat: cells that the translation of an island is rounded to
constexpr double kMostCells = 1e15;  // integers hold them

template <class T>
struct RadiusInputs {
  MotionInputs<T> motion;
  IslandInputs<T> islands;        // without the radius
  const T *displacements, *sums;  // of find_motion
  const T *most, *most_own;       // [bodies] [m] bounds of both radii: see ContactSurface
  T factor, least, dhat;          // of a displacement, and added to it [m]
  bool self_contact;

  DIFFVBD_FN T displacement(DisplacementKind which, int64_t place) const {
    return displacements[which * motion.scenes * motion.bodies + place];
  }
};

// Memory of the rounds. Radii have a last column, the largest of the scene.
template <class T>
struct RadiusWork {
  T* pushed;                             // [B]  longest displacement of a collider's point
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

// The radius of a body that moves so far relative to its island. Prescribed vertices are not limited: their pairs are
// listed however far they go.
template <class T>
DIFFVBD_FN T trust_radius_of(const RadiusInputs<T>& in, const RadiusWork<T>& work, int64_t scene, int32_t body,
                             T relative) {
  const int64_t place = scene * in.motion.bodies + body;
  const T gravity = T(2) * in.displacement(kGravity, place);  // sweeps may take it back
  const T wished = in.factor * relative + gravity + in.least;
  return larger(smaller(wished, in.most[body]), in.displacement(kDriven, place)) + work.pushed[scene];
}
template <class T>
DIFFVBD_FN T& radius_at(const RadiusInputs<T>& in, T* trust_radii, int64_t scene, int32_t body) {
  return trust_radii[scene * (in.motion.bodies + 1) + body];
}

// The radius of a body that touches nothing.
template <class T>
DIFFVBD_FN void radius_alone(const RadiusInputs<T>& in, int64_t scene, int32_t body, const RadiusWork<T>& work) {
  const T bends = in.displacement(kBends, scene * in.motion.bodies + body);
  radius_at(in, work.trust_radius, scene, body) = trust_radius_of(in, work, scene, body, bends);
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
  const T relative = T(far[0]), stretched = in.displacement(kStretched, place);
  T& trust_radius = radius_at(in, work.trust_radius, b.scene, b.body);
  trust_radius = larger(trust_radius, trust_radius_of(in, work, b.scene, b.body, relative));
  T deformation_radius = T(0);
  if (in.self_contact) {
    deformation_radius = (in.factor + T(1)) * (in.displacement(kApart, place) + stretched) +
                         T(2) * in.displacement(kGravity, place) + in.least;
    deformation_radius = larger(smaller(deformation_radius, in.most_own[b.body]), in.displacement(kDriven, place));
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

}  // namespace diffvbd::contact
