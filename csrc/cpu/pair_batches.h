// Pairs gathered into packs of one kind for the kernels of pair_kernels.h, and their results in the order in which the
// pairs came, so that sums do not depend on what shared a pack.
#pragma once

#include "pair_kernels.h"

namespace diffvbd {

// deliver(mark, result) is called for each pair that is active; `mark` says what the caller wants to know of it.
template <class T, class Mark, int given_rows, int out_rows, class Deliver>
class PairBatches {
 public:
  PairBatches(PairKernel<T> kernel, T kappa, T h2, const Deliver& deliver)
      : kernel_(kernel), kappa_(kappa), h2_(h2), deliver_(deliver) {}

  // Column of `given` for one more pair, to be filled before the next call: its rows are kLanes apart.
  T* add(int kind, const Mark& mark) {
    if (size_ == kMost) flush();
    Pack& pack = packs_[kind];
    if (pack.count == kLanes) run(kind);
    marks_[size_] = mark;
    pack.item[pack.count] = size_++;
    return pack.given + pack.count++;
  }
  void flush() {
    for (int kind = 0; kind < kKinds; ++kind) run(kind);
    for (int i = 0; i < size_; ++i) {
      if (results_[i][0] != T(0)) deliver_(marks_[i], results_[i] + 1);
    }
    size_ = 0;
  }

 private:
  static constexpr int kKinds = 3, kMost = 16 * kLanes;
  struct Pack {
    alignas(64) T given[given_rows * kLanes];
    int item[kLanes];
    int count = 0;
  };

  void run(int kind) {
    Pack& pack = packs_[kind];
    if (pack.count == 0) return;
    for (int row = 0; row < given_rows; ++row) {
      T* lanes = pack.given + row * kLanes;
      for (int l = pack.count; l < kLanes; ++l) lanes[l] = lanes[0];
    }
    alignas(64) T out[out_rows * kLanes];
    kernel_(kind, pack.given, kappa_, h2_, out);
    for (int l = 0; l < pack.count; ++l) {
      T* result = results_[pack.item[l]];
      result[0] = out[l];
      if (out[l] == T(0)) continue;
      for (int i = 1; i < out_rows; ++i) result[i] = out[i * kLanes + l];
    }
    pack.count = 0;
  }

  const PairKernel<T> kernel_;
  const T kappa_, h2_;
  const Deliver& deliver_;
  Pack packs_[kKinds];
  Mark marks_[kMost];
  T results_[kMost][out_rows];
  int size_ = 0;
};

}  // namespace diffvbd
