// The adjoints of the passes over a color (passes.h): what pairs send to their corners, and collecting it. In the
// reverse all p of a color are known before anything is sent.
#pragma once

#include "passes.h"

namespace diffvbd::contact {

// What another multiprocessor of a device may have written during the launch: it is in the L2 cache.
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

// Leaves in the slots of an entry what it adds to the corners of its pair. As add_at(), it reads before it writes.
template <class T>
DIFFVBD_FN void send(const ContactAdjoints<T>& out, int64_t entry, const Vec3<T> (&bar)[4]) {
  T* slots = out.rows + 12 * entry;
  uint8_t* flags = out.sent + 16 * (entry >> 2) + (entry & 3);
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
  send(out, entry, bar.x);
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
    add_at(to + 1, bar.n);
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
  return *reinterpret_cast<uint32_t*>(out.sent + 4 * entry);
}

// Adds up what the slots of all corners of a pair hold for that of an entry, as far as the bytes of `holds` say.
constexpr uint32_t kAllHold = 0x01010101;
template <class T>
DIFFVBD_FN Vec3<T> held_for(const T* rows, int64_t entry, uint32_t holds, Vec3<T> sum) {
  Vec3<T> own[4];
  for (int i = 0; i < 4; ++i) {
    own[i] = holds >> 8 * i & 1 ? fresh_vector(rows + (16 * (entry >> 2) + 4 * i + (entry & 3)) * 3) : zero3<T>();
  }
  for (int i = 0; i < 4; ++i) {
    if (holds >> 8 * i & 1) sum += own[i];
  }
  return sum;
}
// Takes out of the slots what pairs have sent to corner point v since it was last asked for: `now` receives what
// belongs to the state, `prev` what belongs to the start of the step.
template <class T>
DIFFVBD_FN void take_pairs(const ContactInputs<T>& in, const ContactAdjoints<T>& out, int64_t scene, int v, int first,
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
      now = held_for(out.rows, entry[a], holds[a], now);
      flags_of(out, entry[a]) = 0;
    }
  }
  Vec3<T> moved = zero3<T>();
  const PairList::Entries lagged = in.lags_of(scene, v);
  for (int e = first; e < lagged.count; e += stride) {
    const int64_t entry = lagged.first[e];
    moved = held_for(out.lag_rows, entry, kAllHold, moved);
    for (int i = 0; i < 4; ++i) {
      T* slot = out.lag_rows + (16 * (entry >> 2) + 4 * i + (entry & 3)) * 3;
      slot[0] = slot[1] = slot[2] = T(0);
    }
  }
  now += moved;
  prev -= moved;
}

}  // namespace diffvbd::contact
