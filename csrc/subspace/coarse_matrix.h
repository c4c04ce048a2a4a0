// The matrix of a step, body by body, A = M (x) I3 + h^2 sum over groups of R_g K_g R_g^T, and its transpose. R_g is
// the rotation nearest to the mean deformation of the group at the start of the step (docs/method.md, section 15).
#pragma once

#include <algorithm>
#include <cmath>
#include <vector>

#include "../core/rotation.h"
#include "coarse.h"

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

// --- the sums of these matrices, from the functions W of each body: the stiffness of a group at rest, sum over its
// tets of W^T K W, and the masses W^T M W; and their transposes (docs/method.md, section 15)

template <class T>
struct StiffnessInputs {
  Plan plan;
  const T* weight;                    // [entries], by position
  Batched<const T> mu, lam;           // [1 | B, 1 | tets]  lam >= -2/3 mu
  Batched<const T> gradient, volume;  // [1 | B, tets, 4, 3], [1 | B, tets]
  int64_t scenes, tets;
};

// Sums are double whatever T is: a body may have thousands of tets that nearly cancel.
struct Four {  // three components and one to spare
  double v[4];
  double& operator[](int i) { return v[i]; }
  double operator[](int i) const { return v[i]; }
};
inline void add(Four& to, double scale, const Four& a) {
  for (int i = 0; i < 4; ++i) to.v[i] += scale * a.v[i];
}
inline Four times(double scale, const Four& a) { return {scale * a[0], scale * a[1], scale * a[2], 0}; }
inline double dot(const Four& a, const Four& b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
struct Rows {
  Four row[3];
};

// The functions of a group that act on a tet, in ascending order, and their gradients in it.
template <class T>
class Slopes {
 public:
  explicit Slopes(const StiffnessInputs<T>& in) : in_(in), at_(in.plan.width, -1), slope_(in.plan.width) {
    place_.reserve(in.plan.width);
  }
  // tet k of a group
  void find(int64_t scene, int body, int group, int64_t k) {
    const Plan& p = in_.plan;
    slot_ = int64_t{p.block_ptr[body]} * kLanes + p.tet_ptr[group] - p.tet_ptr[p.group_ptr[body]] + k;
    first_ = p.place + p.place_ptr[group] - p.function_ptr[body];
    tet_ = p.tet[slot_];
    place_.clear();
    each([&](int, int place, double) {
      if (at_[place] >= 0) return;
      at_[place] = 0;
      place_.push_back(place);
    });
    std::sort(place_.begin(), place_.end());
    for (int i = 0; i < size(); ++i) at_[place_[i]] = i, slope_[i] = Four{};
    const T* g = in_.gradient.data + scene * in_.gradient.scene + 12 * tet_;
    each([&](int a, int place, double w) {
      Four& to = slope_[at_[place]];
      for (int c = 0; c < 3; ++c) to[c] += w * g[3 * a + c];
    });
    volume = of(in_.volume, scene), mu = of(in_.mu, scene), lam = of(in_.lam, scene);
    for (const int place : place_) at_[place] = -1;
  }
  // f(corner, place among the functions of the group, weight) for all functions at the corners
  template <class F>
  void each(const F& f) const {
    const Plan& p = in_.plan;
    for (int a = 0; a < 4; ++a) {
      const int64_t position = p.corner[(slot_ / kLanes * 4 + a) * kLanes + slot_ % kLanes] / kRow;
      for (int32_t e = p.position_ptr[position]; e < p.position_ptr[position + 1]; ++e) {
        f(a, first_[p.function[e]], double(in_.weight[e]));
      }
    }
  }
  int size() const { return static_cast<int>(place_.size()); }
  int place(int i) const { return place_[i]; }
  const Four& operator[](int i) const { return slope_[i]; }
  int64_t tet() const { return tet_; }
  double volume, mu, lam;

 private:
  double of(const Batched<const T>& of_tet, int64_t scene) const {
    return of_tet.data[scene * of_tet.scene + tet_ * of_tet.item];
  }
  const StiffnessInputs<T>& in_;
  int64_t slot_ = 0, tet_ = 0;
  const int32_t* first_ = nullptr;
  std::vector<int> at_, place_;
  std::vector<Four> slope_;
};

// `out` [3, 3, width, width] of a group: sum of V (mu (b a^T + (a . b) 1) + lam a b^T) for the gradients a, b of its
// functions.
template <class T>
void stiffness(const StiffnessInputs<T>& in, int64_t scene, int group, T* out) {
  const Plan& p = in.plan;
  const int64_t width = p.width, plane = width * width;
  std::vector<Rows> sum(plane, Rows{});  // from the diagonal on; the spare component of the first row is the trace's
  Slopes<T> s(in);
  for (int32_t k = 0; k < p.tet_ptr[group + 1] - p.tet_ptr[group]; ++k) {
    s.find(scene, p.group_body[group], group, k);
    for (int i = 0; i < s.size(); ++i) {
      const Four shear = times(s.volume * s.mu, s[i]), bulk = times(s.volume * s.lam, s[i]);
      for (int j = i; j < s.size(); ++j) {
        Rows& to = sum[s.place(i) * width + s.place(j)];
        const Four b = s[j];
        for (int r = 0; r < 3; ++r) {
          for (int c = 0; c < 4; ++c) to.row[r][c] += b[r] * shear[c] + bulk[r] * b[c];
        }
        to.row[0][3] += dot(shear, b);
      }
    }
  }
  for (int64_t i = 0; i < width; ++i) {
    for (int64_t j = i; j < width; ++j) {
      const Rows& from = sum[i * width + j];
      for (int r = 0; r < 3; ++r) {
        for (int c = 0; c < 3; ++c) {
          const T value = T(from.row[r][c] + (r == c ? from.row[0][3] : 0.0));
          out[(3 * r + c) * plane + i * width + j] = out[(3 * c + r) * plane + j * width + i] = value;
        }
      }
    }
  }
}

// Adjoints of a scene's tets of a group from `bar` [3, 3, width, width]; the last two may be null.
template <class T>
void stiffness_vjp(const StiffnessInputs<T>& in, int64_t scene, int group, const T* bar, T* mu_bar, T* lam_bar,
                   T* gradient_bar, T* volume_bar) {
  const Plan& p = in.plan;
  const int64_t width = p.width, plane = width * width;
  // K is quadratic in the gradients: half of what both sides of the diagonal ask for, h_ij + h_ji^T
  std::vector<Rows> both(plane);
  for (int64_t i = 0; i < width; ++i) {
    for (int64_t j = 0; j < width; ++j) {
      Rows& to = both[i * width + j];
      for (int r = 0; r < 3; ++r) {
        for (int c = 0; c < 3; ++c) {
          to.row[r][c] = double(bar[(3 * r + c) * plane + i * width + j]) + bar[(3 * c + r) * plane + j * width + i];
        }
        to.row[r][3] = 0;
      }
      to.row[0][3] = to.row[0][0] + to.row[1][1] + to.row[2][2];
    }
  }
  Slopes<T> s(in);
  std::vector<Four> slope_bar(width);
  for (int32_t k = 0; k < p.tet_ptr[group + 1] - p.tet_ptr[group]; ++k) {
    s.find(scene, p.group_body[group], group, k);
    double shear_sum = 0, bulk_sum = 0;
    for (int i = 0; i < s.size(); ++i) {
      Four shear{}, bulk{};
      for (int j = 0; j < s.size(); ++j) {
        const Four b = s[j];
        const Rows &own = both[s.place(i) * width + s.place(j)], &other = both[s.place(j) * width + s.place(i)];
        add(shear, own.row[0][3], b);
        for (int r = 0; r < 3; ++r) add(shear, b[r], own.row[r]), add(bulk, b[r], other.row[r]);
      }
      shear_sum += 0.5 * dot(shear, s[i]), bulk_sum += 0.5 * dot(bulk, s[i]);
      slope_bar[s.place(i)] = times(s.volume * s.mu, shear);
      add(slope_bar[s.place(i)], s.volume * s.lam, bulk);
    }
    mu_bar[s.tet()] = T(s.volume * shear_sum), lam_bar[s.tet()] = T(s.volume * bulk_sum);
    if (!gradient_bar) continue;
    volume_bar[s.tet()] = T(s.mu * shear_sum + s.lam * bulk_sum);
    Four of_corner[4]{};
    s.each([&](int a, int place, double w) { add(of_corner[a], w, slope_bar[place]); });
    for (int a = 0; a < 4; ++a) {
      for (int c = 0; c < 3; ++c) gradient_bar[12 * s.tet() + 3 * a + c] = T(of_corner[a][c]);
    }
  }
}

// The row of a function in the masses of its body; 1 on the diagonal of one that acts on no vertex. mass [positions].
template <class T>
void mass_row(const Plan& p, const T* weight, const T* row_weight, const T* mass, int function, T* out) {
  const int body = p.function_body[function], first = p.function_ptr[body], count = p.function_ptr[body + 1] - first;
  std::vector<double> sum(count, 0.0);
  for (int32_t r = p.row_ptr[function]; r < p.row_ptr[function + 1]; ++r) {
    const int32_t position = p.row[r];
    for (int32_t e = p.position_ptr[position]; e < p.position_ptr[position + 1]; ++e) {
      sum[p.function[e] - first] += double(mass[position]) * (double(row_weight[r]) * weight[e]);
    }
  }
  if (p.row_ptr[function] == p.row_ptr[function + 1]) sum[function - first] = 1;
  for (int i = 0; i < count; ++i) out[p.mass_ptr[body] + (function - first) * count + i] = T(sum[i]);
}

// Adjoint of the mass at a position.
template <class T>
T mass_vjp(const Plan& p, const T* weight, const T* bar, int64_t position) {
  const int body = p.position_body[position], first = p.function_ptr[body], count = p.function_ptr[body + 1] - first;
  const T* of_body = bar + p.mass_ptr[body];
  double sum = 0;
  for (int32_t d = p.position_ptr[position]; d < p.position_ptr[position + 1]; ++d) {
    for (int32_t e = p.position_ptr[position]; e < p.position_ptr[position + 1]; ++e) {
      sum += double(weight[d]) * weight[e] * of_body[(p.function[d] - first) * count + p.function[e] - first];
    }
  }
  return T(sum);
}

}  // namespace diffvbd::coarse
