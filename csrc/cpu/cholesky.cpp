#include "cholesky.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "../contact/groups.h"

namespace diffvbd {

void cholesky(int64_t size, double* a) {
  constexpr int kBlock = contact::kUnknowns;
  std::vector<double*> filled;  // rows of blocks below that on the diagonal
  for (double *pivot = a, *end = a + size * size; pivot < end; pivot += kBlock * (size + 1)) {
    for (int j = 0; j < kBlock; ++j) {
      for (int i = j; i < kBlock; ++i) {
        double sum = pivot[size * i + j];
        for (int k = 0; k < j; ++k) sum -= pivot[size * i + k] * pivot[size * j + k];
        pivot[size * i + j] = i == j ? std::sqrt(sum) : sum / pivot[size * j + j];
      }
    }
    filled.clear();
    for (double* block = pivot + kBlock * size; block < end; block += kBlock * size) {
      bool any = false;
      for (int i = 0; i < kBlock; ++i)
        any = any || std::any_of(block + size * i, block + size * i + kBlock, [](double x) { return x != 0; });
      if (any) filled.push_back(block);
    }
    for (double* block : filled) {
      for (int i = 0; i < kBlock; ++i) {
        double* row = block + size * i;
        for (int j = 0; j < kBlock; ++j) {
          double sum = row[j];
          for (int k = 0; k < j; ++k) sum -= row[k] * pivot[size * j + k];
          row[j] = sum / pivot[size * j + j];
        }
      }
    }
    for (size_t r = 0; r < filled.size(); ++r) {
      for (size_t c = 0; c <= r; ++c) {
        double* to = filled[r] + (filled[c] - pivot) / size;  // as far right as that is below
        for (int i = 0; i < kBlock; ++i) {
          for (int j = 0; j < kBlock; ++j) {
            double sum = to[size * i + j];
            for (int k = 0; k < kBlock; ++k) sum -= filled[r][size * i + k] * filled[c][size * j + k];
            to[size * i + j] = sum;
          }
        }
      }
    }
  }
}

void cholesky_solve(int64_t size, const double* a, double* b) {
  for (int64_t i = 0; i < size; ++i) {
    for (int64_t k = 0; k < i; ++k) b[i] -= a[size * i + k] * b[k];
    b[i] /= a[size * i + i];
  }
  for (int64_t i = size - 1; i >= 0; --i) {
    b[i] /= a[size * i + i];
    for (int64_t k = 0; k < i; ++k) b[k] -= a[size * i + k] * b[i];
  }
}

}  // namespace diffvbd
