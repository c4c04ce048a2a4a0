// Forward-mode scalar: value and one directional derivative. It derives the adjoint of any energy that brings only its
// block(), and checks every hand-written one.
#pragma once

#include <type_traits>

#include "vec.h"

namespace diffvbd {

template <class R>
struct Dual {
  R value, derivative;
  Dual() = default;
  DIFFVBD_FN Dual(const R& v, const R& d) : value(v), derivative(d) {}
  DIFFVBD_FN explicit Dual(const R& v) : value(v), derivative(R(0)) {}
  template <class S, std::enable_if_t<std::is_arithmetic_v<S>, int> = 0>
  DIFFVBD_FN explicit Dual(S v) : value(R(v)), derivative(R(0)) {}
};

DIFFVBD_FN double value_of(double a) { return a; }
DIFFVBD_FN float value_of(float a) { return a; }
template <class R>
DIFFVBD_FN R value_of(const Dual<R>& a) {
  return a.value;
}
template <class R>
DIFFVBD_FN Dual<R> operator+(const Dual<R>& a, const Dual<R>& b) {
  return {a.value + b.value, a.derivative + b.derivative};
}
template <class R>
DIFFVBD_FN Dual<R> operator-(const Dual<R>& a, const Dual<R>& b) {
  return {a.value - b.value, a.derivative - b.derivative};
}
template <class R>
DIFFVBD_FN Dual<R> operator-(const Dual<R>& a) {
  return {-a.value, -a.derivative};
}
template <class R>
DIFFVBD_FN Dual<R> operator*(const Dual<R>& a, const Dual<R>& b) {
  return {a.value * b.value, a.derivative * b.value + a.value * b.derivative};
}
template <class R>
DIFFVBD_FN Dual<R> operator/(const Dual<R>& a, const Dual<R>& b) {
  const R q = a.value / b.value;
  return {q, (a.derivative - q * b.derivative) / b.value};
}
// Comparisons decide on values alone: a branch is differentiated as it was executed.
template <class R>
DIFFVBD_FN auto operator<(const Dual<R>& a, const Dual<R>& b) {
  return a.value < b.value;
}
template <class M, class R>
DIFFVBD_FN Dual<R> select(const M& condition, const Dual<R>& a, const Dual<R>& b) {
  return {select(condition, a.value, b.value), select(condition, a.derivative, b.derivative)};
}
// Derived operators for every scalar that is a class: Dual and packs of lanes, which alone have a select().
template <class R>
DIFFVBD_FN auto operator>(const R& a, const R& b) -> decltype(select(b < a, a, b), b < a) {
  return b < a;
}
template <class R>
DIFFVBD_FN auto operator+=(R& a, const R& b) -> decltype(select(a < b, a, b), a = a + b) {
  return a = a + b;
}
template <class R>
DIFFVBD_FN auto operator-=(R& a, const R& b) -> decltype(select(a < b, a, b), a = a - b) {
  return a = a - b;
}
template <class R>
DIFFVBD_FN auto operator*=(R& a, const R& b) -> decltype(select(a < b, a, b), a = a * b) {
  return a = a * b;
}
template <class R>
DIFFVBD_FN Dual<R> square_root(const Dual<R>& a) {
  const R s = square_root(a.value);
  return {s, a.derivative / (s + s)};
}
template <class R>
DIFFVBD_FN Dual<R> natural_log(const Dual<R>& a) {
  return {natural_log(a.value), a.derivative / a.value};
}
template <class R>
DIFFVBD_FN Vec3<Dual<R>> constant(const Vec3<R>& a) {
  return {Dual<R>(a.x), Dual<R>(a.y), Dual<R>(a.z)};
}

}  // namespace diffvbd
