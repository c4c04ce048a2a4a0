// The passes of contact over a color: sum the pairs of a vertex, limit its motion, and the adjoints of both. A vertex
// may share pairs with others of its color: all of a color read the state before any moves (docs/method.md, section
// 12).
#pragma once

#include "../core/views.h"
#include "detection.h"
#include "friction.h"
#include "limit.h"

namespace diffvbd::contact {

// Pairs of all scenes, sorted by scene; `corners` corner points a scene: its vertices, then those of colliders.
struct PairList {
  const int32_t* pairs = nullptr;  // [pairs, 6]  four corner points, kind, scene
  const int32_t* ptr = nullptr;    // [scenes corners + 1]
  const int32_t* entry = nullptr;  // [4 pairs]  4 pair + corner, for each corner point in ascending order
  // If a backend tracks near pairs (cpu/near.h), the near entries of one scene: for each corner point the first
  // near_count[row - near_row], from its place in `entry` less the near_start entries of earlier scenes.
  const int32_t *near = nullptr, *near_count = nullptr;
  int64_t near_row = 0, near_start = 0;

  struct Entries {
    const int32_t* first;
    int count;
  };
  DIFFVBD_FN Entries of(int64_t row) const {
    if (near) return {near + (ptr[row] - near_start), near_count[row - near_row]};
    return {entry + ptr[row], ptr[row + 1] - ptr[row]};
  }
};
constexpr int kFloorLag = 4;

template <class T>
struct ContactInputs {
  int64_t corners = 0;
  int32_t num_vertices = 0;
  PairList listed, lagged;                   // of the last detection; of the first one of the step
  const T* constants = nullptr;              // [pairs, 8]  of the listed
  const T* lag = nullptr;                    // [pairs, kLagScalars]  of the lagged
  Batched<const T> kappa;                    // [B]
  Batched<const T> collider, collider_prev;  // [B, Vc, 3]  during the sweeps; at the start of the step
  const T* center = nullptr;                 // [B, V, 3]  where it starts
  const T* trust_radius = nullptr;           // [B, V]  how far from there it may go [m]
  Batched<const T> floor_lag;                // [B, V, planes, 4]  coefficient times normal force, normal
  int planes = 0;
  Batched<const T> x_prev, origin;  // [B, V, 3]; origin may be null
  T friction_eps = T(0);            // motion in a step below which friction is smoothed [m]

  DIFFVBD_FN Vec3<T> center_of(int64_t scene, int v) const {
    return vector_at(center + 3 * (scene * num_vertices + v));
  }
  // The entries of a vertex among the lagged pairs.
  DIFFVBD_FN PairList::Entries lags_of(int64_t scene, int v) const {
    return lag ? lagged.of(scene * corners + v) : PairList::Entries{nullptr, 0};
  }
};

// The adjoints that pairs scatter; zero at first. Slot 4 pair + i belongs to corner i, its only writer.
template <class T>
struct ContactAdjoints {
  T *rows = nullptr, *lag_rows = nullptr;  // [4 pairs, 4, 3]  toward each corner
  T* kappa = nullptr;                      // [4 pairs]
  T* lag = nullptr;                        // [4 pairs, kLagScalars]
  T* floor_lag = nullptr;                  // [B, V, planes, 4]
  T* prev = nullptr;                       // [B, corners, 3]  toward the start of the step
  // [4 pairs, 4], zero at first: for each corner, whose slots hold an adjoint for it; other `rows` are undefined
  uint8_t* scattered = nullptr;
};

// The pair that bears the friction and damping of a listed one: of the faces of another body that are near a point the
// one that presses it most, with the load of all of them; any other pair by itself. lag [pairs, kLagScalars], body [N].
template <class T>
struct Load {
  int64_t bearer;
  T force;  // 0 where another pair is the bearer
};
template <class T>
DIFFVBD_FN Load<T> load_of(const PairList& listed, int64_t corners, const int32_t* body, const T* lag, int64_t pair) {
  const auto force = [&](int64_t at) { return lag[kLagScalars * at]; };
  const int32_t* record = listed.pairs + kPairRow * pair;
  const int32_t point = record[0], face = body[record[1]];
  if (lag[kLagScalars * pair + 1] == T(0)) return {pair, T(0)};  // beyond dhat, as most are
  if (record[4] != kPointTriangle || body[point] == face) return {pair, force(pair)};
  const PairList::Entries near = listed.of(record[5] * corners + point);
  int64_t bearer = -1;
  T total = T(0);
  for (int e = 0; e < near.count; ++e) {
    const int64_t other = near.first[e] >> 2;
    const int32_t* its = listed.pairs + kPairRow * other;
    if (its[0] != point || its[4] != kPointTriangle || body[its[1]] != face) continue;
    total = total + force(other);
    if (bearer < 0 || force(bearer) < force(other)) bearer = other;
  }
  return {bearer, pair == bearer && T(0) < total ? total : T(0)};
}

template <class T>
DIFFVBD_FN T length_of(const Vec3<T>& a) {
  return square_root(dot(a, a));
}
// All are read before any is written: a device waits for memory once.
template <int n, class T>
DIFFVBD_FN void add_at(T* p, const T (&values)[n]) {
  T before[n];
  for (int i = 0; i < n; ++i) before[i] = p[i];
  for (int i = 0; i < n; ++i) p[i] = before[i] + values[i];
}

// The largest square of how far a corner of the first side, which has so many, and one of the second have moved apart.
template <class T, class Moved>
DIFFVBD_FN T farthest_apart(int first, const Moved& moved) {
  Vec3<T> displacement[4];
  for (int k = 0; k < 4; ++k) displacement[k] = moved(k);
  T most = T(0);
  each_across(first, [&](int i, int j) {
    const Vec3<T> d = displacement[i] - displacement[j];
    const T square = dot(d, d);
    most = most < square ? square : most;
  });
  return most;
}

// Whether the gap of a listed pair is certainly above a length, by moved(k) of its corners since the gap was taken:
// closest points move apart no farther than corners.
template <class T, class Moved>
DIFFVBD_FN bool is_above(int kind, const Moved& moved, const T* constants, T length) {
  const T slack = PairHints<T>(constants).gap - length;
  return T(0) < slack && T(1 + 1e-6) * farthest_apart<T>(sides(kind), moved) < slack * slack;
}

// The corner points of one scene. The backend's are x(v) of a vertex; in a sum over pairs together(v, u), whether both
// are of one color; and, where a color has moved, goes(v), whether v was of it: x(v) is then where it was before.
template <class T, class Positions>
struct Source {
  const ContactInputs<T>& in;
  int64_t scene;
  const Positions& positions;

  DIFFVBD_FN Vec3<T> x(int v) const {
    return v < in.num_vertices ? positions(v)
                               : vector_at(in.collider.data + scene * in.collider.scene + 3 * (v - in.num_vertices));
  }
  DIFFVBD_FN Vec3<T> x_prev(int v) const {
    return vector_at(v < in.num_vertices
                         ? in.x_prev.data + scene * in.x_prev.scene + int64_t{3} * v
                         : in.collider_prev.data + scene * in.collider_prev.scene + 3 * (v - in.num_vertices));
  }
  DIFFVBD_FN Vec3<T> origin(int v) const {
    if (in.origin.data == nullptr || v >= in.num_vertices) return zero3<T>();
    return vector_at(in.origin.data + scene * in.origin.scene + int64_t{3} * v);
  }
  DIFFVBD_FN Corners<T> corners(const int32_t* pair) const {
    const Vec3<T> x0 = x(pair[0]), o0 = origin(pair[0]);
    Corners<T> out;
    out.x[0] = zero3<T>();
    for (int k = 1; k < 4; ++k) out.x[k] = (x(pair[k]) - x0) + (origin(pair[k]) - o0);
    return out;
  }
  // How many corners of a pair move at once with vertex v, which is one of them; those that repeat count once.
  DIFFVBD_FN T together(const int32_t* pair, int v) const {
    int count = 0;
    for (int k = 0; k < 4; ++k) {
      count += pair[k] < in.num_vertices && !is_repeated(pair, k) && positions.together(pair[k], v);
    }
    return T(count);
  }
  // The displacement of a corner point since gaps were taken, at the start of the substep.
  DIFFVBD_FN Vec3<T> moved(int v) const {
    return v < in.num_vertices ? positions(v) - in.center_of(scene, v) : zero3<T>();
  }
  DIFFVBD_FN bool is_above(const int32_t* pair, const T* constants, T length) const {
    return contact::is_above(pair[4], [&](int k) { return moved(pair[k]); }, constants, length);
  }
  DIFFVBD_FN bool is_far(const int32_t* pair, const T* constants) const {
    return is_above(pair, constants, PairConstants<T>(constants).dhat);
  }
  DIFFVBD_FN Vec3<T> motion(const int32_t* pair, const Lag<T>& a) const {
    Vec3<T> m = zero3<T>();
    for (int k = 0; k < 4; ++k) {
      if (a.w[k] != T(0)) m += a.w[k] * (x(pair[k]) - x_prev(pair[k]));
    }
    return m;
  }
};

// A lower bound of the gap of an entry's pair [m], by the displacements since it was taken.
template <class T, class Positions>
DIFFVBD_FN T least_gap(const Source<T, Positions>& s, int64_t entry) {
  const int64_t pair = entry >> 2;
  const int32_t* record = s.in.listed.pairs + kPairRow * pair;
  const T most = farthest_apart<T>(sides(record[4]), [&](int k) { return s.moved(record[k]); });
  constexpr float kRounded = 1 + 2e-6F;  // of a root in single precision
  return PairHints<T>(s.in.constants + kConstants * pair).gap - T(kRounded * square_root(static_cast<float>(most)));
}
template <class T>
DIFFVBD_FN T dhat_of(const ContactInputs<T>& in, int64_t entry) {
  return PairConstants<T>(in.constants + kConstants * (entry >> 2)).dhat;
}
// Whether friction or damping of an entry's lagged pair may act.
template <class T>
DIFFVBD_FN bool is_lagging(const ContactInputs<T>& in, int64_t entry) {
  return Lag<T>(in.lag + kLagScalars * (entry >> 2)).active();
}

// Whether the barrier of an entry's pair may push.
template <class T, class Positions>
DIFFVBD_FN bool is_near(const Source<T, Positions>& s, int64_t entry) {
  const int64_t pair = entry >> 2;
  return !s.is_far(s.in.listed.pairs + kPairRow * pair, s.in.constants + kConstants * pair);
}

// Adds the barrier of a pair of vertex v to g and H.
template <class T, class Positions>
DIFFVBD_FN void add_barrier_of(const Source<T, Positions>& s, int64_t entry, int v, T h, Vec3<T>& g, Sym3<T>& H) {
  const ContactInputs<T>& in = s.in;
  const int64_t pair = entry >> 2;
  const int32_t* record = in.listed.pairs + kPairRow * pair;
  const Corners<T> c = s.corners(record);
  add_barrier(record[4], c, distance(record[4], c), static_cast<int>(entry & 3), s.together(record, v),
              PairConstants<T>(in.constants + kConstants * pair), in.kappa.data[s.scene * in.kappa.scene], h * h, g, H);
}

// Adds the lagged pair of an entry of vertex v to g and H.
template <class T, class Positions>
DIFFVBD_FN void add_lag_of(const Source<T, Positions>& s, int64_t entry, int v, T h, Vec3<T>& g, Sym3<T>& H) {
  const ContactInputs<T>& in = s.in;
  const int64_t pair = entry >> 2;
  const Lag<T> lag(in.lag + kLagScalars * pair);
  if (!lag.active()) return;
  const int32_t* record = in.lagged.pairs + kPairRow * pair;
  const int own = static_cast<int>(entry & 3);
  add_lagged(lag, own, s.together(record, v), s.motion(record, lag), h, in.friction_eps, g, H);
}
// Adds friction on the floor's planes: every `stride`-th plane from `first` on.
template <class T, class Positions>
DIFFVBD_FN void add_floor_lags(const Source<T, Positions>& s, int v, int first, int stride, T h, Vec3<T>& g,
                               Sym3<T>& H) {
  for (int k = first; k < s.in.planes; k += stride) {
    const Lag<T> lag = floor_lag(s, v, k);
    if (lag.active()) add_lagged(lag, 0, T(1), s.x(v) - s.x_prev(v), h, s.in.friction_eps, g, H);
  }
}
// Adds all lagged friction and damping at vertex v.
template <class T, class Positions>
DIFFVBD_FN void add_lags(const Source<T, Positions>& s, int v, T h, Vec3<T>& g, Sym3<T>& H) {
  const PairList::Entries lagged = s.in.lags_of(s.scene, v);
  for (int e = 0; e < lagged.count; ++e) add_lag_of(s, lagged.first[e], v, h, g, H);
  add_floor_lags(s, v, 0, 1, h, g, H);
}

// The trust region of a vertex. It does not depend on the update.
template <class T>
struct TrustRegion {
  Vec3<T> center, origin;
  T size;  // [m]
  TrustRegion() = default;
  template <class Positions>
  DIFFVBD_FN TrustRegion(const Source<T, Positions>& s, int v)
      : center(s.in.center_of(s.scene, v)),
        origin(s.origin(v)),
        size(s.in.trust_radius[s.scene * s.in.num_vertices + v]) {}
  // The exponent of the limit of an update that goes by d from where the vertex was.
  DIFFVBD_FN int limit(const Vec3<T>& from, const Vec3<T>& d) const { return limit_by_radius(from - center, d, size); }
  // The uncertainty of its height by rounding [m].
  DIFFVBD_FN T guard(const Vec3<T>& from) const {
    const Vec3<T> at = from + origin;
    return T(kGuardUlps) * std::numeric_limits<T>::epsilon() * (absolute(at.x) + absolute(at.y) + absolute(at.z));
  }
};

// Whether a pair may take more from the update of one of its corners than `exponent` does, by the length of d.
template <class T, class Positions>
DIFFVBD_FN bool may_limit(const Source<T, Positions>& s, int64_t entry, T length, T guard, int exponent) {
  const int64_t pair = entry >> 2;
  const int32_t* record = s.in.listed.pairs + kPairRow * pair;
  return is_limiting(record) && !s.is_above(record, s.in.constants + kConstants * pair,
                                            limit_of<T>(exponent) * length / T(kBothGapFraction) + guard);
}

// The exponent of the limit by one of the vertex's pairs, not below `exponent`, by the length of d and the guard of v.
template <class T, class Positions>
DIFFVBD_FN int limit_by_pair(const Source<T, Positions>& s, int entry, const Vec3<T>& d, T length, T guard,
                             int exponent) {
  const ContactInputs<T>& in = s.in;
  const int pair = entry >> 2, own = entry & 3;
  const int32_t* record = in.listed.pairs + int64_t{kPairRow} * pair;
  const T* constants = in.constants + int64_t{kConstants} * pair;
  const int sides_first = sides(record[4]);
  if (!is_limiting(record)) return exponent;
  bool both = false, alone = true;
  for (int k = 0; k < 4; ++k) {
    if (k == own || record[k] >= in.num_vertices || !s.positions.goes(record[k])) continue;
    alone = false;
    both = both || (k < sides_first) != (own < sides_first);
  }
  const T fraction = both ? T(kBothGapFraction) : T(kGapFraction);
  if (s.is_above(record, constants, limit_of<T>(exponent) * length / fraction + guard)) return exponent;
  const Gate<T> gate(record[4], s.corners(record), constants, guard);
  const T fractions[4] = {fraction, fraction, fraction, fraction};
  Vec3<T> displacement[4] = {zero3<T>(), zero3<T>(), zero3<T>(), zero3<T>()};
  while (exponent < kNoMove) {
    displacement[own] = limit_of<T>(exponent) * d;
    // corners that go at once are limited one by one: what proves them safe together is one plane for all of them
    if (alone ? gate.holds(displacement, fractions, false) : gate.holds(gate.n, displacement, fractions, false, true))
      break;
    ++exponent;
  }
  return exponent;
}

// Friction on a floor plane: the vertex alone, about the plane's normal.
template <class T, class Positions>
DIFFVBD_FN Lag<T> floor_lag(const Source<T, Positions>& s, int v, int plane) {
  const T* a = s.in.floor_lag.data + s.scene * s.in.floor_lag.scene + (int64_t{v} * s.in.planes + plane) * kFloorLag;
  Lag<T> out;
  out.friction = a[0], out.damping = T(0);
  out.n = {a[1], a[2], a[3]};
  for (int k = 0; k < 4; ++k) out.w[k] = k == 0 ? T(1) : T(0);
  return out;
}

// The adjoints of these passes scatter to the corners of pairs. In the reverse all p of a color are known before any is
// scattered.

// A value that another multiprocessor of a device may have written during the launch: it is in the L2 cache.
template <class U>
DIFFVBD_FN U fresh(const U* p) {
#if defined(__CUDA_ARCH__)
  return __ldcg(p);
#else
  return *p;
#endif
}
template <class T>
DIFFVBD_FN Vec3<T> fresh_vector(const T* p) {
  return {fresh(p), fresh(p + 1), fresh(p + 2)};
}

// Adds to the slots of an entry the adjoints of the corners of its pair. It reads all before it writes.
template <class T>
DIFFVBD_FN void scatter(const ContactAdjoints<T>& out, int64_t entry, const Vec3<T> (&bar)[4]) {
  T* slots = out.rows + 12 * entry;
  uint8_t* flags = out.scattered + 16 * (entry >> 2) + (entry & 3);
  bool holds[4];
  Vec3<T> before[4];
  for (int k = 0; k < 4; ++k) holds[k] = fresh(flags + 4 * k);
  for (int k = 0; k < 4; ++k) before[k] = holds[k] ? vector_at(slots + 3 * k) : zero3<T>();
  for (int k = 0; k < 4; ++k) {
    const Vec3<T> sum = before[k] + bar[k];
    slots[3 * k] = sum.x, slots[3 * k + 1] = sum.y, slots[3 * k + 2] = sum.z;
    flags[4 * k] = 1;
  }
}

// The adjoint of what add_barrier_of() added, into the slots of the pair.
template <class T, class Positions>
DIFFVBD_FN void reverse_barrier_of(const Source<T, Positions>& s, const ContactAdjoints<T>& out, int64_t entry, int v,
                                   T h, const Vec3<T>& p, const Vec3<T>& d_raw) {
  const ContactInputs<T>& in = s.in;
  const int64_t pair = entry >> 2;
  const int32_t* record = in.listed.pairs + kPairRow * pair;
  PairAdjoint<T> bar;
  if (!reverse_barrier(record[4], s.corners(record), static_cast<int>(entry & 3), s.together(record, v),
                       PairConstants<T>(in.constants + kConstants * pair), in.kappa.data[s.scene * in.kappa.scene],
                       h * h, p, d_raw, bar)) {
    return;
  }
  scatter(out, entry, bar.x);
  out.kappa[entry] += bar.kappa;
}

// The adjoint of what add_lag_of() added.
template <class T, class Positions>
DIFFVBD_FN void reverse_lag_of(const Source<T, Positions>& s, const ContactAdjoints<T>& out, int64_t entry, int v, T h,
                               const Vec3<T>& p, const Vec3<T>& d_raw) {
  const ContactInputs<T>& in = s.in;
  const int64_t pair = entry >> 2;
  const Lag<T> lag(in.lag + kLagScalars * pair);
  const int32_t* record = in.lagged.pairs + kPairRow * pair;
  const Vec3<T> m = s.motion(record, lag);
  Lag<T> bar;
  const Vec3<T> m_bar =
      reverse_lagged(lag, static_cast<int>(entry & 3), s.together(record, v), m, h, in.friction_eps, p, d_raw, bar);
  T by_lag[kLagScalars] = {bar.friction, bar.damping, bar.n.x, bar.n.y, bar.n.z};
  T* rows = out.lag_rows + 12 * entry;
  Vec3<T> sum[4];
  for (int k = 0; k < 4; ++k) {
    by_lag[5 + k] = bar.w[k] + dot(m_bar, s.x(record[k]) - s.x_prev(record[k]));
    sum[k] = fresh_vector(rows + 3 * k) + lag.w[k] * m_bar;
  }
  for (int k = 0; k < 4; ++k) rows[3 * k] = sum[k].x, rows[3 * k + 1] = sum[k].y, rows[3 * k + 2] = sum[k].z;
  add_at(out.lag + kLagScalars * entry, by_lag);
}
// The adjoint of what add_floor_lags() added, and what of it goes to v itself.
template <class T, class Positions>
DIFFVBD_FN void reverse_floor_lags(const Source<T, Positions>& s, const ContactAdjoints<T>& out, int v, int first,
                                   int stride, T h, const Vec3<T>& p, const Vec3<T>& d_raw, Vec3<T>& own) {
  const ContactInputs<T>& in = s.in;
  for (int k = first; k < in.planes; k += stride) {
    Lag<T> bar;
    const Vec3<T> m_bar =
        reverse_lagged(floor_lag(s, v, k), 0, T(1), s.x(v) - s.x_prev(v), h, in.friction_eps, p, d_raw, bar);
    T* to = out.floor_lag + ((s.scene * in.num_vertices + v) * in.planes + k) * kFloorLag;
    to[0] += bar.friction;
    add_to(to + 1, bar.n);
    own += m_bar;
  }
}
// The adjoint of add_lags().
template <class T, class Positions>
DIFFVBD_FN void reverse_lags(const Source<T, Positions>& s, const ContactAdjoints<T>& out, int v, T h, const Vec3<T>& p,
                             const Vec3<T>& d_raw, Vec3<T>& own) {
  const PairList::Entries lagged = s.in.lags_of(s.scene, v);
  for (int e = 0; e < lagged.count; ++e) reverse_lag_of(s, out, lagged.first[e], v, h, p, d_raw);
  reverse_floor_lags(s, out, v, 0, 1, h, p, d_raw, own);
}

// The flags of an entry, one byte for each corner, as one word.
template <class T>
DIFFVBD_FN uint32_t& flags_of(const ContactAdjoints<T>& out, int64_t entry) {
  return *reinterpret_cast<uint32_t*>(out.scattered + 4 * entry);
}

// Sums what the slots of all corners of a pair hold for the corner of an entry, where the bytes of `holds` say so.
constexpr uint32_t kAllScattered = 0x01010101;
template <class T>
DIFFVBD_FN Vec3<T> gathered_for(const T* rows, int64_t entry, uint32_t holds, Vec3<T> sum) {
  Vec3<T> own[4];
  for (int i = 0; i < 4; ++i) {
    own[i] = holds >> 8 * i & 1 ? fresh_vector(rows + (16 * (entry >> 2) + 4 * i + (entry & 3)) * 3) : zero3<T>();
  }
  for (int i = 0; i < 4; ++i) {
    if (holds >> 8 * i & 1) sum += own[i];
  }
  return sum;
}
// Gathers what pairs have scattered to corner point v since the last call, and clears it: `now` is toward the state,
// `prev` toward the start of the step.
template <class T>
DIFFVBD_FN void gather_pairs(const ContactInputs<T>& in, const ContactAdjoints<T>& out, int64_t scene, int v, int first,
                             int stride, Vec3<T>& now, Vec3<T>& prev) {
  const int64_t row = scene * in.corners + v;
  const PairList::Entries listed = in.listed.of(row);
  constexpr int kAhead = 4;  // read before any is written: a device waits for memory once
  for (int e = first; e < listed.count; e += kAhead * stride) {
    int64_t entry[kAhead];
    uint32_t holds[kAhead];
    for (int a = 0; a < kAhead; ++a) entry[a] = e + a * stride < listed.count ? listed.first[e + a * stride] : -1;
    for (int a = 0; a < kAhead; ++a) holds[a] = entry[a] < 0 ? 0 : fresh(&flags_of(out, entry[a]));
    for (int a = 0; a < kAhead; ++a) {
      if (holds[a] == 0) continue;
      now = gathered_for(out.rows, entry[a], holds[a], now);
      flags_of(out, entry[a]) = 0;
    }
  }
  Vec3<T> moved = zero3<T>();
  const PairList::Entries lagged = in.lags_of(scene, v);
  for (int e = first; e < lagged.count; e += stride) {
    const int64_t entry = lagged.first[e];
    moved = gathered_for(out.lag_rows, entry, kAllScattered, moved);
    for (int i = 0; i < 4; ++i) {
      T* slot = out.lag_rows + (16 * (entry >> 2) + 4 * i + (entry & 3)) * 3;
      slot[0] = slot[1] = slot[2] = T(0);
    }
  }
  now += moved;
  prev -= moved;
}

}  // namespace diffvbd::contact
