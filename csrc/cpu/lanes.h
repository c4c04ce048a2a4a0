// A pack of kLanes scalars that computes on kLanes vertices of a color at once. GCC and Clang lower the vector type to
// whatever the processor has; each lane performs the scalar program, so results do not depend on the instruction set.
#pragma once

#include <cstdint>
#include <cstring>

#include "../core/views.h"
#include "standard.h"

#if defined(__has_builtin)
#if __has_builtin(__builtin_shufflevector)
#define DIFFVBD_SHUFFLES 1
#endif
#endif

// A file for a newer instruction set (sweep_*_v3.cpp) names it before it includes this. Its packs, and every function
// of them, then have names of their own: the linker takes none of its code for a processor that lacks the set. It also
// says that registers have DIFFVBD_UPPER_HALVES, which sets before AVX do not have.
#ifndef DIFFVBD_SET
#define DIFFVBD_SET baseline
#endif

namespace diffvbd {
inline namespace DIFFVBD_SET {

template <class T>
struct Lanes {
  typedef T Vector __attribute__((vector_size(kLanes * sizeof(T))));
  Vector v;

  DIFFVBD_FN Lanes() = default;
  DIFFVBD_FN explicit Lanes(const Vector& a) : v(a) {}
  DIFFVBD_FN Lanes(T a) {
    for (int l = 0; l < kLanes; ++l) v[l] = a;
  }
  DIFFVBD_FN static Lanes load(const T* p) {
    Lanes a;
    std::memcpy(&a.v, p, sizeof a.v);
    return a;
  }
  DIFFVBD_FN void store(T* p) const { std::memcpy(p, &v, sizeof v); }
  // the first `count` lanes
  DIFFVBD_FN static Lanes load(const T* p, int count) {
    if (count == kLanes) return load(p);
    Lanes a(T(0));
    for (int l = 0; l < count; ++l) a.v[l] = p[l];
    return a;
  }
  DIFFVBD_FN void store(T* p, int count) const {
    if (count == kLanes) return store(p);
    for (int l = 0; l < count; ++l) p[l] = v[l];
  }
};

template <class T>
DIFFVBD_FN Lanes<T> operator+(const Lanes<T>& a, const Lanes<T>& b) {
  return Lanes<T>(a.v + b.v);
}
template <class T>
DIFFVBD_FN Lanes<T> operator-(const Lanes<T>& a, const Lanes<T>& b) {
  return Lanes<T>(a.v - b.v);
}
template <class T>
DIFFVBD_FN Lanes<T> operator-(const Lanes<T>& a) {
  return Lanes<T>(-a.v);
}
template <class T>
DIFFVBD_FN Lanes<T> operator*(const Lanes<T>& a, const Lanes<T>& b) {
  return Lanes<T>(a.v * b.v);
}
template <class T>
DIFFVBD_FN Lanes<T> operator/(const Lanes<T>& a, const Lanes<T>& b) {
  return Lanes<T>(a.v / b.v);
}
template <class T>
DIFFVBD_FN const Lanes<T>& value_of(const Lanes<T>& a) {
  return a;
}
// A comparison yields a vector of integers, all bits set where it holds.
template <class I>
struct Mask {
  I v;
};
template <class T>
DIFFVBD_FN auto operator<(const Lanes<T>& a, const Lanes<T>& b) {
  return Mask<decltype(a.v < b.v)>{a.v < b.v};
}
template <class I, class T>
DIFFVBD_FN Lanes<T> select(const Mask<I>& condition, const Lanes<T>& a, const Lanes<T>& b) {
  return Lanes<T>(condition.v ? a.v : b.v);
}
template <class I>
DIFFVBD_FN bool any(const Mask<I>& condition) {
  int64_t found = 0;
  for (int l = 0; l < kLanes; ++l) found |= condition.v[l];
  return found != 0;
}
template <class I>
DIFFVBD_FN bool all(const Mask<I>& condition) {
  int64_t kept = -1;
  for (int l = 0; l < kLanes; ++l) kept &= condition.v[l];
  return kept != 0;
}
template <class I>
DIFFVBD_FN Mask<I> both(const Mask<I>& a, const Mask<I>& b) {
  return {a.v & b.v};
}
template <class I>
DIFFVBD_FN Mask<I> either(const Mask<I>& a, const Mask<I>& b) {
  return {a.v | b.v};
}
template <class T>
DIFFVBD_FN Lanes<T> square_root(const Lanes<T>& a) {
  Lanes<T> r;
  for (int l = 0; l < kLanes; ++l) r.v[l] = std::sqrt(a.v[l]);
  return r;
}
// The library's log has instructions of the first set in it. On Intel's processors these wait for the halves of
// registers that a newer set has written: 170 ns a logarithm instead of 6.
DIFFVBD_FN void clear_upper_halves() {
#ifdef DIFFVBD_UPPER_HALVES
  __builtin_ia32_vzeroupper();
#endif
}
// What is seldom or costly in any case: out of line and in memory, so that no register is in use across a call.
template <class T, class F>
DIFFVBD_FN Lanes<T> each_lane(const Lanes<T>& a, const F& f) {
  T values[kLanes];
  a.store(values);
  for (int l = 0; l < kLanes; ++l) values[l] = f(values[l], l);
  return Lanes<T>::load(values);
}
template <class T>
DIFFVBD_APART Lanes<T> power_of_two(const Lanes<T>& a) {
  return each_lane(a, [](T value, int) { return diffvbd::power_of_two(value); });
}
#ifndef DIFFVBD_LAW_HEADER
template <class T>
DIFFVBD_FN Lanes<T> natural_log(const Lanes<T>& a) {
  Lanes<T> r;
  for (int l = 0; l < kLanes; ++l) {
    clear_upper_halves();
    r.v[l] = std::log(a.v[l]);
  }
  return r;
}
#else  // generated laws have many functions
template <class T>
DIFFVBD_APART Lanes<T> natural_log(const Lanes<T>& a) {
  return each_lane(a, [](T value, int) { return std::log(value); });
}
template <class T>
DIFFVBD_APART Lanes<T> exponential(const Lanes<T>& a) {
  return each_lane(a, [](T value, int) { return std::exp(value); });
}
template <class T>
DIFFVBD_APART Lanes<T> power(const Lanes<T>& a, const Lanes<T>& p) {
  return each_lane(a, [&](T value, int l) { return std::pow(value, p.v[l]); });
}
#endif

// --- rows of four scalars (x, y, z, unused) <-> lanes ----------------------------------------------------------------
// A row is one load; a network of shuffles then turns kLanes rows into three packs, where single scalars would be
// inserted one by one.

template <class T>
struct Row {
  typedef T Vector __attribute__((vector_size(4 * sizeof(T))));
  Vector v;
  DIFFVBD_FN static Row load(const T* p) {
    Row a;
    std::memcpy(&a.v, p, sizeof a.v);
    return a;
  }
  DIFFVBD_FN void store(T* p) const { std::memcpy(p, &v, sizeof v); }
};

template <class T>
DIFFVBD_FN Vec3<Lanes<T>> to_lanes(const Row<T>* r) {
  Vec3<Lanes<T>> out;
#if DIFFVBD_SHUFFLES
  typename Row<T>::Vector x[2], y[2], z[2];
  for (int half = 0; half < 2; ++half) {
    const auto *a = r + 4 * half, *b = a + 1, *c = a + 2, *d = a + 3;
    const auto ab_xz = __builtin_shufflevector(a->v, b->v, 0, 4, 2, 6),
               ab_y = __builtin_shufflevector(a->v, b->v, 1, 5, 3, 7);
    const auto cd_xz = __builtin_shufflevector(c->v, d->v, 0, 4, 2, 6),
               cd_y = __builtin_shufflevector(c->v, d->v, 1, 5, 3, 7);
    x[half] = __builtin_shufflevector(ab_xz, cd_xz, 0, 1, 4, 5);
    y[half] = __builtin_shufflevector(ab_y, cd_y, 0, 1, 4, 5);
    z[half] = __builtin_shufflevector(ab_xz, cd_xz, 2, 3, 6, 7);
  }
  out.x.v = __builtin_shufflevector(x[0], x[1], 0, 1, 2, 3, 4, 5, 6, 7);
  out.y.v = __builtin_shufflevector(y[0], y[1], 0, 1, 2, 3, 4, 5, 6, 7);
  out.z.v = __builtin_shufflevector(z[0], z[1], 0, 1, 2, 3, 4, 5, 6, 7);
#else
  for (int l = 0; l < kLanes; ++l) {
    out.x.v[l] = r[l].v[0];
    out.y.v[l] = r[l].v[1];
    out.z.v[l] = r[l].v[2];
  }
#endif
  return out;
}

template <class T>
DIFFVBD_FN void to_rows(const Vec3<Lanes<T>>& v, Row<T>* r) {
#if DIFFVBD_SHUFFLES
  const typename Row<T>::Vector zero = {};
  const auto spread = [&](auto x, auto y, auto z, Row<T>* out) {
    const auto xy_even = __builtin_shufflevector(x, y, 0, 4, 2, 6), xy_odd = __builtin_shufflevector(x, y, 1, 5, 3, 7);
    const auto z_even = __builtin_shufflevector(z, zero, 0, 4, 2, 6),
               z_odd = __builtin_shufflevector(z, zero, 1, 5, 3, 7);
    out[0].v = __builtin_shufflevector(xy_even, z_even, 0, 1, 4, 5);
    out[1].v = __builtin_shufflevector(xy_odd, z_odd, 0, 1, 4, 5);
    out[2].v = __builtin_shufflevector(xy_even, z_even, 2, 3, 6, 7);
    out[3].v = __builtin_shufflevector(xy_odd, z_odd, 2, 3, 6, 7);
  };
  const auto &x = v.x.v, &y = v.y.v, &z = v.z.v;
  spread(__builtin_shufflevector(x, x, 0, 1, 2, 3), __builtin_shufflevector(y, y, 0, 1, 2, 3),
         __builtin_shufflevector(z, z, 0, 1, 2, 3), r);
  spread(__builtin_shufflevector(x, x, 4, 5, 6, 7), __builtin_shufflevector(y, y, 4, 5, 6, 7),
         __builtin_shufflevector(z, z, 4, 5, 6, 7), r + 4);
#else
  for (int l = 0; l < kLanes; ++l) r[l].v = typename Row<T>::Vector{v.x.v[l], v.y.v[l], v.z.v[l], T(0)};
#endif
}

}  // namespace DIFFVBD_SET
}  // namespace diffvbd
