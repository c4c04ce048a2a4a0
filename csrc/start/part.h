// A corrected body that planes hold back, in short steps. Its lowest vertex stops all of it far from where inertia
// takes the others, and few sweeps do not undo that where h^2 times the stiffness is small beside the mass: then its
// vertices go each by itself, as those of other bodies do (docs/method.md, section 14).
#pragma once

#include "begin.h"
#include "lower.h"

namespace diffvbd::start {

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
