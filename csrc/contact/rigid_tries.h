// Which share of its rigid motion each body may take: it is tried, and tried again shorter, until nothing holds it up
// and the potential of the scene does not rise (docs/method.md, section 18).
#pragma once

#include "rigid_rub.h"

namespace diffvbd::contact {

constexpr int kTries = 6;       // of motions, each shorter for some bodies, or none for them
constexpr int kShorter = 3;     // of these: how often a body whose way is blocked tries a shorter one before it stays
constexpr int kSpreads = 4;     // how often a shorter motion is handed on to the bodies that one touches
constexpr double kRise = 1e-9;  // of the potential, that counts as none

// Whether the energies of a vertex admit what it tries.
template <class T>
DIFFVBD_FN bool admitted(const RigidInputs<T>& in, const rigid::Body<T>& b, int32_t v) {
  const VertexState<double> s = b.state(v, CornerPoints<T>{in, true}.relative(b.scene, v));
  bool out = true;
  b.energies(v, [&](auto energy, int, const double* data, int count) {
    using E = decltype(energy);
    if constexpr (E::has_filter) out = out && E::template admits<T>(s, b.position(v), data, count, rigid::kLeastShare);
  });
  return out;
}

// Whether a scene may go as it tries: all fit, and its potential does not rise.
DIFFVBD_FN bool is_safe(double before, double after, bool fits) {
  return fits && after <= before + kRise * absolute(before);
}
// The factor of what a body tries next, before it is handed on.
DIFFVBD_FN double shortened(bool blocked, bool fits, int attempt) {
  if (fits) return 0.5;  // the potential rises: all go half as far
  if (!blocked) return 1.0;
  return attempt == 0 ? 0.5 : attempt < kShorter ? 0.25 : 0.0;
}

}  // namespace diffvbd::contact
