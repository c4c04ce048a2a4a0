// Three-vectors and symmetric 3x3 matrices over any scalar R: double, float, Dual, or a pack of SIMD lanes.
#pragma once

#include <cmath>
#include <limits>
#include <type_traits>

#if defined(__CUDACC__)
#define DIFFVBD_FN __host__ __device__ __forceinline__
#define DIFFVBD_APART __host__ __device__ __noinline__
#define DIFFVBD_LOOP DIFFVBD_FN
#define DIFFVBD_COLD __host__ __device__ __noinline__
#else
#define DIFFVBD_FN inline __attribute__((always_inline))
#define DIFFVBD_APART __attribute__((noinline))       // out of line
#define DIFFVBD_COLD __attribute__((noinline, cold))  // and seldom called
// A hot loop out of line: shared by the variants, and its registers do not depend on what they have around it.
#define DIFFVBD_LOOP __attribute__((noinline, flatten))
#endif

namespace diffvbd {

// The branch-free vocabulary of the headers: packs of lanes and Dual overload it.
DIFFVBD_FN double select(bool condition, double a, double b) { return condition ? a : b; }
DIFFVBD_FN float select(bool condition, float a, float b) { return condition ? a : b; }
DIFFVBD_FN bool any(bool condition) { return condition; }
DIFFVBD_FN bool all(bool condition) { return condition; }
DIFFVBD_FN bool both(bool a, bool b) { return a && b; }
DIFFVBD_FN bool either(bool a, bool b) { return a || b; }
DIFFVBD_FN double square_root(double a) { return std::sqrt(a); }
DIFFVBD_FN float square_root(float a) { return std::sqrt(a); }
DIFFVBD_FN double natural_log(double a) { return std::log(a); }
DIFFVBD_FN float natural_log(float a) { return std::log(a); }
DIFFVBD_FN double exponential(double a) { return std::exp(a); }
DIFFVBD_FN float exponential(float a) { return std::exp(a); }
DIFFVBD_FN double power(double a, double p) { return std::pow(a, p); }
DIFFVBD_FN float power(float a, float p) { return std::pow(a, p); }
// the largest power of two that is not above a > 0
DIFFVBD_FN double power_of_two(double a) { return std::exp2(std::floor(std::log2(a))); }
DIFFVBD_FN float power_of_two(float a) { return std::exp2(std::floor(std::log2(a))); }

template <class R>
DIFFVBD_FN R absolute(const R& a) {
  return select(a < R(0), -a, a);
}

// The larger of two, and the smaller; or the one that is no number.
template <class T>
DIFFVBD_FN T larger(const T& a, const T& b) {
  return a < b || b != b ? b : a;
}
template <class T>
DIFFVBD_FN T smaller(const T& a, const T& b) {
  return b < a || b != b ? b : a;
}

// f(0) ... f(n - 1) with indices that are constants (decltype(i)::value): an array that is read in no other way is
// taken apart into registers before any loop is unrolled.
template <int n, int i = 0, class F>
DIFFVBD_FN void each_below(F&& f) {
  if constexpr (i < n) {
    f(std::integral_constant<int, i>{});
    each_below<n, i + 1>(f);
  }
}

template <class R>
struct Vec3 {
  R x, y, z;
};

template <class R>
DIFFVBD_FN Vec3<R> operator+(const Vec3<R>& a, const Vec3<R>& b) {
  return {a.x + b.x, a.y + b.y, a.z + b.z};
}
template <class R>
DIFFVBD_FN Vec3<R> operator-(const Vec3<R>& a, const Vec3<R>& b) {
  return {a.x - b.x, a.y - b.y, a.z - b.z};
}
template <class R>
DIFFVBD_FN Vec3<R> operator-(const Vec3<R>& a) {
  return {-a.x, -a.y, -a.z};
}
template <class R>
DIFFVBD_FN Vec3<R> operator*(const R& s, const Vec3<R>& a) {
  return {s * a.x, s * a.y, s * a.z};
}
template <class R>
DIFFVBD_FN void operator+=(Vec3<R>& a, const Vec3<R>& b) {
  a.x = a.x + b.x;
  a.y = a.y + b.y;
  a.z = a.z + b.z;
}
template <class R>
DIFFVBD_FN void operator-=(Vec3<R>& a, const Vec3<R>& b) {
  a.x = a.x - b.x;
  a.y = a.y - b.y;
  a.z = a.z - b.z;
}
template <class M, class R>
DIFFVBD_FN Vec3<R> select(const M& condition, const Vec3<R>& a, const Vec3<R>& b) {
  return {select(condition, a.x, b.x), select(condition, a.y, b.y), select(condition, a.z, b.z)};
}
template <class R>
DIFFVBD_FN R dot(const Vec3<R>& a, const Vec3<R>& b) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}
template <class R>
DIFFVBD_FN Vec3<R> cross(const Vec3<R>& a, const Vec3<R>& b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
template <class R>
DIFFVBD_FN Vec3<R> zero3() {
  return {R(0), R(0), R(0)};
}

// Three scalars in memory: as they are, in double precision, written, and added to.
template <class T>
DIFFVBD_FN Vec3<T> vector_at(const T* p) {
  return {p[0], p[1], p[2]};
}
template <class T>
DIFFVBD_FN Vec3<double> wide_at(const T* p) {
  return {double(p[0]), double(p[1]), double(p[2])};
}
template <class T, class S>
DIFFVBD_FN void put(T* to, const Vec3<S>& a) {
  to[0] = static_cast<T>(a.x), to[1] = static_cast<T>(a.y), to[2] = static_cast<T>(a.z);
}
template <class T, class S>
DIFFVBD_FN void add_to(T* to, const Vec3<S>& a) {
  put(to, Vec3<S>{S(to[0]), S(to[1]), S(to[2])} + a);
}

template <class R>
struct Sym3 {
  R xx, xy, xz, yy, yz, zz;
};

template <class R>
DIFFVBD_FN Sym3<R> diagonal(const R& s) {
  return {s, R(0), R(0), s, R(0), s};
}
template <class R>
DIFFVBD_FN Sym3<R> operator*(const R& s, const Sym3<R>& a) {
  return {s * a.xx, s * a.xy, s * a.xz, s * a.yy, s * a.yz, s * a.zz};
}
template <class R>
DIFFVBD_FN Vec3<R> operator*(const Sym3<R>& a, const Vec3<R>& b) {
  return {a.xx * b.x + a.xy * b.y + a.xz * b.z, a.xy * b.x + a.yy * b.y + a.yz * b.z,
          a.xz * b.x + a.yz * b.y + a.zz * b.z};
}
template <class R>
DIFFVBD_FN void add_diagonal(Sym3<R>& a, const R& s) {
  a.xx = a.xx + s;
  a.yy = a.yy + s;
  a.zz = a.zz + s;
}
template <class R>
DIFFVBD_FN void operator+=(Sym3<R>& a, const Sym3<R>& b) {
  a = {a.xx + b.xx, a.xy + b.xy, a.xz + b.xz, a.yy + b.yy, a.yz + b.yz, a.zz + b.zz};
}
// a += s v v^T
template <class R>
DIFFVBD_FN void add_outer(Sym3<R>& a, const R& s, const Vec3<R>& v) {
  const Vec3<R> w = s * v;
  a.xx = a.xx + w.x * v.x;
  a.xy = a.xy + w.x * v.y;
  a.xz = a.xz + w.x * v.z;
  a.yy = a.yy + w.y * v.y;
  a.yz = a.yz + w.y * v.z;
  a.zz = a.zz + w.z * v.z;
}

// L D L^T of a symmetric matrix, with the inverse pivots: solving with it divides no more.
template <class R>
struct Factor {
  R l21, l31, l32, inv1, inv2, inv3;
};

// Backward stable on the positive definite blocks of a sweep, where an adjugate would lose the digits that the stiffest
// direction takes. `least` > 0 is a lower bound of A's eigenvalues, hence of every pivot. Where A's conditioning leaves
// a pivot nothing but rounding, that bound or the rounding itself stands in for it, and the step stays of the size of
// the stiff one; elsewhere both bounds are idle. T is the precision of R.
template <class T, class R>
DIFFVBD_FN Factor<R> factor(const Sym3<R>& a, const R& least) {
  const auto pivot = [&](const R& computed, const R& diagonal) {
    const R rounding = R(4 * std::numeric_limits<T>::epsilon()) * diagonal;
    const R bound = select(least < rounding, rounding, least);
    return select(bound < computed, computed, bound);
  };
  Factor<R> f;
  f.inv1 = R(1) / pivot(a.xx, a.xx);
  f.l21 = a.xy * f.inv1;
  f.l31 = a.xz * f.inv1;
  f.inv2 = R(1) / pivot(a.yy - f.l21 * a.xy, a.yy);
  const R t = a.yz - f.l21 * a.xz;
  f.l32 = t * f.inv2;
  f.inv3 = R(1) / pivot(a.zz - f.l31 * a.xz - f.l32 * t, a.zz);
  return f;
}

template <class R>
DIFFVBD_FN Vec3<R> solve(const Factor<R>& f, const Vec3<R>& b) {
  const R u2 = b.y - f.l21 * b.x;
  const R u3 = (b.z - f.l31 * b.x - f.l32 * u2) * f.inv3;
  const R v2 = u2 * f.inv2 - f.l32 * u3;
  return {b.x * f.inv1 - f.l21 * v2 - f.l31 * u3, v2, u3};
}

}  // namespace diffvbd
