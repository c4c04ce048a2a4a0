// What is tried at the start of the sweeps, of each vertex or of each body as a whole: inputs, state and the ways.
#pragma once

#include "passes.h"

namespace diffvbd::contact {

template <class T>
struct AdvanceInputs {
  const T *x, *move;                  // [B, V, 3]  at the detection; where each vertex wants to go from there
  const T* u;                         // [B, bodies, 3]  translation of each body's island; or null
  const T* center;                    // [B, V, 3]  from where a vertex has its room, less u
  const T* origin;                    // [B, V, 3] or null
  const T *collider, *collider_next;  // [B, Vc, 3]
  const bool* held;                   // [N]
  const int32_t* body;                // [N]
  PairList listed;
  const T* constants;
  const T* room;                   // [B, V]
  const T *own_center, *own_room;  // the same beside the rigid motion of its body; or null
  int64_t scenes;
  int32_t vertices, corners, bodies;
  bool careful;  // the motion does not minimise the barrier
  bool whole;    // all vertices of a body go the same share

  // What goes a share of its own: vertices, or bodies.
  DIFFVBD_FN int64_t units() const { return scenes * (whole ? bodies : vertices); }
  DIFFVBD_FN int64_t unit(int64_t scene, int32_t v) const {
    return whole ? scene * bodies + body[v] : scene * vertices + v;
  }
  DIFFVBD_FN int64_t scene_of_unit(int64_t unit) const { return unit / (whole ? bodies : vertices); }
};

// How a vertex has moved since the gaps of pairs were taken, and where it would be if it went on as it tries.
template <class T>
struct Motion {
  Vec3<T> since, end;
  T size;  // of its position, which rounding is measured by
};

// What changes while it is worked out, of each unit.
template <class T>
struct AdvanceState {
  T *share, *now;                     // of the whole way after the moves so far; of what is left, tried in this one
  uint8_t *blocked, *stamp;           // something does not let it pass; the round in which it last tried less
  uint8_t* failed;                    // [B]  a scene in which something has found no way
  bool first;                         // the move in which colliders and prescribed vertices go
  const Motion<T>* motion = nullptr;  // [B, V]  in this round; set before pairs are looked at
};

// Written by whoever finds it: all write the same.
DIFFVBD_FN void mark(uint8_t* flag) {
#if defined(__CUDA_ARCH__)
  *flag = 1;
#else
  __atomic_store_n(flag, uint8_t{1}, __ATOMIC_RELAXED);
#endif
}

template <class T>
DIFFVBD_FN Vec3<T> way_of(const AdvanceInputs<T>& in, int64_t scene, int32_t v) {
  const Vec3<T> way = vector_at(in.move + 3 * (scene * in.vertices + v));
  return in.held[v] || !in.u ? way : way - vector_at(in.u + 3 * (scene * in.bodies + in.body[v]));
}

// And the part of it that it tries.
template <class T>
DIFFVBD_FN Vec3<T> way_tried(const AdvanceInputs<T>& in, const AdvanceState<T>& s, int64_t scene, int32_t v) {
  const int64_t unit = in.unit(scene, v);
  const T done = in.held[v] ? T(s.first ? 0 : 1) : s.share[unit];
  return ((T(1) - done) * (in.held[v] ? T(1) : s.now[unit])) * way_of(in, scene, v);
}

// A vertex as it is, relative to `from`, and the way that it tries.
template <class T>
struct Trial {
  Vec3<T> at, from, since, way;
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
  const Vec3<T> whole = way_of(in, scene, v);
  const int64_t unit = in.unit(scene, v);
  const T done = in.held[v] ? T(s.first ? 0 : 1) : s.share[unit];
  out.at = vector_at(in.x + 3 * row) + done * whole;
  out.since = out.at - vector_at(in.center + 3 * row);
  out.from = in.origin ? vector_at(in.origin + 3 * row) : zero3<T>();
  out.way = way_tried(in, s, scene, v);
  out.size = size_of(out.at + out.from);
  return out;
}
template <class T>
DIFFVBD_FN Motion<T> motion_of(const AdvanceInputs<T>& in, const AdvanceState<T>& s, int64_t scene, int32_t v) {
  const Trial<T> t = trial(in, s, scene, v);
  return {t.since, t.since + t.way, t.size};
}
// That of a corner of a pair that is a vertex.
template <class T>
DIFFVBD_FN Motion<T> motion_at(const AdvanceInputs<T>& in, const AdvanceState<T>& s, const int32_t* pair, int k) {
  return s.motion[int64_t{pair[5]} * in.vertices + pair[k]];
}

template <class T>
DIFFVBD_FN T guard_of_size(T size) {
  return T(kGuardUlps) * std::numeric_limits<T>::epsilon() * size;
}

// How much of its way each vertex, or each body as a whole, may go at the start of the sweeps, where all move at once:
// all of it wherever the pairs that it is in stay apart, else a half, a quarter, ... of what is left, and so on from
// there. The shares are decided, not differentiated (docs/method.md, section 12).

constexpr int kMoves = 3;     // one after another, each of what the ones before have left
constexpr int kRounds = 16;   // of halving in each
constexpr int kPatience = 8;  // rounds from which on what fails does not move
constexpr double kLeastTry = 1.0 / 64;
constexpr double kRoundedSquare = 4e-6;  // of squares of lengths: more than rounding makes of them

// Whether a collider's point is already where it ends: planes are, wherever they come from.
template <class T>
DIFFVBD_FN bool is_still(const AdvanceState<T>& s, const int32_t* pair) {
  return pair[4] == kPointPlane || !s.first;
}
template <class T>
DIFFVBD_FN int64_t row_of_collider(const AdvanceInputs<T>& in, const int32_t* pair, int k) {
  return 3 * (int64_t{pair[5]} * (in.corners - in.vertices) + pair[k] - in.vertices);
}

// The corners of a pair as they are where a move begins.
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

// The ways that they try.
template <class T>
struct Ways {
  Vec3<T> way[4];
  T shares[4];  // of a gap that each may close
  bool free[4], moves, careful;
  DIFFVBD_FN Ways(const AdvanceInputs<T>& in, const AdvanceState<T>& s, const int32_t* pair)
      : moves(false), careful(false) {
    bool one = false, other = false;
    for (int k = 0; k < 4; ++k) {
      if (pair[k] >= in.vertices) {
        const int64_t row = row_of_collider(in, pair, k);
        way[k] = is_still(s, pair) ? zero3<T>() : vector_at(in.collider_next + row) - vector_at(in.collider + row);
        free[k] = false;
      } else {
        way[k] = way_tried(in, s, pair[5], pair[k]);
        free[k] = !in.held[pair[k]];
      }
      const bool goes = T(0) < dot(way[k], way[k]);
      one = one || (goes && k < sides(pair[4])), other = other || (goes && k >= sides(pair[4]));
      careful = careful || (in.careful && free[k] && goes);  // what is prescribed may come closer
    }
    moves = one || other;
    for (T& own : shares) own = one && other ? T(kBothShare) : T(kShare);
  }
};

// The gap of a point above a plane that has yet to move. Apart, since it is seldom asked for.
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

// What keeps a pair apart along the direction of its closest points in a move: all but the ways that it tries.
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
    // a plane that would pass the point: this has to go as far as that comes
    if (record[4] == kPointPlane && s.first && !(guard < separation.gap) && in.collider != in.collider_next) {
      const T before = gap_before(in, s, record, constants.offset);
      if (T(0) < before) separation.slack[0] = separation.gap - before, separation.gap = before;
    }
  }
  DIFFVBD_FN void forget() { least = T(-1); }
  DIFFVBD_FN bool is_known() const { return T(0) <= least; }
  DIFFVBD_FN bool holds(int kind, const Ways<T>& a) const {
    const bool rests = !a.moves && !(separation.slack[0] < T(0));
    return rests || holds_along(kind, n, separation, guard, least, a.way, a.shares, a.careful, a.careful);
  }
};

// Whether a pair stays out of the barrier's reach all the way, however its corners go: by its gap when that was taken.
template <class T>
DIFFVBD_FN bool stays_far(const Motion<T> (&m)[4], const int32_t* pair, const T* constants) {
  T size = T(0), most = T(0);
  for (const Motion<T>& own : m) size = size < own.size ? own.size : size;
  const T room = PairHints<T>(constants).gap - PairConstants<T>(constants).dhat - guard_of_size(size);
  if (!(T(0) < room)) return false;
  each_across(sides(pair[4]), [&](int i, int j) {
    const Vec3<T> ways[] = {m[i].since - m[j].since, m[i].end - m[j].end};
    for (const Vec3<T>& d : ways) {
      const T square = dot(d, d);
      most = most < square ? square : most;
    }
  });
  return most < room * room;
}
template <class T>
DIFFVBD_FN bool stays_far(const AdvanceInputs<T>& in, const AdvanceState<T>& s, const int32_t* pair,
                          const T* constants) {
  Motion<T> m[4];
  for (int k = 0; k < 4; ++k) {
    if (pair[k] >= in.vertices) return false;  // whose gap may be of another time
    m[k] = motion_at(in, s, pair, k);
  }
  return stays_far(m, pair, constants);
}

// Whether it stays so whatever shares of their ways its corners go: then no round of a move has to look at it.
template <class T>
DIFFVBD_FN bool stays_far_at_any_share(const AdvanceInputs<T>& in, const AdvanceState<T>& s, int64_t pair) {
  const int32_t* record = in.listed.pairs + kPairRow * pair;
  const T* constants = in.constants + kConstants * pair;
  if (PairHints<T>(constants).gap == std::numeric_limits<T>::infinity()) return true;  // left out (contact/narrow.h)
  Motion<T> m[4];
  T size = T(0), most = T(0);
  for (int k = 0; k < 4; ++k) {
    if (record[k] >= in.vertices) return false;  // whose gap may be of another time
    m[k] = motion_at(in, s, record, k);
    size = size < m[k].size ? m[k].size : size;
  }
  const T room = PairHints<T>(constants).gap - PairConstants<T>(constants).dhat - guard_of_size(size);
  if (!(T(0) < room)) return false;
  each_across(sides(record[4]), [&](int i, int j) {
    const Vec3<T> ways[] = {m[i].since - m[j].since, m[i].since - m[j].end, m[i].end - m[j].since, m[i].end - m[j].end};
    for (const Vec3<T>& d : ways) {
      const T square = dot(d, d);
      most = most < square ? square : most;
    }
  });
  return T(1 + kRoundedSquare) * most < room * room;
}

// Whether a corner of a pair has yet to go some of its way: what earlier moves have taken all the way moves no more.
template <class T>
DIFFVBD_FN bool is_open(const AdvanceInputs<T>& in, const AdvanceState<T>& s, const int32_t* record) {
  for (int k = 0; k < 4; ++k) {
    if (record[k] < in.vertices && !in.held[record[k]] && s.share[in.unit(record[5], record[k])] < T(1)) {
      return true;
    }
  }
  return false;
}

// Whether one has tried less in the round before.
template <class T>
DIFFVBD_FN bool is_retried(const AdvanceInputs<T>& in, const AdvanceState<T>& s, const int32_t* record, int round) {
  for (int k = 0; k < 4; ++k) {
    if (record[k] < in.vertices && s.stamp[in.unit(record[5], record[k])] == round) return true;
  }
  return false;
}

// Whether a pair passes by its plane, which is found when it is first asked for, or need not be looked at in this
// round: the quick part of try_pair(). find(): the plane.
template <class T, class Find>
DIFFVBD_FN bool passes_by(const AdvanceInputs<T>& in, const AdvanceState<T>& s, PairPlane<T>& plane, int64_t pair,
                          int round, const Find& find) {
  const int32_t* record = in.listed.pairs + kPairRow * pair;
  if (round > 0 && !is_retried(in, s, record, round)) return true;
  if (stays_far(in, s, record, in.constants + kConstants * pair)) return true;
  if (!plane.is_known()) plane = find();
  return plane.holds(record[4], Ways<T>(in, s, record));
}

// Marks the corners that keep a pair from being safe; returns whether it is. Round 0 looks at all pairs, later ones at
// those of which a corner has tried less in the round before.
template <class T>
DIFFVBD_FN bool try_pair(const AdvanceInputs<T>& in, const AdvanceState<T>& s, int64_t pair, int round) {
  const int32_t* record = in.listed.pairs + kPairRow * pair;
  if (round > 0 && !is_retried(in, s, record, round)) return true;
  if (!s.first && round == 0 && !is_open(in, s, record)) return true;
  const T* constants = in.constants + kConstants * pair;
  if (PairHints<T>(constants).gap == std::numeric_limits<T>::infinity()) return true;  // left out (contact/narrow.h)
  if (stays_far(in, s, record, constants)) return true;                                // as do most
  const Ways<T> a(in, s, record);
  const bool plane = record[4] == kPointPlane;
  if (plane && PairPlane<T>(in, s, pair).holds(record[4], a)) return true;
  if (!plane && !a.moves) return true;
  const int first = sides(record[4]);
  const PairPlace<T> at = place_of(in, s, record);
  const Gate<T> gate(record[4], at.corners, constants, at.guard);
  if (!plane && (gate.holds(a.way, a.shares, a.careful) || stays_apart(gate, a.way, a.careful))) return true;
  bool named = false;
  for (int pass = 0; pass < 2 && !named; ++pass) {
    for (int k = 0; k < 4; ++k) {
      if (!a.free[k] || !(T(0) < dot(a.way[k], a.way[k]))) continue;
      const T toward = (k < first ? -dot(gate.n, a.way[k]) : dot(gate.n, a.way[k]));
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

// Whether a vertex is within its rooms after a share of its way.
template <class T>
DIFFVBD_FN bool is_within_rooms(const AdvanceInputs<T>& in, int64_t scene, int32_t v, T share) {
  const int64_t row = scene * in.vertices + v;
  const Vec3<T> end = vector_at(in.x + 3 * row) + share * way_of(in, scene, v);
  const auto within = [&](const T* center, const T* room) {
    const Vec3<T> off = end - vector_at(center + 3 * row);
    return dot(off, off) <= room[row] * room[row];
  };
  return within(in.center, in.room) && (!in.own_room || within(in.own_center, in.own_room));
}

// Marks the body of a vertex that leaves its rooms by what it tries; returns whether it stays. Rounds as of try_pair().
// A vertex on its own tries no more than its rooms let it: begin_move().
template <class T>
DIFFVBD_FN bool stay(const AdvanceInputs<T>& in, const AdvanceState<T>& s, int64_t scene, int32_t v, int round) {
  const int64_t unit = in.unit(scene, v);
  if (in.held[v] || (round > 0 && s.stamp[unit] != round) || s.now[unit] == T(0)) return true;
  if (is_within_rooms(in, scene, v, total(s.share[unit], s.now[unit]))) return true;
  mark(s.blocked + unit);
  return false;
}

// What is tried next where `now` of what is left does not pass.
template <class T>
DIFFVBD_FN T next_try(T now) {
  return T(kLeastTry) < now ? T(0.5) * now : T(0);
}

// After a round: what is blocked tries less.
template <class T>
DIFFVBD_FN bool retreat(const AdvanceState<T>& s, int64_t unit, int round) {
  if (!s.blocked[unit]) return false;
  s.blocked[unit] = 0;
  s.stamp[unit] = static_cast<uint8_t>(round + 1);
  s.now[unit] = round < kPatience ? next_try(s.now[unit]) : T(0);
  return true;
}

template <class T>
DIFFVBD_FN void begin_move(const AdvanceInputs<T>& in, const AdvanceState<T>& s, int64_t unit) {
  if (s.first) s.share[unit] = T(0);
  T now = T(1);
  if (!in.whole) {  // rooms are balls: at smaller shares it is no farther out than at this one or now
    const int64_t scene = in.scene_of_unit(unit);
    const auto v = static_cast<int32_t>(unit - scene * in.vertices);
    while (!in.held[v] && T(0) < now && !is_within_rooms(in, scene, v, total(s.share[unit], now))) now = next_try(now);
  }
  s.now[unit] = now, s.blocked[unit] = s.stamp[unit] = 0;
}
// A scene that has found no way stays where it is in this move.
template <class T>
DIFFVBD_FN void give_up(const AdvanceInputs<T>& in, const AdvanceState<T>& s, int64_t unit) {
  if (s.failed[in.scene_of_unit(unit)]) s.now[unit] = T(0);
}
template <class T>
DIFFVBD_FN void end_move(const AdvanceState<T>& s, int64_t unit) {
  s.share[unit] = total(s.share[unit], s.now[unit]);
}

}  // namespace diffvbd::contact
