#include "advance.h"

#include <torch/csrc/stable/ops.h>

#include <atomic>
#include <vector>

#include "grain.h"

namespace diffvbd {

using namespace contact;

namespace {

constexpr int64_t kPairGrain = 256;  // pairs that are worth one more thread

// How many of n items f says yes to.
template <class F>
int64_t count(int64_t n, int64_t grain, const F& f) {
  std::atomic<int64_t> total{0};
  torch::stable::parallel_for(0, n, grain, [&](int64_t begin, int64_t end) {
    int64_t own = 0;
    for (int64_t i = begin; i < end; ++i) own += f(i);
    total += own;
  });
  return total;
}

}  // namespace

template <class T>
int64_t advance(const AdvanceInputs<T>& in, T* share, T* frame) {
  const int64_t rows = in.scenes * in.vertices, pairs = in.listed.ptr[in.scenes * in.corners] / 4;
  const int64_t bodies = in.scenes * in.bodies;
  std::vector<T> now(rows), frame_now(bodies);
  std::vector<uint8_t> blocked(rows), stamp(rows), unfit(bodies), failed(in.scenes);
  AdvanceState<T> s{share,        now.data(),    frame, frame_now.data(), unfit.data(), blocked.data(),
                    stamp.data(), failed.data(), true};
  const auto scene_of = [&](int64_t pair) { return in.listed.pairs[kPairRow * pair + 5]; };
  int64_t stuck = 0;
  for (int move = 0; move < kMoves; ++move) {
    s.first = move == 0;
    std::fill(failed.begin(), failed.end(), 0);
    for (int64_t i = 0; i < bodies; ++i) begin_body(s, i);
    bool open = count(rows, kGrain, [&](int64_t i) { return begin_move(in, s, i); }) > 0;
    for (int round = 0; round < kRounds; ++round) {
      const bool last = round + 1 == kRounds;
      const auto fails = [&](int64_t pair) {
        const bool passes = try_pair(in, s, pair, last ? 0 : round);
        if (!passes && last) mark(failed.data() + scene_of(pair));
        return !passes;
      };
      const bool blocks = count(pairs, kPairGrain, fails) > 0;
      if (last || (!blocks && !open)) break;
      open = count(rows, kGrain, [&](int64_t i) { return retreat(in, s, i, round); }) > 0;
      for (int64_t i = 0; i < bodies; ++i) open = slow_down(s, i, round) || open;
      if (!open) break;
    }
    count(rows, kGrain, [&](int64_t i) {
      if (!in.held[i % in.vertices] && !fits(in, s, i, s.now[i])) mark(failed.data() + i / in.vertices);
      return 0;
    });
    count(rows, kGrain, [&](int64_t i) { return give_up(in, s, i), 0; });
    if (s.first) stuck = count(pairs, kPairGrain, [&](int64_t pair) { return !try_pair(in, s, pair, 0); });
    count(rows, kGrain, [&](int64_t i) { return end_move(s, i), 0; });
    for (int64_t i = 0; i < bodies; ++i) end_body(in, s, i);
    if (count(rows, kGrain, [&](int64_t i) { return !in.held[i % in.vertices] && share[i] < T(1); }) == 0) break;
  }
  return stuck;
}

template <class T>
void narrow(const NarrowInputs<T>& in, int64_t pairs, T* constants) {
  torch::stable::parallel_for(0, pairs, kPairGrain, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) narrow_pair(in, i, constants + kConstants * i);
  });
}

template void narrow<float>(const NarrowInputs<float>&, int64_t, float*);
template void narrow<double>(const NarrowInputs<double>&, int64_t, double*);
template int64_t advance<float>(const AdvanceInputs<float>&, float*, float*);
template int64_t advance<double>(const AdvanceInputs<double>&, double*, double*);

}  // namespace diffvbd
