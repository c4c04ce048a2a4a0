// The loops of a coarse correction, the first two with one instantiation for each set of energies without contact.
#pragma once

#include <utility>

#include "kernels.h"

namespace diffvbd {
namespace {

template <class T, int mask>
__attribute__((flatten)) void gradient_of_blocks(const Plan& plan, const SceneView<T>& s, const StepParameters<T>& q,
                                                 int64_t begin, int64_t end) {
  using R = Lanes<T>;
  using Set = EnergySet<mask>;
  for (int64_t block = begin; block < end; ++block) {
    R values[kMaxEnergyData];
    const Block<R> b = load_block<Set>(plan, s, block, q, values);
    const System<Set, R> system = assemble<Set>(b, LaneStar<T>(plan, s, block), q);
    store_rows(s.gradient, block, system.axes.from(system.g));
  }
}

// GCC 12 crashes where it vectorizes straight-line code of this function.
template <class T, int mask>
__attribute__((flatten, optimize("no-tree-slp-vectorize"))) void reverse_gradient_of_blocks(
    const Plan& plan, const SceneView<T>& s, const StepParameters<T>& q, int64_t begin, int64_t end) {
  using R = Lanes<T>;
  using Set = EnergySet<mask>;
  for (int64_t block = begin; block < end; ++block) {
    const LaneStar<T> star(plan, s, block);
    if (block >= plan.color_block[plan.colors]) {  // pinned
      const Vec3<R> own = star.template multiply_tets<typename Set::Elastic, kMaterial | kRest>(
          load_rows(s.x, block), zero3<R>(), R(-(q.time_step * q.time_step)));
      store_rows(s.x_bar, block, load_rows(s.x_bar, block) + own);
      continue;
    }
    R values[kMaxEnergyData];
    const Block<R> b = load_block<Set>(plan, s, block, q, values);
    const BlockAdjoint<R> out = reverse_gradient<Set, kMaterial | kRest>(
        b, star, load_rows(s.displacement, block), load_rows(s.wanted, block), q, s.data_bar != nullptr,
        [&](int k, int i, const R& value) {
          const int64_t row = b.data[k] - values + i;
          LaneStar<T>::accumulate(s.data_bar + (row * plan.blocks + block) * kLanes, value);
        });
    store_rows(s.x_bar, block, load_rows(s.x_bar, block) + out.x);
    add3(s.y_bar, block, out.y);
    LaneStar<T>::accumulate(s.mass_bar + block * kLanes, out.mass);
    if constexpr (Set::reads_x_prev) add3(s.x_prev_bar, block, out.x_prev);
  }
}

template <class T>
void gather_rows(const int32_t* ptr, const int32_t* of, const T* weight, const T* from, T* to, int64_t begin,
                 int64_t end) {
  for (int64_t i = begin; i < end; ++i) {
    Row<T> sum{};
    for (int32_t e = ptr[i]; e < ptr[i + 1]; ++e) sum.v += weight[e] * Row<T>::load(from + int64_t{4} * of[e]).v;
    sum.store(to + 4 * i);
  }
}

template <class T>
__attribute__((flatten)) void rotate_blocks(const T* k, int64_t plane, const T* r, int64_t n, T* to) {
  using R = Lanes<T>;
  for (int64_t j = 0; j < n; j += kLanes) {
    const int count = static_cast<int>(n - j < kLanes ? n - j : kLanes);
    R block[9], half[9];
    for (int i = 0; i < 9; ++i) block[i] = R::load(k + i * plane + j, count);
    for (int a = 0; a < 3; ++a) {
      for (int d = 0; d < 3; ++d) {
        half[3 * a + d] = R(r[3 * a]) * block[d] + R(r[3 * a + 1]) * block[3 + d] + R(r[3 * a + 2]) * block[6 + d];
      }
    }
    for (int a = 0; a < 3; ++a) {
      for (int c = 0; c < 3; ++c) {
        const R sum = half[3 * a] * R(r[3 * c]) + half[3 * a + 1] * R(r[3 * c + 1]) + half[3 * a + 2] * R(r[3 * c + 2]);
        sum.store(to + (3 * a + c) * n + j, count);
      }
    }
  }
}

// sum of a[j] b[j], j < n, by packs: in an order that n fixes
template <class T>
DIFFVBD_FN T dot_rows(const T* a, const T* b, int64_t n) {
  Lanes<T> sum(T(0)), other(T(0));
  int64_t j = 0;
  for (; j + 2 * kLanes <= n; j += 2 * kLanes) {
    sum = sum + Lanes<T>::load(a + j) * Lanes<T>::load(b + j);
    other = other + Lanes<T>::load(a + j + kLanes) * Lanes<T>::load(b + j + kLanes);
  }
  sum = sum + other;
  T out = T(0);
  for (; j < n; ++j) out += a[j] * b[j];
  for (int l = 0; l < kLanes; ++l) out += sum.v[l];
  return out;
}

// Cholesky's method on `size` rows and columns from `begin` on.
template <class T>
DIFFVBD_FN void factor_block(T* factor, int64_t n, int64_t begin, int64_t size) {
  for (int64_t i = begin; i < begin + size; ++i) {
    T* own = factor + i * n;
    for (int64_t j = begin; j <= i; ++j) {
      const T* row = factor + j * n;
      T left = own[j];
      for (int64_t k = begin; k < j; ++k) left -= own[k] * row[k];
      own[j] = i == j ? std::sqrt(left) : left / row[j];
    }
  }
}

// The columns of the inverse of a block of kLanes rows.
template <class T>
DIFFVBD_FN void invert_block(const T* factor, int64_t n, int64_t begin, Lanes<T>* columns) {
  for (int j = 0; j < kLanes; ++j) {
    columns[j] = Lanes<T>(T(0));
    for (int i = j; i < kLanes; ++i) {
      const T* row = factor + (begin + i) * n + begin;
      T sum = T(i == j);
      for (int k = j; k < i; ++k) sum -= row[k] * columns[j].v[k];
      columns[j].v[i] = sum / row[i];
    }
  }
}

// By blocks of kLanes columns; `panel` has what earlier columns have in the rows of a block, n x kLanes.
template <class T>
__attribute__((flatten)) void factor_rows(int64_t n, T* panel, T* factor) {
  using R = Lanes<T>;
  if (n % kLanes != 0) return factor_block(factor, n, 0, n);
  constexpr int kRows = 4;
  for (int64_t begin = 0; begin < n; begin += kLanes) {
    for (int64_t k = 0; k < begin; ++k) {
      for (int64_t j = 0; j < kLanes; ++j) panel[k * kLanes + j] = factor[(begin + j) * n + k];
    }
    R columns[kLanes];
    for (int64_t i = begin; i < n; i += kRows) {
      R left[kRows];
      for (int r = 0; r < kRows; ++r) left[r] = R::load(factor + (i + r) * n + begin);
      for (int64_t k = 0; k < begin; ++k) {
        const R column = R::load(panel + k * kLanes);
        for (int r = 0; r < kRows; ++r) left[r] = left[r] - R(factor[(i + r) * n + k]) * column;
      }
      for (int r = 0; i >= begin + kLanes && r < kRows; ++r) {
        R sum(T(0));
        for (int j = 0; j < kLanes; ++j) sum = sum + R(left[r].v[j]) * columns[j];
        left[r] = sum;
      }
      for (int r = 0; r < kRows; ++r) left[r].store(factor + (i + r) * n + begin);
      if (i + kRows == begin + kLanes) {
        factor_block(factor, n, begin, kLanes);
        invert_block(factor, n, begin, columns);
      }
    }
  }
}

template <class T>
__attribute__((flatten)) void outer_rows(const T* q, int64_t q_stride, const T* a, int64_t a_stride, int count,
                                         int64_t n, int64_t begin, int64_t end, T* to) {
  using R = Lanes<T>;
  for (int64_t row = begin; row < end; ++row) {
    for (int64_t j = 0; j < n; j += kLanes) {
      const int width = static_cast<int>(n - j < kLanes ? n - j : kLanes);
      R sum(T(0));
      for (int i = 0; i < count; ++i) sum = sum - R(q[i * q_stride + row]) * R::load(a + i * a_stride + j, width);
      sum.store(to + row * n + j, width);
    }
  }
}

template <class T>
__attribute__((flatten)) void solve_rows(const T* factor, int64_t n, T* x) {
  for (int64_t i = 0; i < n; ++i) {
    const T* row = factor + i * n;
    x[i] = (x[i] - dot_rows(row, x, i)) / row[i];
  }
  for (int64_t i = n - 1; i >= 0; --i) {
    const T* row = factor + i * n;
    x[i] /= row[i];
    const Lanes<T> own(x[i]);
    int64_t j = 0;
    for (; j + kLanes <= i; j += kLanes) (Lanes<T>::load(x + j) - Lanes<T>::load(row + j) * own).store(x + j);
    for (; j < i; ++j) x[j] -= row[j] * x[i];
  }
}

template <class T>
__attribute__((flatten)) void line_of_tets(const int32_t* corner, const T* rest, const T* material, const T* x,
                                           const T* displacement, int64_t begin, int64_t end, double* coefficients) {
  using R = Lanes<T>;
  R sum[TetLayout::line_degree];
  for (R& s : sum) s = R(T(0));
  for (int64_t block = begin; block < end; ++block) {
    Vec3<R> at[4], p[4];
    for (int a = 0; a < 4; ++a) {
      at[a] = gather3(x, corner + (block * 4 + a) * kLanes);
      p[a] = gather3(displacement, corner + (block * 4 + a) * kLanes);
    }
    R scalars[kRestScalars], m[kMaterialScalars];
    for (int i = 0; i < kRestScalars; ++i) scalars[i] = R::load(rest + (block * kRestScalars + i) * kLanes);
    for (int i = 0; i < kMaterialScalars; ++i) m[i] = R::load(material + (block * kMaterialScalars + i) * kLanes);
    TetLaw::line(at, p, scalars, m, sum);
  }
  for (int i = 0; i < TetLayout::line_degree; ++i) {
    for (int l = 0; l < kLanes; ++l) coefficients[i] += sum[i].v[l];
  }
}

template <class T, int mask>
constexpr CoarseKernels<T> coarse_variant() {
  if constexpr ((mask & kPaperBlock) == 0 && is_compiled(mask)) {
    return {gradient_of_blocks<T, with_optional(mask)>,
            reverse_gradient_of_blocks<T, with_optional(mask)>,
            gather_rows<T>,
            rotate_blocks<T>,
            factor_rows<T>,
            outer_rows<T>,
            solve_rows<T>,
            line_of_tets<T>};
  }
  return {};
}
template <class T, int... n>
CoarseKernels<T> pick_coarse(int index, std::integer_sequence<int, n...>) {
  static constexpr CoarseKernels<T> table[kFreeSets] = {coarse_variant<T, free_mask(n)>()...};
  return table[index];
}

}  // namespace
}  // namespace diffvbd
