// The start of a substep with contact (docs/method.md, section 12). A unit is a free body, or a vertex of a body that
// is pinned. It goes a fraction of its displacement relative to its island: the largest of 1, 1/2, ..., 1/64 and 0 that
// keeps its radii and the gaps to floors, times the fraction that keeps its pairs apart (advance.h).
#pragma once

#include "../core/safeguards.h"
#include "advance.h"
#include "islands.h"

namespace diffvbd::contact {

constexpr int kLeastStart = 6;        // the smallest fraction but 0 is 2^-6
constexpr double kWholeStart = 0.99;  // fraction from which a vertex counts as not truncated

template <class T>
struct StartInputs {
  AdvanceInputs<T> gate;  // its `move` points to `wanted` of the memory
  const T *move, *rigid;  // [B, V, 3]; the rigid motion of each body, null without deformation radii
  const T *trust_radius, *deformation_radius;  // [B, bodies + 1]
  Batched<const T> floor;                      // [1 | B, floor_planes, kPlaneScalars]
  int32_t floor_planes;
  T closed;  // fraction of a gap to a floor that a displacement may close
};

// Memory: by unit [kLeastStart + 2], whether a fraction is too much for it, and whether radii truncate its
// displacement; by vertex what is tried; by unit what advance() found.
template <class T>
struct StartMemory {
  uint8_t* refused;
  T *wanted, *passed;

  template <class Take>
  void parts(Take& take, int64_t vertices) {
    take(refused, (kLeastStart + 2) * vertices), take(wanted, 3 * vertices), take(passed, vertices);
  }
  DIFFVBD_FN T fraction(int64_t unit) const {
    for (int k = 0; k <= kLeastStart; ++k) {
      if (!refused[(kLeastStart + 2) * unit + k]) return T(fraction_of(k));
    }
    return T(0);
  }
  DIFFVBD_FN uint8_t& truncated(int64_t unit) const { return refused[(kLeastStart + 2) * unit + kLeastStart + 1]; }
};

template <class T>
struct StartOutputs {
  T *x, *center;          // [B, V, 3]
  T* trust_radius;        // [B, V], as are the next three
  T* deformation_radius;  // or null
  T* fraction;
  bool* truncated;
  T* deformation_center;  // [B, V, 3] or null
  int64_t* infeasible;    // [B]  pairs that hinder what is prescribed, zero at first
};

template <class T>
struct StartStep {
  StartInputs<T> in;
  StartMemory<T> m;
  StartOutputs<T> out;

  DIFFVBD_FN int64_t items() const { return in.gate.scenes * in.gate.vertices; }
};

// A vertex, by its row [B, V].
template <class T>
struct StartingVertex {
  const StartInputs<T>& in;
  int64_t row, scene;
  int32_t v, body;

  DIFFVBD_FN StartingVertex(const StartInputs<T>& given, int64_t at)
      : in(given),
        row(at),
        scene(at / given.gate.vertices),
        v(static_cast<int32_t>(at % given.gate.vertices)),
        body(given.gate.body[v]) {}
  DIFFVBD_FN bool pinned() const { return in.gate.pinned[v]; }
  DIFFVBD_FN int64_t unit() const { return in.gate.unit(scene, v); }
  DIFFVBD_FN Vec3<T> x() const { return vector_at(in.gate.x + 3 * row); }
  DIFFVBD_FN Vec3<T> move() const { return vector_at(in.move + 3 * row); }
  DIFFVBD_FN Vec3<T> u() const { return vector_at(in.gate.u + 3 * (scene * in.gate.bodies + body)); }
  DIFFVBD_FN int64_t of_body() const { return scene * (in.gate.bodies + 1) + body; }
  DIFFVBD_FN Vec3<T> moved(T fraction) const { return pinned() ? move() : u() + fraction * (move() - u()); }
};

struct ClearUnit {
  template <class T>
  DIFFVBD_FN void operator()(const StartStep<T>& s, int64_t row) const {
    for (int k = 0; k < kLeastStart + 2; ++k) s.m.refused[(kLeastStart + 2) * row + k] = 0;
  }
};
// Marks the fractions that a vertex does not admit, for its unit.
struct LimitStart {
  template <class T>
  DIFFVBD_FN void operator()(const StartStep<T>& s, int64_t row) const {
    const StartingVertex<T> a(s.in, row);
    if (a.pinned()) return;
    const Vec3<T> relative = a.move() - a.u(), at = a.x() + a.u();
    const auto length = [](const Vec3<T>& d) { return square_root(dot(d, d)); };
    const auto within = [](T radius, T size) { return size <= radius ? T(1) : radius / size; };
    T ratio = within(s.in.trust_radius[a.of_body()], length(relative));
    if (s.in.rigid) {
      const T own = within(s.in.deformation_radius[a.of_body()], length(a.move() - vector_at(s.in.rigid + 3 * row)));
      ratio = own < ratio ? own : ratio;
    }
    if (!(T(kWholeStart) <= ratio)) mark(&s.m.truncated(a.unit()));
    const Vec3<T> from = s.in.gate.origin ? vector_at(s.in.gate.origin + 3 * row) : zero3<T>();
    for (int32_t k = 0; k < s.in.floor_planes; ++k) {
      const T* plane = s.in.floor.data + a.scene * s.in.floor.scene + int64_t{k} * kPlaneScalars;
      const Vec3<T> n = vector_at(plane);
      const T gap = dot(n, at + from) - plane[3], toward = -dot(n, relative);
      if (!(T(0) < toward)) continue;
      const T above = T(0) < gap ? s.in.closed * gap / toward : T(0);
      ratio = above < ratio ? above : ratio;
    }
    for (int k = 0; k <= kLeastStart && !(T(fraction_of(k)) <= ratio); ++k) {
      mark(s.m.refused + (kLeastStart + 2) * a.unit() + k);
    }
  }
};
struct WantStart {
  template <class T>
  DIFFVBD_FN void operator()(const StartStep<T>& s, int64_t row) const {
    const StartingVertex<T> a(s.in, row);
    put(s.m.wanted + 3 * row, a.moved(s.m.fraction(a.unit())));
  }
};
struct EndStart {
  template <class T>
  DIFFVBD_FN void operator()(const StartStep<T>& s, int64_t row) const {
    const StartingVertex<T> a(s.in, row);
    const T passed = s.m.passed[a.unit()], fraction = s.m.fraction(a.unit()) * passed;
    const Vec3<T> center = a.x() + a.u();
    s.out.fraction[row] = fraction;
    s.out.truncated[row] = !a.pinned() && (s.m.truncated(a.unit()) || passed < T(kWholeStart));
    put(s.out.x + 3 * row, a.x() + a.moved(fraction)), put(s.out.center + 3 * row, center);
    s.out.trust_radius[row] = s.in.trust_radius[a.of_body()];
    if (!s.in.rigid) return;
    s.out.deformation_radius[row] = s.in.deformation_radius[a.of_body()];
    put(s.out.deformation_center + 3 * row, center + fraction * (vector_at(s.in.rigid + 3 * row) - a.u()));
  }
};

}  // namespace diffvbd::contact
