// Which share of its rigid motion each body may take: it is tried, and tried again shorter, until nothing holds it up
// and the potential does not rise. Bodies decide this with those that they may come to press, and with no others
// (docs/method.md, section 18).
#pragma once

#include "rigid_rub.h"

namespace diffvbd::contact {

constexpr int kTries = 6;       // of motions, each shorter for some bodies, or none for them
constexpr int kShorter = 3;     // of these: how often a body whose way is blocked tries a shorter one before it stays
constexpr int kSpreads = 4;     // how often a shorter motion is handed on to the bodies that one touches
constexpr double kRise = 1e-9;  // of the potential, that counts as none
constexpr double kRounded = 1e-6;  // of a length, that rounding cannot reach

// The body that a pair counts for, which decides with all others that it moves: the first of them, or -1.
template <class T>
DIFFVBD_FN int32_t owner_of(const RigidInputs<T>& in, const int32_t* record) {
  const int32_t first = moving_body(in, record[0]);
  return 0 <= first ? first : moving_body(in, record[sides(record[4])]);
}

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

// Of a vertex, whatever share of its motion its body takes: how far it may be from where gaps were taken, and the size
// of its position, which rounding is measured by.
struct Farthest {
  double way, size;
};
template <class T>
DIFFVBD_FN Farthest farthest_of(const RigidInputs<T>& in, const rigid::Body<T>& b, int32_t v, const double* center,
                                const double* motion) {
  const Vector x = b.position(v), arm = x - rigid::Body<double>::at(center);
  const Vector since = x - rigid::Body<T>::at(in.gate.center + 3 * b.row(v));
  const Vector turn = rigid::Body<double>::at(motion), shift = rigid::Body<double>::at(motion + 3);
  const auto length = [](const Vector& a) { return square_root(dot(a, a)); };
  const Vec3<T> at = point_at(in.gate.x, b.row(v));
  const Vec3<T> from = in.gate.origin ? point_at(in.gate.origin, b.row(v)) : zero3<T>();
  const double way = length(since) + length(shift) + length(turn) * length(arm);
  return {(1 + kRounded) * way, size_of(at + from)};
}

// Whether a listed pair may come within reach of its barrier, whatever share of its motion each body takes: a gap
// shrinks by no more than its sides have moved since it was taken. way, size [bodies]: the farthest of their vertices.
template <class T>
DIFFVBD_FN bool may_press(const RigidInputs<T>& in, int64_t pair, const double* way, const double* size) {
  if (!is_between(in, pair)) return false;
  const int32_t* record = in.gate.listed.pairs + kPairRow * pair;
  const T* constants = in.gate.constants + kConstants * pair;
  const int32_t a = in.gate.body[record[0]], b = in.gate.body[record[sides(record[4])]];
  if (a >= in.bodies() || b >= in.bodies()) return true;  // its gap is not of the time of the centers
  const double gap = PairHints<T>(constants).gap - PairConstants<T>(constants).dhat;
  const T larger = static_cast<T>(size[a] < size[b] ? size[b] : size[a]);
  return !(way[a] + way[b] < (1 - kRounded) * (gap - guard_of_size(larger)));  // as stays_far()
}

// Whether bodies may go as they try: all fit, and their potential does not rise.
DIFFVBD_FN bool is_safe(double before, double after, bool fits) {
  return fits && after <= before + kRise * absolute(before);
}
// The factor of what a body tries next, before it is handed on.
DIFFVBD_FN double shortened(bool blocked, bool fits, int attempt) {
  if (fits) return 0.5;  // the potential rises: all go half as far
  if (!blocked) return 1.0;
  return attempt == 0 ? 0.5 : attempt < kShorter ? 0.25 : 0.0;
}

// What came of the tries, of each body [B, bodies].
template <class T>
struct RigidOutcome {
  double* share;  // of its motion that it took
  bool* moved;    // whether it had one
  // whether it was held up on its way, in a scene in which some of those have gone on: where these are now, others may
  // go on, too
  bool* held;
  T* left;  // how much of its shift it did not take [m]
};
// Of a body whose share is known; returns whether it was held up after some of its way. `held` is to be confirmed.
template <class T>
DIFFVBD_FN bool end_tries(const RigidInputs<T>& in, const double* motions, int64_t unit, const RigidOutcome<T>& out) {
  const double* motion = motions + kUnknowns * unit;
  bool moved = false;
  for (int i = 0; i < kUnknowns; ++i) moved = moved || motion[i] != 0;
  double& share = out.share[unit];
  if (in.moving && !moved) share = 0;  // what stays passes nothing on
  const Vector shift = rigid::Body<double>::at(motion + 3);
  out.moved[unit] = moved, out.held[unit] = moved && share < 1;
  out.left[unit] = T((1 - share) * square_root(dot(shift, shift)));
  return out.held[unit] && 0 < share;
}

}  // namespace diffvbd::contact
