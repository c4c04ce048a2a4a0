// Sums whose order is fixed by the data's layout, so that a gradient has the same bits for any number of threads.
#pragma once

#include <cstdint>

namespace diffvbd {

template <class T>
T pairwise_sum(const T* a, int64_t n) {
  if (n <= 64) {
    T sum = T(0);
    for (int64_t i = 0; i < n; ++i) sum += a[i];
    return sum;
  }
  const int64_t half = n / 2;
  return pairwise_sum(a, half) + pairwise_sum(a + half, n - half);
}

// out[i] = rows[index[i]], rows of c scalars
template <class T>
void gather_rows(const T* rows, const int64_t* index, int64_t n, int64_t c, T* out) {
  for (int64_t i = 0; i < n; ++i) {
    for (int64_t k = 0; k < c; ++k) out[i * c + k] = rows[index[i] * c + k];
  }
}

// out[v] = sum of rows[entry[e]] over e in [ptr[v], ptr[v + 1])
template <class T>
void sum_segments(const T* rows, const int64_t* ptr, const int32_t* entry, int64_t segments, int64_t c, T* out) {
  for (int64_t v = 0; v < segments; ++v) {
    for (int64_t k = 0; k < c; ++k) {
      T sum = T(0);
      for (int64_t e = ptr[v]; e < ptr[v + 1]; ++e) sum += rows[static_cast<int64_t>(entry[e]) * c + k];
      out[v * c + k] = sum;
    }
  }
}

}  // namespace diffvbd
