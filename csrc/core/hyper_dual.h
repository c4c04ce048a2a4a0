// A scalar with its derivatives in two directions and the mixed second one: what a generated law is evaluated with for
// the adjoint of g + H d. With it, products of Dual and Hyper with plain scalars, which cost less than those of two.
#pragma once

#include "dual.h"

namespace diffvbd {

template <class R>
struct Hyper {
  R value, first, second, mixed;
  Hyper() = default;
  DIFFVBD_FN Hyper(const R& v, const R& a, const R& b, const R& ab) : value(v), first(a), second(b), mixed(ab) {}
  DIFFVBD_FN explicit Hyper(const R& v) : value(v), first(R(0)), second(R(0)), mixed(R(0)) {}
};

// What phi = p . (g + H d) takes of an energy along (p, d): the derivative along p and the mixed one.
template <class R>
DIFFVBD_FN R extract(const Hyper<R>& a) {
  return a.first + a.mixed;
}
template <class R>
DIFFVBD_FN R extract(const Dual<R>& a) {
  return a.derivative;
}
template <class S>
DIFFVBD_FN auto extract(const Vec3<S>& a) -> Vec3<decltype(extract(a.x))> {
  return {extract(a.x), extract(a.y), extract(a.z)};
}

template <class R>
DIFFVBD_FN R value_of(const Hyper<R>& a) {
  return a.value;
}
template <class R>
DIFFVBD_FN Hyper<R> operator+(const Hyper<R>& a, const Hyper<R>& b) {
  return {a.value + b.value, a.first + b.first, a.second + b.second, a.mixed + b.mixed};
}
template <class R>
DIFFVBD_FN Hyper<R> operator-(const Hyper<R>& a, const Hyper<R>& b) {
  return {a.value - b.value, a.first - b.first, a.second - b.second, a.mixed - b.mixed};
}
template <class R>
DIFFVBD_FN Hyper<R> operator-(const Hyper<R>& a) {
  return {-a.value, -a.first, -a.second, -a.mixed};
}
template <class R>
DIFFVBD_FN Hyper<R> operator*(const Hyper<R>& a, const Hyper<R>& b) {
  return {a.value * b.value, a.first * b.value + a.value * b.first, a.second * b.value + a.value * b.second,
          a.mixed * b.value + a.first * b.second + a.second * b.first + a.value * b.mixed};
}
// f(a) from f, f' and f'' at a's value
template <class R>
DIFFVBD_FN Hyper<R> chained(const Hyper<R>& a, const R& f, const R& slope, const R& curvature) {
  return {f, slope * a.first, slope * a.second, slope * a.mixed + curvature * a.first * a.second};
}
template <class R>
DIFFVBD_FN Dual<R> chained(const Dual<R>& a, const R& f, const R& slope, const R&) {
  return {f, slope * a.derivative};
}
template <class R>
DIFFVBD_FN Hyper<R> operator/(const Hyper<R>& a, const Hyper<R>& b) {
  const R inverse = R(1) / b.value, slope = -(inverse * inverse);
  return a * chained(b, inverse, slope, R(-2) * slope * inverse);
}
template <class M, class R>
DIFFVBD_FN Hyper<R> select(const M& condition, const Hyper<R>& a, const Hyper<R>& b) {
  return {select(condition, a.value, b.value), select(condition, a.first, b.first),
          select(condition, a.second, b.second), select(condition, a.mixed, b.mixed)};
}

// --- with plain scalars

#define DIFFVBD_MIXED(Number)                                      \
  template <class R>                                               \
  DIFFVBD_FN Number<R> operator+(const Number<R>& a, const R& b) { \
    Number<R> out = a;                                             \
    out.value = a.value + b;                                       \
    return out;                                                    \
  }                                                                \
  template <class R>                                               \
  DIFFVBD_FN Number<R> operator+(const R& a, const Number<R>& b) { \
    return b + a;                                                  \
  }                                                                \
  template <class R>                                               \
  DIFFVBD_FN Number<R> operator-(const Number<R>& a, const R& b) { \
    return a + (-b);                                               \
  }                                                                \
  template <class R>                                               \
  DIFFVBD_FN Number<R> operator-(const R& a, const Number<R>& b) { \
    return -b + a;                                                 \
  }                                                                \
  template <class R>                                               \
  DIFFVBD_FN Number<R> operator*(const R& a, const Number<R>& b) { \
    return b * a;                                                  \
  }                                                                \
  template <class R>                                               \
  DIFFVBD_FN Number<R> operator/(const R& a, const Number<R>& b) { \
    return Number<R>(a) / b;                                       \
  }                                                                \
  template <class R>                                               \
  DIFFVBD_FN Number<R> operator/(const Number<R>& a, const R& b) { \
    return a * (R(1) / b);                                         \
  }
template <class R>
DIFFVBD_FN Hyper<R> operator*(const Hyper<R>& a, const R& b) {
  return {a.value * b, a.first * b, a.second * b, a.mixed * b};
}
template <class R>
DIFFVBD_FN Dual<R> operator*(const Dual<R>& a, const R& b) {
  return {a.value * b, a.derivative * b};
}
DIFFVBD_MIXED(Hyper)
DIFFVBD_MIXED(Dual)
#undef DIFFVBD_MIXED

// --- functions

template <class R>
DIFFVBD_FN Hyper<R> natural_log(const Hyper<R>& a) {
  const R inverse = R(1) / a.value;
  return chained(a, natural_log(a.value), inverse, -(inverse * inverse));
}
template <class R>
DIFFVBD_FN Hyper<R> square_root(const Hyper<R>& a) {
  const R s = square_root(a.value), slope = R(0.5) / s;
  return chained(a, s, slope, R(-0.5) * slope / a.value);
}
template <class S>
DIFFVBD_FN auto exponential(const S& a) -> decltype(extract(a), S(a)) {
  const auto e = exponential(a.value);
  return chained(a, e, e, e);
}
// a^p for a constant p
template <class S, class R>
DIFFVBD_FN auto power(const S& a, const R& p) -> decltype(extract(a), S(a)) {
  const R f = power(a.value, p), inverse = R(1) / a.value, slope = p * f * inverse;
  return chained(a, f, slope, (p - R(1)) * slope * inverse);
}

}  // namespace diffvbd
