// The matrix of a step, body by body, A = M (x) I3 + h^2 sum over groups of R_g K_g R_g^T, and its transpose. R_g is
// the rotation nearest to the mean deformation of the group at the start of the step (docs/method.md, section 15).
#pragma once

#include <cmath>

#include "../rigid/rotation.h"
#include "views.h"

namespace diffvbd::coarse {

using rigid::Matrix, rigid::outer, rigid::Vector;

constexpr double kCollapsed = 1e-3;  // of a group's volume: below it the sum of two stretches determines no rotation

// Eigenvectors of a symmetric matrix as the columns of v, by Jacobi's rotations.
DIFFVBD_FN void eigenvectors(double (&a)[3][3], double (&v)[3][3]) {
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) v[i][j] = i == j;
  }
  for (int sweep = 0; sweep < 12; ++sweep) {
    const double off = a[0][1] * a[0][1] + a[0][2] * a[0][2] + a[1][2] * a[1][2];
    const double all = a[0][0] * a[0][0] + a[1][1] * a[1][1] + a[2][2] * a[2][2];
    if (!(off > 1e-34 * all)) return;
    for (int p = 0; p < 2; ++p) {
      for (int q = p + 1; q < 3; ++q) {
        if (a[p][q] == 0) continue;
        const double theta = (a[q][q] - a[p][p]) / (2 * a[p][q]);
        const double t = (theta < 0 ? -1 : 1) / (std::abs(theta) + std::sqrt(theta * theta + 1));
        const double c = 1 / std::sqrt(t * t + 1), s = t * c;
        for (int k = 0; k < 3; ++k) {
          const double x = a[k][p], y = a[k][q];
          a[k][p] = c * x - s * y, a[k][q] = s * x + c * y;
        }
        for (int k = 0; k < 3; ++k) {
          const double x = a[p][k], y = a[q][k];
          a[p][k] = c * x - s * y, a[q][k] = s * x + c * y;
        }
        for (int k = 0; k < 3; ++k) {
          const double x = v[k][p], y = v[k][q];
          v[k][p] = c * x - s * y, v[k][q] = s * x + c * y;
        }
      }
    }
  }
}

// The rotation nearest to f, of any size and sign; false where f has too little of two stretches to tell.
DIFFVBD_FN bool nearest_rotation(const Matrix& f, double volume, Matrix& rotation) {
  const Matrix square = transposed(f) * f;
  double a[3][3] = {
      {square.x.x, square.x.y, square.x.z}, {square.y.x, square.y.y, square.y.z}, {square.z.x, square.z.y, square.z.z}};
  double v[3][3];
  eigenvectors(a, v);
  int order[3] = {0, 1, 2};
  for (int i = 0; i < 2; ++i) {
    for (int j = 0; j < 2 - i; ++j) {
      const int here = order[j], next = order[j + 1];
      if (a[here][here] < a[next][next]) order[j] = next, order[j + 1] = here;
    }
  }
  const auto column = [&](int i) { return Vector{v[0][order[i]], v[1][order[i]], v[2][order[i]]}; };
  const Vector v1 = column(0), v2 = column(1), v3 = cross(v1, v2);
  const Vector f1 = f * v1, f2 = f * v2, f3 = f * v3;
  const double s1 = std::sqrt(dot(f1, f1));
  if (!(s1 > kCollapsed * volume)) return false;
  const Vector u1 = (1 / s1) * f1, rest = f2 - dot(u1, f2) * u1;
  const double s2 = std::sqrt(dot(rest, rest));
  if (!(s2 > 0)) return false;
  const Vector u2 = (1 / s2) * rest, u3 = cross(u1, u2);
  const double s3 = dot(u3, f3);
  if (!(s2 + s3 > kCollapsed * volume)) return false;
  const Matrix near = outer(u1, v1) + outer(u2, v2) + outer(u3, v3);
  // one step of Newton's method takes what the square has cost
  Matrix turn;
  rotation = rigid::polar_rotation(transposed(near) * f, turn) ? near * turn : near;
  return true;
}

template <class T>
struct MatrixInputs {
  Plan plan;
  const T* moment;             // [moments, 3]
  const double* volume;        // [groups]
  const T* x_prev;             // [B, V, 3]
  Batched<const T> stiffness;  // [B, groups, 3, 3, width, width]
  Batched<const T> mass;       // [B, mass_ptr[bodies]]
  int64_t scenes, vertices;
  double time_step;
};

// Deformation of a group times its volume, and its rotation.
template <class T>
bool rotation_of(const MatrixInputs<T>& in, int64_t scene, int group, Matrix& f, Matrix& rotation) {
  f = Matrix{};
  for (int32_t i = in.plan.moment_ptr[group]; i < in.plan.moment_ptr[group + 1]; ++i) {
    const T *x = in.x_prev + 3 * (scene * in.vertices + in.plan.moment_vertex[i]), *m = in.moment + 3 * int64_t{i};
    f = f + outer(Vector{double(x[0]), double(x[1]), double(x[2])}, Vector{double(m[0]), double(m[1]), double(m[2])});
  }
  if (nearest_rotation(f, in.volume[group], rotation)) return true;
  rotation = rigid::identity();
  return false;
}

template <class T>
DIFFVBD_FN Matrix block_at(const T* m, int64_t row, int64_t column = 1) {
  const auto at = [&](int i) {
    const T* a = m + i * row;
    return Vector{double(a[0]), double(a[column]), double(a[2 * column])};
  };
  return {at(0), at(1), at(2)};
}
template <class T>
void add_block(T* m, int64_t row, const Matrix& a, int64_t column = 1) {
  const Vector* rows[3] = {&a.x, &a.y, &a.z};
  for (int i = 0; i < 3; ++i) {
    T* to = m + i * row;
    to[0] += T(rows[i]->x), to[column] += T(rows[i]->y), to[2 * column] += T(rows[i]->z);
  }
}

// calls f(i, j, where in the body's matrix, its row) for the pairs i <= j of functions of a group
template <class F>
void each_pair(const Plan& plan, int body, int group, const F& f) {
  const int32_t* functions = plan.group_function + int64_t{group} * plan.width;
  const int32_t first = plan.function_ptr[body];
  const int64_t n = int64_t{3} * (plan.function_ptr[body + 1] - first);
  for (int i = 0; i < plan.width && functions[i] >= 0; ++i) {
    for (int j = i; j < plan.width && functions[j] >= 0; ++j) {
      f(i, j, 3 * (functions[i] - first) * n + 3 * (functions[j] - first), n);
    }
  }
}

// `out` [9 mass_ptr[bodies]] of a scene, zeroed. rotate(k, plane, r, n, to): to [3, 3, n] := r k r^T of n blocks, whose
// entries are a plane apart. `work`: 9 width scalars.
template <class T, class Rotate>
void assemble(const MatrixInputs<T>& in, int64_t scene, int body, const Rotate& rotate, T* work, T* out) {
  const Plan& plan = in.plan;
  const int32_t first = plan.function_ptr[body], count = plan.function_ptr[body + 1] - first;
  const T* mass = in.mass.data + scene * in.mass.scene + plan.mass_ptr[body];
  T* to = out + int64_t{9} * plan.mass_ptr[body];
  const int64_t n = 3 * count, width = plan.width;
  for (int i = 0; i < count; ++i) {
    for (int j = 0; j < count; ++j) {
      for (int c = 0; c < 3; ++c) to[(3 * i + c) * n + 3 * j + c] += mass[i * count + j];
    }
  }
  const double h2 = in.time_step * in.time_step;
  for (int g = plan.group_ptr[body]; g < plan.group_ptr[body + 1]; ++g) {
    Matrix f, r;
    rotation_of(in, scene, g, f, r);
    const T turn[9] = {T(r.x.x), T(r.x.y), T(r.x.z), T(r.y.x), T(r.y.y), T(r.y.z), T(r.z.x), T(r.z.y), T(r.z.z)};
    const T* k = in.stiffness.data + scene * in.stiffness.scene + g * 9 * width * width;
    const int32_t* functions = plan.group_function + g * width;
    int64_t used = 0;
    while (used < width && functions[used] >= 0) ++used;
    for (int64_t i = 0; i < used; ++i) {
      // the blocks from the diagonal on: the same numbers go to both sides of it
      const int64_t blocks = used - i;
      rotate(k + i * width + i, width * width, turn, blocks, work);
      const int64_t own = 3 * (functions[i] - first);
      for (int64_t j = 0; j < blocks; ++j) {
        const int64_t other = 3 * (functions[i + j] - first);
        for (int a = 0; a < 3; ++a) {
          for (int c = 0; c < 3; ++c) {
            const T value = T(h2) * work[(3 * a + c) * blocks + j];
            to[(own + a) * n + other + c] += value;
            if (j > 0) to[(other + c) * n + own + a] += value;
          }
        }
      }
    }
  }
}

// Adds to x_bar [V, 3], stiffness_bar [groups, 3, 3, width, width] and mass_bar of a scene; the last two may be null.
template <class T>
void assemble_vjp(const MatrixInputs<T>& in, int64_t scene, int body, const T* bar, T* x_bar, T* stiffness_bar,
                  T* mass_bar) {
  const Plan& plan = in.plan;
  const int count = plan.function_ptr[body + 1] - plan.function_ptr[body];
  const T* from = bar + int64_t{9} * plan.mass_ptr[body];
  const int64_t n = 3 * count;
  for (int i = 0; mass_bar && i < count; ++i) {
    for (int j = 0; j < count; ++j) {
      const T* at = from + 3 * i * n + 3 * j;
      mass_bar[plan.mass_ptr[body] + i * count + j] += at[0] + at[n + 1] + at[2 * n + 2];
    }
  }
  const double h2 = in.time_step * in.time_step;
  const int64_t width = plan.width, plane = width * width;
  for (int g = plan.group_ptr[body]; g < plan.group_ptr[body + 1]; ++g) {
    Matrix f, r, r_bar{};
    const bool turns = rotation_of(in, scene, g, f, r);
    const Matrix back = transposed(r);
    const T* k = in.stiffness.data + scene * in.stiffness.scene + g * 9 * plane;
    each_pair(plan, body, g, [&](int i, int j, int64_t at, int64_t stride) {
      // the forward mirrors the blocks above the diagonal
      Matrix a_bar = h2 * block_at(from + at, stride);
      if (j > i) a_bar = a_bar + h2 * transposed(block_at(from + at % stride * stride + at / stride, stride));
      const Matrix block = block_at(k + i * width + j, 3 * plane, plane);
      if (stiffness_bar) {
        add_block(stiffness_bar + g * 9 * plane + i * width + j, 3 * plane, back * a_bar * r, plane);
      }
      r_bar = r_bar + a_bar * r * transposed(block) + transposed(a_bar) * r * block;
    });
    if (!turns) continue;
    const Matrix f_bar = rigid::polar_vjp(f, r, r_bar);
    for (int32_t i = plan.moment_ptr[g]; i < plan.moment_ptr[g + 1]; ++i) {
      const T* m = in.moment + 3 * int64_t{i};
      const Vector add = f_bar * Vector{double(m[0]), double(m[1]), double(m[2])};
      T* to = x_bar + 3 * int64_t{plan.moment_vertex[i]};
      to[0] += T(add.x), to[1] += T(add.y), to[2] += T(add.z);
    }
  }
}

}  // namespace diffvbd::coarse
