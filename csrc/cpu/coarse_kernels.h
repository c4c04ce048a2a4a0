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

template <class T, int mask>
__attribute__((flatten)) void reverse_gradient_of_blocks(const Plan& plan, const SceneView<T>& s,
                                                         const StepParameters<T>& q, int64_t begin, int64_t end) {
  using R = Lanes<T>;
  using Set = EnergySet<mask>;
  for (int64_t block = begin; block < end; ++block) {
    const LaneStar<T> star(plan, s, block, fresh_rows(plan, s.rows, block));
    R values[kMaxEnergyData];
    const Block<R> b = load_block<Set>(plan, s, block, q, values);
    const BlockAdjoint<R> out = reverse_gradient<Set, kMaterial | kRest>(
        b, star, load_rows(s.way, block), q, s.data_bar != nullptr, [&](int k, int i, const R& value) {
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

template <class T>
__attribute__((flatten)) void factor_rows(const T* matrix, int64_t n, T* factor) {
  for (int64_t i = 0; i < n; ++i) {
    T* own = factor + i * n;
    for (int64_t j = 0; j < i; ++j) {
      own[j] = (matrix[i * n + j] - dot_rows(own, factor + j * n, j)) / factor[j * n + j];
    }
    own[i] = std::sqrt(matrix[i * n + i] - dot_rows(own, own, i));
    for (int64_t j = i + 1; j < n; ++j) own[j] = T(0);
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
                                           const T* way, int64_t begin, int64_t end, double* coefficients) {
  using R = Lanes<T>;
  R sum[TetLayout::line_degree];
  for (R& s : sum) s = R(T(0));
  for (int64_t block = begin; block < end; ++block) {
    Vec3<R> at[4], p[4];
    for (int a = 0; a < 4; ++a) {
      at[a] = gather3(x, corner + (block * 4 + a) * kLanes);
      p[a] = gather3(way, corner + (block * 4 + a) * kLanes);
    }
    R scalars[kRestScalars], m[kTetScalars];
    for (int i = 0; i < kRestScalars; ++i) scalars[i] = R::load(rest + (block * kRestScalars + i) * kLanes);
    for (int i = 0; i < kTetScalars; ++i) m[i] = R::load(material + (block * kTetScalars + i) * kLanes);
    TetLaw::line(at, p, scalars, m, sum);
  }
  for (int i = 0; i < TetLayout::line_degree; ++i) {
    for (int l = 0; l < kLanes; ++l) coefficients[i] += sum[i].v[l];
  }
}

template <class T, int mask>
constexpr CoarseKernels<T> coarse_variant() {
  if constexpr ((mask & kPaperBlock) == 0 && is_compiled(mask)) {
    return {gradient_of_blocks<T, with_rare(mask)>,
            reverse_gradient_of_blocks<T, with_rare(mask)>,
            gather_rows<T>,
            factor_rows<T>,
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
