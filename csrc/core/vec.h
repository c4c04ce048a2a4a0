// Three-vectors and symmetric 3x3 matrices over any scalar R: double, float, Dual, or a pack of SIMD lanes.
#pragma once

#include <cmath>

#if defined(__CUDACC__)
#define DIFFVBD_FN __host__ __device__ __forceinline__
#define DIFFVBD_COLD __host__ __device__ __noinline__
#else
#define DIFFVBD_FN inline __attribute__((always_inline))
#define DIFFVBD_COLD __attribute__((noinline))
#endif

namespace diffvbd {

// The branch-free vocabulary of the headers: packs of lanes and Dual overload it.
DIFFVBD_FN double select(bool condition, double a, double b) { return condition ? a : b; }
DIFFVBD_FN float select(bool condition, float a, float b) { return condition ? a : b; }
DIFFVBD_FN bool any(bool condition) { return condition; }
DIFFVBD_FN double square_root(double a) { return std::sqrt(a); }
DIFFVBD_FN float square_root(float a) { return std::sqrt(a); }
DIFFVBD_FN double natural_log(double a) { return std::log(a); }
DIFFVBD_FN float natural_log(float a) { return std::log(a); }

template <class R>
DIFFVBD_FN R absolute(const R& a) {
  return select(a < R(0), -a, a);
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

template <class M, class R>
DIFFVBD_FN void swap_if(const M& condition, R& a, R& b) {
  const R first = select(condition, b, a);
  b = select(condition, a, b);
  a = first;
}

// Solves A u = b by L D L^T with the largest pivot first: backward stable on the positive definite blocks of a sweep,
// where an adjugate would lose the digits that the stiffest direction takes. `least` > 0 is a lower bound of A's
// eigenvalues, hence of every pivot. Where A's conditioning leaves a pivot nothing but rounding, the bound stands in for
// it, so that |u| <= O(|b| / least) whatever A; elsewhere both clamps are idle.
template <class R>
DIFFVBD_FN Vec3<R> solve(Sym3<R> a, Vec3<R> b, const R& least) {
  const auto y_first = a.xx < a.yy;
  swap_if(y_first, a.xx, a.yy);
  swap_if(y_first, a.xz, a.yz);
  swap_if(y_first, b.x, b.y);
  const auto z_first = a.xx < a.zz;
  swap_if(z_first, a.xx, a.zz);
  swap_if(z_first, a.xy, a.yz);
  swap_if(z_first, b.x, b.z);

  const R inv1 = R(1) / a.xx;
  R l2 = a.xy * inv1, l3 = a.xz * inv1;
  R pivot2 = a.yy - l2 * a.xy, pivot3 = a.zz - l3 * a.xz;
  const R cross_term = a.yz - l2 * a.xz;
  R b2 = b.y - l2 * b.x, b3 = b.z - l3 * b.x;
  const auto last_first = pivot2 < pivot3;
  swap_if(last_first, pivot2, pivot3);
  swap_if(last_first, l2, l3);
  swap_if(last_first, b2, b3);

  pivot2 = select(least < pivot2, pivot2, least);
  const R off = select(pivot2 < cross_term, pivot2, select(cross_term < -pivot2, -pivot2, cross_term));
  const R inv2 = R(1) / pivot2;
  const R l32 = off * inv2;
  pivot3 = pivot3 - l32 * off;
  pivot3 = select(least < pivot3, pivot3, least);
  R u3 = (b3 - l32 * b2) / pivot3;
  R u2 = b2 * inv2 - l32 * u3;
  Vec3<R> u{b.x * inv1 - l2 * u2 - l3 * u3, u2, u3};
  swap_if(last_first, u.y, u.z);
  swap_if(z_first, u.x, u.z);
  swap_if(y_first, u.x, u.y);
  return u;
}

}  // namespace diffvbd
