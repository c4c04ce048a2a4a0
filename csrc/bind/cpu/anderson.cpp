// CPU implementation of Anderson's method: the combination of the last iterates of a step, body by body.
#include <torch/csrc/stable/library.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <limits>
#include <tuple>
#include <vector>

#include "../../cpu/threads.h"
#include "../rigid.h"
#include "sweep.h"

namespace {

namespace rigid = diffvbd::rigid;
using diffvbd::batched, diffvbd::data, diffvbd::dispatch_float, diffvbd::empty, diffvbd::for_bodies, diffvbd::is_index,
    diffvbd::require, diffvbd::Threads;
using rigid::Vector;
using torch::stable::Tensor;

constexpr int kMostWindow = 10;  // twin of MOST in diffvbd/model/anderson.py
constexpr int kPairs = kMostWindow * (kMostWindow + 1) / 2;

// The last iterates of a step, and what a cycle made of each: x_i and g_i, i = 0 ... window.
template <class T>
struct Iterates {
  const T* states;  // [2, window + 1, B, V, 3]
  int64_t size;     // of one state
  int window;

  Vector end(int i, int64_t row) const { return diffvbd::wide_at(states + (window + 1 + i) * size + 3 * row); }
  Vector residual(int i, int64_t row) const { return end(i, row) - diffvbd::wide_at(states + i * size + 3 * row); }
};

// L L^T = N in place, the lower triangle row by row; then N^-1
inline void invert(double* n, int m, double* inverse) {
  const auto at = [](int i, int j) { return i * (i + 1) / 2 + j; };
  for (int i = 0; i < m; ++i) {
    for (int j = 0; j <= i; ++j) {
      double left = n[at(i, j)];
      for (int k = 0; k < j; ++k) left -= n[at(i, k)] * n[at(j, k)];
      n[at(i, j)] = i == j ? std::sqrt(left) : left / n[at(j, j)];
    }
  }
  for (int c = 0; c < m; ++c) {
    double x[kMostWindow];
    for (int i = 0; i < m; ++i) {
      x[i] = i == c;
      for (int k = 0; k < i; ++k) x[i] -= n[at(i, k)] * x[k];
      x[i] /= n[at(i, i)];
    }
    for (int i = m - 1; i >= 0; --i) {
      for (int k = i + 1; k < m; ++k) x[i] -= n[at(k, i)] * x[k];
      x[i] /= n[at(i, i)];
      inverse[i * m + c] = x[i];
    }
  }
}

// g_k - dG gamma of one body, with gamma and the inverse of its system; no numbers where a difference of residuals is
// at most `noise` of the positions
template <class T>
void combine(const rigid::Body<T>& b, const Threads& team, const Iterates<T>& it, double regularization, double noise,
             T* to, T* inverse, T* gamma) {
  constexpr int kSums = kPairs + kMostWindow + 1;
  const int m = it.window;
  double sums[kSums];
  team.template sum<kSums>(b.size(), sums, [&](int32_t i, double* sum) {
    const int32_t v = b.vertex(i);
    const int64_t row = b.row(v);
    const double mass = b.mass(v);
    Vector d[kMostWindow], last = it.residual(0, row);
    for (int j = 0; j < m; ++j) {
      const Vector next = it.residual(j + 1, row);
      d[j] = next - last;
      last = next;
    }
    double* pair = sum;
    for (int j = 0; j < m; ++j) {
      const Vector weighted = mass * d[j];
      for (int k = 0; k <= j; ++k) *pair++ += dot(weighted, d[k]);
      sum[kPairs + j] += dot(weighted, last);
    }
    sum[kSums - 1] += mass * dot(it.end(m, row), it.end(m, row));
  });
  const double least = noise * noise * sums[kSums - 1];
  bool noisy = false;
  double full[kMostWindow * kMostWindow], weights[kMostWindow];
  for (int j = 0; j < m; ++j) {
    double& diagonal = sums[j * (j + 1) / 2 + j];
    noisy = noisy || !(diagonal > least);
    diagonal += regularization * diagonal;
  }
  invert(sums, m, full);
  for (int j = 0; j < m; ++j) {
    weights[j] = noisy ? std::numeric_limits<double>::quiet_NaN() : 0.0;
    for (int k = 0; k < m; ++k)
      weights[j] += full[j * m + k] * sums[kPairs + k], inverse[j * m + k] = T(full[j * m + k]);
    gamma[j] = T(weights[j]);
  }
  team.each(b.size(), [&](int32_t i) {
    const int64_t row = b.row(b.vertex(i));
    Vector x = it.end(m, row);
    for (int j = 0; j < m; ++j) x = x - weights[j] * (it.end(j + 1, row) - it.end(j, row));
    to[3 * row] = T(x.x), to[3 * row + 1] = T(x.y), to[3 * row + 2] = T(x.z);
  });
}

std::tuple<Tensor, Tensor, Tensor> anderson_combine(const Tensor& states, const Tensor& mass, const Tensor& order,
                                                    const Tensor& ptr, double regularization, double noise) {
  require(states.dim() == 5 && states.size(0) == 2 && states.size(1) > 1 && states.size(1) <= kMostWindow + 1 &&
              states.size(4) == 3 && states.is_contiguous(),
          "diffvbd::anderson_combine: expected contiguous states [2, iterates, scenes, vertices, 3], 2 to 11 iterates");
  require(is_index(order, states) && is_index(ptr, states) && ptr.numel() > 0,
          "diffvbd::anderson_combine: expected order and ptr int32 of one list of bodies");
  return dispatch_float(states, [&](auto scalar) {
    using T = decltype(scalar);
    const int64_t scenes = states.size(2), vertices = states.size(3), bodies = ptr.numel() - 1, m = states.size(1) - 1;
    const Iterates<T> it{data<const T>(states), scenes * vertices * 3, static_cast<int>(m)};
    rigid::Inputs<T> in{};
    in.mass = batched<T>("mass", mass, states, scenes, vertices);
    in.order = data<const int32_t>(order), in.ptr = data<const int32_t>(ptr);
    in.scenes = scenes, in.vertices = static_cast<int32_t>(vertices), in.bodies = static_cast<int32_t>(bodies);
    Tensor to = empty(states, {scenes, vertices, 3}), inverse = empty(states, {scenes, bodies, m, m}),
           gamma = empty(states, {scenes, bodies, m});
    // what does not move is where the last cycle left it
    std::memcpy(data<T>(to), it.states + (2 * m + 1) * it.size, it.size * sizeof(T));
    for_bodies(in, [&](const rigid::Body<T>& body, const Threads& team) {
      const int64_t at = body.scene * bodies + body.body;
      combine(body, team, it, regularization, noise, data<T>(to), data<T>(inverse) + at * m * m,
              data<T>(gamma) + at * m);
    });
    return std::make_tuple(to, inverse, gamma);
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CPU, m) { m.impl("anderson_combine", TORCH_BOX(&anderson_combine)); }
