// A pack of kLanes scalars that computes on kLanes vertices of a color at once. GCC and Clang lower the vector type to
// whatever the processor has; each lane performs the scalar program, so results do not depend on the instruction set.
#pragma once

#include <cstdint>
#include <cstring>

#include "../core/views.h"

namespace diffvbd {

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
template <class T>
DIFFVBD_FN Lanes<T> square_root(const Lanes<T>& a) {
  Lanes<T> r;
  for (int l = 0; l < kLanes; ++l) r.v[l] = std::sqrt(a.v[l]);
  return r;
}
template <class T>
DIFFVBD_FN Lanes<T> natural_log(const Lanes<T>& a) {
  Lanes<T> r;
  for (int l = 0; l < kLanes; ++l) r.v[l] = std::log(a.v[l]);
  return r;
}

}  // namespace diffvbd
