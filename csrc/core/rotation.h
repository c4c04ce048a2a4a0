// Rotations and the small dense solves of a rigid correction, all in double whatever the dtype of a scene.
#pragma once

#include "vec.h"

namespace diffvbd::rigid {

using Vector = Vec3<double>;

// A 3x3 matrix by its rows.
struct Matrix {
  Vector x, y, z;
};

DIFFVBD_FN Matrix identity() { return {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}; }
DIFFVBD_FN Vector operator*(const Matrix& a, const Vector& b) { return {dot(a.x, b), dot(a.y, b), dot(a.z, b)}; }
DIFFVBD_FN Matrix operator+(const Matrix& a, const Matrix& b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
DIFFVBD_FN Matrix operator*(double s, const Matrix& a) { return {s * a.x, s * a.y, s * a.z}; }
DIFFVBD_FN Matrix transposed(const Matrix& a) {
  return {{a.x.x, a.y.x, a.z.x}, {a.x.y, a.y.y, a.z.y}, {a.x.z, a.y.z, a.z.z}};
}
DIFFVBD_FN Vector transposed_times(const Matrix& a, const Vector& b) { return b.x * a.x + b.y * a.y + b.z * a.z; }
DIFFVBD_FN Matrix operator*(const Matrix& a, const Matrix& b) {
  return {transposed_times(b, a.x), transposed_times(b, a.y), transposed_times(b, a.z)};
}
DIFFVBD_FN Matrix outer(const Vector& a, const Vector& b) { return {a.x * b, a.y * b, a.z * b}; }
DIFFVBD_FN double inner(const Matrix& a, const Matrix& b) { return dot(a.x, b.x) + dot(a.y, b.y) + dot(a.z, b.z); }
DIFFVBD_FN double trace(const Matrix& a) { return a.x.x + a.y.y + a.z.z; }

// [w] with [w] r = w x r; and of a - a^T = [2 axis] the vector that <a, [w]> = axial(a) . w
DIFFVBD_FN Matrix cross_matrix(const Vector& w) { return {{0, -w.z, w.y}, {w.z, 0, -w.x}, {-w.y, w.x, 0}}; }
DIFFVBD_FN Vector axial(const Matrix& a) { return {a.z.y - a.y.z, a.x.z - a.z.x, a.y.x - a.x.y}; }

// sin t / t, (1 - cos t) / t^2 and (t - sin t) / t^3; below an angle of 1e-2 by series, which have no cancellation.
struct Angles {
  double a, b, c;
  DIFFVBD_FN explicit Angles(const Vector& w) {
    const double t2 = dot(w, w);
    if (t2 < 1e-4) {
      a = 1 - t2 / 6 * (1 - t2 / 20 * (1 - t2 / 42 * (1 - t2 / 72)));
      b = 0.5 - t2 / 24 * (1 - t2 / 30 * (1 - t2 / 56 * (1 - t2 / 90)));
      c = 1.0 / 6 - t2 / 120 * (1 - t2 / 42 * (1 - t2 / 72 * (1 - t2 / 110)));
    } else {
      const double t = std::sqrt(t2), half = std::sin(0.5 * t);
      a = std::sin(t) / t;
      b = 2 * half * half / t2;
      c = (1 - a) / t2;
    }
  }
};

// exp [w] - 1 (Rodrigues)
DIFFVBD_FN Matrix turned_by(const Vector& w) {
  const Angles s(w);
  const Matrix k = cross_matrix(w);
  return s.a * k + s.b * (k * k);
}

// w_bar of E = exp [w], given E_bar E^T: the transposed left Jacobian of SO(3) times its axial vector.
DIFFVBD_FN Vector turn_vjp(const Vector& w, const Matrix& bar_times_transposed) {
  const Angles s(w);
  const Vector v = axial(bar_times_transposed), u = cross(v, w);
  return v + s.b * u + s.c * cross(u, w);
}

// tr(a) - (a + a^T) / 2: with a = sum m r q^T what a turn of the r sees of sum m r . q to second order
DIFFVBD_FN Sym3<double> turning_stiffness(const Matrix& a) {
  return {a.y.y + a.z.z, -0.5 * (a.x.y + a.y.x), -0.5 * (a.x.z + a.z.x),
          a.x.x + a.z.z, -0.5 * (a.y.z + a.z.y), a.x.x + a.y.y};
}

// Whether a symmetric matrix is positive definite by more than rounding, as a fraction of its trace.
DIFFVBD_FN bool definite(const Sym3<double>& a) {
  constexpr double kLeast = 1e-10;
  const double least = kLeast * (a.xx + a.yy + a.zz);
  if (!(a.xx > least)) return false;
  const double second = a.yy - a.xy * a.xy / a.xx, off = a.yz - a.xy * a.xz / a.xx;
  if (!(second > least)) return false;
  return a.zz - a.xz * a.xz / a.xx - off * off / second > least;
}

DIFFVBD_FN Vector solve_definite(const Sym3<double>& a, const Vector& b) { return solve(factor<double>(a, 0.0), b); }

// The rotation R for which tr(R^T b) is largest, by Newton's method from the identity. False where b determines none
// (a body collapsed to a line, or turned inside out): then R is left alone. Far from it the stiffness of a slender
// body, of which one moment is much the largest, is indefinite or nearly so: with the norm of b in its diagonal steps
// are shorter.
DIFFVBD_FN bool polar_rotation(const Matrix& b, Matrix& rotation) {
  constexpr int kMost = 40;
  constexpr double kArrived = 1e-30;  // squared angle: the next step would be below rounding
  constexpr double kFar = 0.25;       // the same, beyond which the stiffness has to be trusted less
  Matrix r = identity();
  for (int k = 0; k < kMost; ++k) {
    const Matrix m = transposed(r) * b;
    Sym3<double> stiffness = turning_stiffness(m);
    const bool holds = definite(stiffness);
    Vector w = solve_definite(stiffness, axial(m));
    if (!holds || !(dot(w, w) < kFar)) {
      if (!(dot(b.x, cross(b.y, b.z)) > 0)) return false;  // turned inside out, or not a number
      const double shift = std::sqrt(inner(b, b));
      stiffness.xx += shift, stiffness.yy += shift, stiffness.zz += shift;
      w = solve_definite(stiffness, axial(m));
    }
    if (!(dot(w, w) < 1)) return false;  // farther than the step can be trusted
    r = r + r * turned_by(w);
    if (dot(w, w) < kArrived) {
      if (!holds) return false;
      rotation = r;
      return true;
    }
  }
  return false;
}

// b_bar of the rotation R that polar_rotation found: dR = R [w] with turning_stiffness(R^T b) w = axial(R^T db).
DIFFVBD_FN Matrix polar_vjp(const Matrix& b, const Matrix& rotation, const Matrix& rotation_bar) {
  const Matrix back = transposed(rotation);
  return rotation * cross_matrix(solve_definite(turning_stiffness(back * b), axial(back * rotation_bar)));
}

// L D L^T of a symmetric 6x6 matrix, its lower triangle by rows, in place; the diagonal receives the inverse pivots.
constexpr int kSix = 21;
DIFFVBD_FN constexpr int at6(int row, int column) { return row * (row + 1) / 2 + column; }
DIFFVBD_FN void factor6(double* a) {
  double pivot[6], scaled[6];
  for (int j = 0; j < 6; ++j) {
    pivot[j] = a[at6(j, j)];
    for (int k = 0; k < j; ++k) {
      scaled[k] = a[at6(j, k)] * pivot[k];
      pivot[j] -= a[at6(j, k)] * scaled[k];
    }
    const double inverse = 1 / pivot[j];
    for (int i = j + 1; i < 6; ++i) {
      for (int k = 0; k < j; ++k) a[at6(i, j)] -= a[at6(i, k)] * scaled[k];
      a[at6(i, j)] *= inverse;
    }
    a[at6(j, j)] = inverse;
  }
}

// b := A^-1 b
DIFFVBD_FN void solve6(const double* a, double* b) {
  for (int i = 1; i < 6; ++i) {
    for (int k = 0; k < i; ++k) b[i] -= a[at6(i, k)] * b[k];
  }
  for (int i = 5; i >= 0; --i) {
    b[i] *= a[at6(i, i)];
    for (int k = i + 1; k < 6; ++k) b[i] -= a[at6(k, i)] * b[k];
  }
}

}  // namespace diffvbd::rigid
