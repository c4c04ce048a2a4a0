// Entries of pairs gathered into packs of one kind for the kernels of pair_kernels.h, and their results in the order in
// which the entries came, so that sums do not depend on what shared a pack.
#pragma once

#include "pair_kernels.h"
#include "pair_sites.h"

namespace diffvbd {

// deliver(mark, active, result) is called for each entry; `mark` says what the caller wants to know of it. The result
// of a pair that is not active has a Clearance alone.
template <class T, class Mark, class Deliver>
class PairBatches {
 public:
  PairBatches(PairKernel<T> kernel, const PairRows<T>& rows, T kappa, T h2, const Deliver& deliver)
      : kernel_(kernel), rows_(rows), kappa_(kappa), h2_(h2), deliver_(deliver) {}

  // turn: in the reverse p and d_raw of the corner
  void add(const PairSite& site, const T* constants, const T* turn, const Mark& mark) {
    if (size_ == kMost) flush();
    Waiting& waiting = waiting_[site.kind];
    if (waiting.count == kLanes) run(site.kind);
    marks_[size_] = mark;
    const int lane = waiting.count++;
    waiting.item[lane] = size_++;
    PairPack<T>& pack = waiting.pack;
    for (int k = 0; k < 4; ++k) {
      pack.x[k][lane] = rows_.x(site.at[k]);
      pack.origin[k][lane] = rows_.origin(site.at[k]);
    }
    pack.constants[lane] = constants;
    pack.own[lane] = static_cast<T>(site.own);
    pack.together[lane] = static_cast<T>(site.together);
    pack.turn[lane] = turn;
  }
  void flush() {
    for (int kind = 0; kind < kKinds; ++kind) run(kind);
    for (int i = 0; i < size_; ++i) deliver_(marks_[i], results_[i][kPairActive] != T(0), results_[i]);
    size_ = 0;
  }

 private:
  static constexpr int kKinds = 3, kMost = 16 * kLanes;
  struct Waiting {
    PairPack<T> pack;
    int item[kLanes];
    int count = 0;
  };

  void run(int kind) {
    Waiting& waiting = waiting_[kind];
    if (waiting.count == 0) return;
    PairPack<T>& pack = waiting.pack;
    T* out[kLanes];
    for (int l = 0; l < kLanes; ++l) {
      out[l] = l < waiting.count ? results_[waiting.item[l]] : unused_;
      if (l < waiting.count) continue;
      for (int k = 0; k < 4; ++k) pack.x[k][l] = pack.x[k][0], pack.origin[k][l] = pack.origin[k][0];
      pack.constants[l] = pack.constants[0];
      pack.own[l] = pack.own[0];
      pack.together[l] = pack.together[0];
      pack.turn[l] = pack.turn[0];
    }
    kernel_(kind, pack, kappa_, h2_, out);
    waiting.count = 0;
  }

  const PairKernel<T> kernel_;
  const PairRows<T>& rows_;
  const T kappa_, h2_;
  const Deliver& deliver_;
  Waiting waiting_[kKinds];
  Mark marks_[kMost];
  T results_[kMost][kPairResult], unused_[kPairResult];
  int size_ = 0;
};

}  // namespace diffvbd
