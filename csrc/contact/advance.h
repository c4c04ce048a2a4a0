// Step fractions at the start of the sweeps, where all vertices, or all bodies as wholes, move at once: 1 where every
// pair stays apart, else 1/2, 1/4, ... of what is left, and on from there. The fractions are decided, not
// differentiated (docs/method.md, section 12).
#pragma once

#include "passes.h"

namespace diffvbd::contact {

template <class T>
struct AdvanceInputs {
  const T *x, *move;                  // [B, V, 3]  positions at the detection; wanted displacement
  const T* u;                         // [B, bodies, 3]  translation of each body's island; or null
  const T* center;                    // [B, V, 3]  positions at which gaps were taken, less u
  const T* origin;                    // [B, V, 3] or null
  const T *collider, *collider_next;  // [B, Vc, 3]
  const bool* pinned;                 // [N]
  const int32_t* body;                // [N]
  PairList listed;
  const T* constants;
  const int32_t* unit_of;  // [V]  the unit of a vertex, of its scene: vertices of one unit have one fraction
  const T* trust_radius;   // [B, V]  of stay()
  int64_t scenes;
  int32_t vertices, corners, bodies, units_of_scene;
  bool careful;  // the motion does not minimise the barrier

  DIFFVBD_FN int64_t units() const { return scenes * units_of_scene; }
  DIFFVBD_FN int64_t unit(int64_t scene, int32_t v) const { return scene * units_of_scene + unit_of[v]; }
};

// A vertex's displacement since gaps were taken, now and after the trial.
template <class T>
struct Motion {
  Vec3<T> since, end;
  T size;  // of its position, the scale of rounding
};

// The state of the search, for each unit.
template <class T>
struct AdvanceState {
  T *fraction, *now;                  // of the whole displacement after the moves so far; trial fraction of the rest
  uint8_t *blocked, *stamp;           // whether a pair blocks it; round in which its trial was last reduced
  uint8_t* failed;                    // [B]  scenes without an admissible trial
  bool first;                         // the move in which colliders and prescribed vertices go
  const Motion<T>* motion = nullptr;  // [B, V]  in this round; set before pairs are looked at
};

// Several threads may write; all write the same.
DIFFVBD_FN void mark(uint8_t* flag) {
#if defined(__CUDA_ARCH__)
  *flag = 1;
#else
  __atomic_store_n(flag, uint8_t{1}, __ATOMIC_RELAXED);
#endif
}

template <class T>
DIFFVBD_FN Vec3<T> displacement_of(const AdvanceInputs<T>& in, int64_t scene, int32_t v) {
  const Vec3<T> displacement = vector_at(in.move + 3 * (scene * in.vertices + v));
  return in.pinned[v] || !in.u ? displacement : displacement - vector_at(in.u + 3 * (scene * in.bodies + in.body[v]));
}

// The trial part of it.
template <class T>
DIFFVBD_FN Vec3<T> trial_displacement(const AdvanceInputs<T>& in, const AdvanceState<T>& s, int64_t scene, int32_t v) {
  const int64_t unit = in.unit(scene, v);
  const T done = in.pinned[v] ? T(s.first ? 0 : 1) : s.fraction[unit];
  return ((T(1) - done) * (in.pinned[v] ? T(1) : s.now[unit])) * displacement_of(in, scene, v);
}

// A vertex at its current position, relative to `from`, and its trial displacement.
template <class T>
struct Trial {
  Vec3<T> at, from, since, displacement;
  T size;
};

template <class T>
DIFFVBD_FN T size_of(const Vec3<T>& p) {
  return absolute(p.x) + absolute(p.y) + absolute(p.z);
}

template <class T>
DIFFVBD_FN Trial<T> trial(const AdvanceInputs<T>& in, const AdvanceState<T>& s, int64_t scene, int32_t v) {
  Trial<T> out;
  const int64_t row = scene * in.vertices + v;
  const Vec3<T> whole = displacement_of(in, scene, v);
  const int64_t unit = in.unit(scene, v);
  const T done = in.pinned[v] ? T(s.first ? 0 : 1) : s.fraction[unit];
  out.at = vector_at(in.x + 3 * row) + done * whole;
  out.since = out.at - vector_at(in.center + 3 * row);
  out.from = in.origin ? vector_at(in.origin + 3 * row) : zero3<T>();
  out.displacement = trial_displacement(in, s, scene, v);
  out.size = size_of(out.at + out.from);
  return out;
}
template <class T>
DIFFVBD_FN Motion<T> motion_of(const AdvanceInputs<T>& in, const AdvanceState<T>& s, int64_t scene, int32_t v) {
  const Trial<T> t = trial(in, s, scene, v);
  return {t.since, t.since + t.displacement, t.size};
}
template <class T>
DIFFVBD_FN Motion<T> motion_at(const AdvanceInputs<T>& in, const AdvanceState<T>& s, const int32_t* pair, int k) {
  return s.motion[int64_t{pair[5]} * in.vertices + pair[k]];
}

template <class T>
DIFFVBD_FN T guard_of_size(T size) {
  return T(kGuardUlps) * std::numeric_limits<T>::epsilon() * size;
}

constexpr int kMoves = 3;                // in sequence, each of what the moves before have left
constexpr int kRounds = 16;              // rounds of halving in each
constexpr int kPatience = 8;             // rounds after which what fails does not move
constexpr double kRoundedSquare = 4e-6;  // of squares of lengths: more than rounding makes of them

// Whether a point of a collider is at its end already: planes always are.
template <class T>
DIFFVBD_FN bool is_still(const AdvanceState<T>& s, const int32_t* pair) {
  return pair[4] == kPointPlane || !s.first;
}
template <class T>
DIFFVBD_FN int64_t row_of_collider(const AdvanceInputs<T>& in, const int32_t* pair, int k) {
  return 3 * (int64_t{pair[5]} * (in.corners - in.vertices) + pair[k] - in.vertices);
}

// The corners of a pair at the begin of a move.
template <class T>
struct PairPlace {
  Corners<T> corners;
  T guard;
};
template <class T>
DIFFVBD_FN PairPlace<T> place_of(const AdvanceInputs<T>& in, const AdvanceState<T>& s, const int32_t* pair) {
  PairPlace<T> out;
  Vec3<T> at[4], from[4];
  T size = T(0);
  for (int k = 0; k < 4; ++k) {
    if (pair[k] >= in.vertices) {
      at[k] = vector_at((is_still(s, pair) ? in.collider_next : in.collider) + row_of_collider(in, pair, k));
      from[k] = zero3<T>();
    } else {
      const Trial<T> t = trial(in, s, pair[5], pair[k]);
      at[k] = t.at, from[k] = t.from;
    }
    const T own = size_of(at[k] + from[k]);
    size = size < own ? own : size;
  }
  for (int k = 0; k < 4; ++k) out.corners.x[k] = k == 0 ? zero3<T>() : (at[k] - at[0]) + (from[k] - from[0]);
  out.guard = guard_of_size(size);
  return out;
}

// Their trial displacements.
template <class T>
struct TrialDisplacements {
  Vec3<T> displacement[4];
  T fractions[4];  // of a gap that each may close
  bool free[4], moves, careful;
  DIFFVBD_FN TrialDisplacements(const AdvanceInputs<T>& in, const AdvanceState<T>& s, const int32_t* pair)
      : moves(false), careful(false) {
    bool one = false, other = false;
    for (int k = 0; k < 4; ++k) {
      if (pair[k] >= in.vertices) {
        const int64_t row = row_of_collider(in, pair, k);
        displacement[k] =
            is_still(s, pair) ? zero3<T>() : vector_at(in.collider_next + row) - vector_at(in.collider + row);
        free[k] = false;
      } else {
        displacement[k] = trial_displacement(in, s, pair[5], pair[k]);
        free[k] = !in.pinned[pair[k]];
      }
      const bool goes = T(0) < dot(displacement[k], displacement[k]);
      one = one || (goes && k < sides(pair[4])), other = other || (goes && k >= sides(pair[4]));
      careful = careful || (in.careful && free[k] && goes);  // what is prescribed may come closer
    }
    moves = one || other;
    for (T& own : fractions) own = one && other ? T(kBothGapFraction) : T(kGapFraction);
  }
};

// The gap of a point above a plane before the plane moves. Out of line: seldom needed.
template <class T>
DIFFVBD_APART T gap_before(const AdvanceInputs<T>& in, const AdvanceState<T>& s, const int32_t* pair, T offset) {
  const Trial<T> t = trial(in, s, pair[5], pair[0]);
  Corners<T> corners;
  corners.x[0] = zero3<T>();
  for (int k = 1; k < 4; ++k) {
    corners.x[k] = (vector_at(in.collider + row_of_collider(in, pair, k)) - t.at) - t.from;
  }
  return distance(kPointPlane, corners).d - offset;
}

// The separating plane of a pair in a move, without the trial displacements.
template <class T>
struct PairPlane {
  Vec3<T> n;
  Separation<T> separation;
  T guard, least;
  DIFFVBD_FN PairPlane(const AdvanceInputs<T>& in, const AdvanceState<T>& s, int64_t pair) {
    const int32_t* record = in.listed.pairs + kPairRow * pair;
    const PairConstants<T> constants(in.constants + kConstants * pair);
    const PairPlace<T> at = place_of(in, s, record);
    n = distance(record[4], at.corners).n;
    separation = Separation<T>(record[4], at.corners, n, constants.offset);
    guard = at.guard, least = least_of(constants.dhat);
    // a plane that would pass the point: the point must keep ahead of it
    if (record[4] == kPointPlane && s.first && !(guard < separation.gap) && in.collider != in.collider_next) {
      const T before = gap_before(in, s, record, constants.offset);
      if (T(0) < before) separation.slack[0] = separation.gap - before, separation.gap = before;
    }
  }
  DIFFVBD_FN void forget() { least = T(-1); }
  DIFFVBD_FN bool is_known() const { return T(0) <= least; }
  DIFFVBD_FN bool holds(int kind, const TrialDisplacements<T>& a) const {
    const bool at_rest = !a.moves && !(separation.slack[0] < T(0));
    return at_rest || holds_along(kind, n, separation, guard, least, a.displacement, a.fractions, a.careful, a.careful);
  }
};

// Whether a pair stays out of the barrier's reach, by its gap when that was taken.
template <class T>
DIFFVBD_FN bool stays_far(const Motion<T> (&m)[4], const int32_t* pair, const T* constants) {
  T size = T(0), most = T(0);
  for (const Motion<T>& own : m) size = size < own.size ? own.size : size;
  const T slack = PairHints<T>(constants).gap - PairConstants<T>(constants).dhat - guard_of_size(size);
  if (!(T(0) < slack)) return false;
  each_across(sides(pair[4]), [&](int i, int j) {
    const Vec3<T> displacements[] = {m[i].since - m[j].since, m[i].end - m[j].end};
    for (const Vec3<T>& d : displacements) {
      const T square = dot(d, d);
      most = most < square ? square : most;
    }
  });
  return most < slack * slack;
}
template <class T>
DIFFVBD_FN bool stays_far(const AdvanceInputs<T>& in, const AdvanceState<T>& s, const int32_t* pair,
                          const T* constants) {
  Motion<T> m[4];
  for (int k = 0; k < 4; ++k) {
    if (pair[k] >= in.vertices) return false;  // its gap may be older
    m[k] = motion_at(in, s, pair, k);
  }
  return stays_far(m, pair, constants);
}

// The same for any fractions of its corners: no round of a move has to test the pair.
template <class T>
DIFFVBD_FN bool stays_far_at_any_fraction(const AdvanceInputs<T>& in, const AdvanceState<T>& s, int64_t pair) {
  const int32_t* record = in.listed.pairs + kPairRow * pair;
  const T* constants = in.constants + kConstants * pair;
  if (!is_limiting(record) || PairHints<T>(constants).gap == std::numeric_limits<T>::infinity()) return true;
  Motion<T> m[4];
  T size = T(0), most = T(0);
  for (int k = 0; k < 4; ++k) {
    if (record[k] >= in.vertices) return false;  // its gap may be older
    m[k] = motion_at(in, s, record, k);
    size = size < m[k].size ? m[k].size : size;
  }
  const T slack = PairHints<T>(constants).gap - PairConstants<T>(constants).dhat - guard_of_size(size);
  if (!(T(0) < slack)) return false;
  each_across(sides(record[4]), [&](int i, int j) {
    const Vec3<T> displacements[] = {m[i].since - m[j].since, m[i].since - m[j].end, m[i].end - m[j].since,
                                     m[i].end - m[j].end};
    for (const Vec3<T>& d : displacements) {
      const T square = dot(d, d);
      most = most < square ? square : most;
    }
  });
  return T(1 + kRoundedSquare) * most < slack * slack;
}

// Whether a corner of a pair has displacement left.
template <class T>
DIFFVBD_FN bool is_open(const AdvanceInputs<T>& in, const AdvanceState<T>& s, const int32_t* record) {
  for (int k = 0; k < 4; ++k) {
    if (record[k] < in.vertices && !in.pinned[record[k]] && s.fraction[in.unit(record[5], record[k])] < T(1)) {
      return true;
    }
  }
  return false;
}

// Whether the trial of a corner was reduced in the round before.
template <class T>
DIFFVBD_FN bool is_retried(const AdvanceInputs<T>& in, const AdvanceState<T>& s, const int32_t* record, int round) {
  for (int k = 0; k < 4; ++k) {
    if (record[k] < in.vertices && s.stamp[in.unit(record[5], record[k])] == round) return true;
  }
  return false;
}

// The quick part of test_pair(): whether the separating plane admits the pair, or the pair needs no test in this round.
// find(): the plane, on first use.
template <class T, class Find>
DIFFVBD_FN bool passes_by(const AdvanceInputs<T>& in, const AdvanceState<T>& s, PairPlane<T>& plane, int64_t pair,
                          int round, const Find& find) {
  const int32_t* record = in.listed.pairs + kPairRow * pair;
  if (!is_limiting(record) || (round > 0 && !is_retried(in, s, record, round))) return true;
  if (stays_far(in, s, record, in.constants + kConstants * pair)) return true;
  if (!plane.is_known()) plane = find();
  return plane.holds(record[4], TrialDisplacements<T>(in, s, record));
}

// Marks the corners that block a pair; returns whether it is safe. Round 0 tests all pairs, later rounds those with a
// reduced corner.
template <class T>
DIFFVBD_FN bool test_pair(const AdvanceInputs<T>& in, const AdvanceState<T>& s, int64_t pair, int round) {
  const int32_t* record = in.listed.pairs + kPairRow * pair;
  if (round > 0 && !is_retried(in, s, record, round)) return true;
  if (!s.first && round == 0 && !is_open(in, s, record)) return true;
  const T* constants = in.constants + kConstants * pair;
  // the second: left out (pair_list.h)
  if (!is_limiting(record) || PairHints<T>(constants).gap == std::numeric_limits<T>::infinity()) return true;
  if (stays_far(in, s, record, constants)) return true;  // as do most
  const TrialDisplacements<T> a(in, s, record);
  const bool plane = record[4] == kPointPlane;
  if (plane && PairPlane<T>(in, s, pair).holds(record[4], a)) return true;
  if (!plane && !a.moves) return true;
  const int first = sides(record[4]);
  const PairPlace<T> at = place_of(in, s, record);
  const Gate<T> gate(record[4], at.corners, constants, at.guard);
  if (!plane && (gate.holds(a.displacement, a.fractions, a.careful) || stays_apart(gate, a.displacement, a.careful)))
    return true;
  bool named = false;
  for (int pass = 0; pass < 2 && !named; ++pass) {
    for (int k = 0; k < 4; ++k) {
      if (!a.free[k] || !(T(0) < dot(a.displacement[k], a.displacement[k]))) continue;
      const T toward = (k < first ? -dot(gate.n, a.displacement[k]) : dot(gate.n, a.displacement[k]));
      if (pass == 0 && !(T(kStartLeast) * gate.gap < toward)) continue;
      mark(s.blocked + in.unit(record[5], record[k]));
      named = true;
    }
  }
  return false;
}

template <class T>
DIFFVBD_FN T total(T done, T now) {
  return now == T(1) ? T(1) : done + now * (T(1) - done);
}

// Marks the unit of a vertex that leaves its trust region by the trial; returns whether it stays. Rounds as in
// test_pair().
template <class T>
DIFFVBD_FN bool stay(const AdvanceInputs<T>& in, const AdvanceState<T>& s, int64_t scene, int32_t v, int round) {
  const int64_t unit = in.unit(scene, v), row = scene * in.vertices + v;
  if (in.pinned[v] || (round > 0 && s.stamp[unit] != round) || s.now[unit] == T(0)) return true;
  const T fraction = total(s.fraction[unit], s.now[unit]);
  const Vec3<T> end = vector_at(in.x + 3 * row) + fraction * displacement_of(in, scene, v),
                off = end - vector_at(in.center + 3 * row);
  if (dot(off, off) <= in.trust_radius[row] * in.trust_radius[row]) return true;
  mark(s.blocked + unit);
  return false;
}

// The next smaller trial fraction.
template <class T>
DIFFVBD_FN T next_trial(T now) {
  return T(kLeastTrial) < now ? T(0.5) * now : T(0);
}

// After a round: blocked units reduce their trials.
template <class T>
DIFFVBD_FN bool retreat(const AdvanceState<T>& s, int64_t unit, int round) {
  if (!s.blocked[unit]) return false;
  s.blocked[unit] = 0;
  s.stamp[unit] = static_cast<uint8_t>(round + 1);
  s.now[unit] = round < kPatience ? next_trial(s.now[unit]) : T(0);
  return true;
}

template <class T>
DIFFVBD_FN void begin_move(const AdvanceState<T>& s, int64_t unit) {
  if (s.first) s.fraction[unit] = T(0);
  s.now[unit] = T(1), s.blocked[unit] = s.stamp[unit] = 0;
}
// A scene without an admissible trial stays in this move.
template <class T>
DIFFVBD_FN void give_up(const AdvanceInputs<T>& in, const AdvanceState<T>& s, int64_t unit) {
  if (s.failed[unit / in.units_of_scene]) s.now[unit] = T(0);
}
template <class T>
DIFFVBD_FN void end_move(const AdvanceState<T>& s, int64_t unit) {
  s.fraction[unit] = total(s.fraction[unit], s.now[unit]);
}

}  // namespace diffvbd::contact
