// The axes in which the block of a vertex near planes is factored. A plane adds s n n^T with s far above the rest of
// the block; along an oblique n that sum rounds away what the other directions hold, and the small n . d and n . p with
// it. With n along the first axis s meets one entry alone, and L D L^T, which takes that axis first, keeps the digits
// of every direction.
#pragma once

#include <limits>

#include "dual.h"

namespace diffvbd {

template <class R>
DIFFVBD_FN R without_rounding(const R& a, const R& tiny) {
  return select(absolute(a) < tiny, R(0), a);
}
template <class R>
DIFFVBD_FN Dual<R> without_rounding(const Dual<R>& a, const Dual<R>& tiny) {
  return {without_rounding(a.value, tiny.value), a.derivative};
}

// Three axes: the first along a first normal, the second in the plane of it and a second one. Where a normal is an axis
// of the mesh so are all three, and turning rounds nothing.
template <class R>
struct Frame {
  Vec3<R> first, second, third;
  R tiny;       // components of a unit normal below it are rounding; 0 for a lane without a plane
  bool turned;  // whether any lane has a plane

  // The axes of the mesh: nothing else is read, or written.
  DIFFVBD_FN static Frame none() {
    Frame f;
    f.turned = false;
    return f;
  }
  // n and m are unit normals, or zero where a lane has none
  template <class T>
  DIFFVBD_FN static Frame along(const Vec3<R>& n, const Vec3<R>& m) {
    Frame f;
    f.turned = true;
    const auto exists = R(0) < dot(n, n);
    f.tiny = select(exists, R(8 * std::numeric_limits<T>::epsilon()), R(0));
    // the rows of a reflection I - s u u^T that brings n to -+ the x axis
    const Vec3<R> u = {n.x + select(n.x < R(0), R(-1), R(1)), n.y, n.z};
    const R s = select(exists, R(2) / dot(u, u), R(0));
    const Vec3<R> a = {-s * u.y * u.x, R(1) - s * u.y * u.y, -s * u.y * u.z};
    const Vec3<R> b = {-s * u.z * u.x, -s * u.z * u.y, R(1) - s * u.z * u.z};
    f.first = select(exists, n, Vec3<R>{R(1), R(0), R(0)});
    const R y = dot(a, m), z = dot(b, m), length = square_root(y * y + z * z);
    const auto apart = f.tiny < length;  // parallel planes have one direction
    const R inverse = R(1) / select(apart, length, R(1));
    const R cosine = select(apart, y * inverse, R(1)), sine = select(apart, z * inverse, R(0));
    f.second = cosine * a + sine * b;
    f.third = cosine * b - sine * a;
    return f;
  }

  DIFFVBD_FN Vec3<R> to(const Vec3<R>& a) const {
    if (!turned) return a;
    return {dot(first, a), dot(second, a), dot(third, a)};
  }
  DIFFVBD_FN Vec3<R> from(const Vec3<R>& a) const {
    if (!turned) return a;
    return a.x * first + a.y * second + a.z * third;
  }
  DIFFVBD_FN Sym3<R> to(const Sym3<R>& a) const {
    if (!turned) return a;
    const Vec3<R> x = a * first, y = a * second, z = a * third;
    return {dot(first, x), dot(first, y), dot(first, z), dot(second, y), dot(second, z), dot(third, z)};
  }
  // A unit normal whose zeros are exact: one that is rounding instead would bring s to another axis.
  DIFFVBD_FN Vec3<R> normal(const Vec3<R>& n) const {
    if (!turned) return n;
    const Vec3<R> a = to(n);
    return {without_rounding(a.x, tiny), without_rounding(a.y, tiny), without_rounding(a.z, tiny)};
  }
};

template <class R>
DIFFVBD_FN Frame<Dual<R>> constant(const Frame<R>& f) {
  if (!f.turned) return Frame<Dual<R>>::none();
  return {constant(f.first), constant(f.second), constant(f.third), Dual<R>(f.tiny), f.turned};
}

// The axes of the mesh, for sets without planes.
template <class R>
struct NoFrame {
  static constexpr bool turned = false;
  DIFFVBD_FN static NoFrame none() { return {}; }
  template <class A>
  DIFFVBD_FN const A& to(const A& a) const {
    return a;
  }
  DIFFVBD_FN const Vec3<R>& from(const Vec3<R>& a) const { return a; }
};

}  // namespace diffvbd
