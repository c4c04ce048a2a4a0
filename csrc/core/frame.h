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

// A reflection I - v v^T with |v|^2 = 2 that brings a first normal to the x axis, then a turn about x that brings a
// second one to the xy plane.
template <class R>
struct Frame {
  Vec3<R> v;
  R cosine, sine;
  R tiny;       // components of a unit normal below it are rounding
  bool turned;  // whether any lane has a plane

  // The axes as they are: nothing else is read, or written.
  DIFFVBD_FN static Frame none() {
    Frame f;
    f.turned = false;
    return f;
  }
  // `first` and `second` are unit normals, or zero where a lane has none
  template <class T>
  DIFFVBD_FN static Frame along(const Vec3<R>& first, const Vec3<R>& second) {
    Frame f;
    f.cosine = R(1);
    f.sine = R(0);
    f.tiny = R(8 * std::numeric_limits<T>::epsilon());
    f.turned = true;
    const Vec3<R> u = {first.x + select(first.x < R(0), R(-1), R(1)), first.y, first.z};
    const R scale = select(R(0) < dot(first, first), square_root(R(2) / dot(u, u)), R(0));
    f.v = scale * u;
    const Vec3<R> t = f.to(second);
    const R length = square_root(t.y * t.y + t.z * t.z);
    const auto apart = f.tiny < length;  // parallel planes have one direction
    const R inverse = R(1) / select(apart, length, R(1));
    f.cosine = select(apart, t.y * inverse, R(1));
    f.sine = select(apart, t.z * inverse, R(0));
    return f;
  }

  DIFFVBD_FN Vec3<R> to(const Vec3<R>& a) const {
    if (!turned) return a;
    const Vec3<R> b = a - dot(v, a) * v;
    return {b.x, cosine * b.y + sine * b.z, cosine * b.z - sine * b.y};
  }
  DIFFVBD_FN Vec3<R> from(const Vec3<R>& a) const {
    if (!turned) return a;
    const Vec3<R> b = {a.x, cosine * a.y - sine * a.z, sine * a.y + cosine * a.z};
    return b - dot(v, b) * v;
  }
  DIFFVBD_FN Sym3<R> to(const Sym3<R>& a) const {
    if (!turned) return a;
    const Vec3<R> av = a * v, w = av - (R(0.5) * dot(v, av)) * v;
    const Sym3<R> b = {a.xx - R(2) * v.x * w.x, a.xy - v.x * w.y - w.x * v.y, a.xz - v.x * w.z - w.x * v.z,
                       a.yy - R(2) * v.y * w.y, a.yz - v.y * w.z - w.y * v.z, a.zz - R(2) * v.z * w.z};
    const R cc = cosine * cosine, ss = sine * sine, cs = cosine * sine, twice = R(2) * cs * b.yz;
    return {b.xx,
            cosine * b.xy + sine * b.xz,
            cosine * b.xz - sine * b.xy,
            cc * b.yy + twice + ss * b.zz,
            cs * (b.zz - b.yy) + (cc - ss) * b.yz,
            ss * b.yy - twice + cc * b.zz};
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
  return {constant(f.v), Dual<R>(f.cosine), Dual<R>(f.sine), Dual<R>(f.tiny), f.turned};
}

// Where no energy has planes.
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
