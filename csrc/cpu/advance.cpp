#include "advance.h"

#include <torch/csrc/stable/ops.h>

#include <atomic>
#include <vector>

#include "../contact/limit.h"
#include "threads.h"

namespace diffvbd {

using namespace contact;

namespace {

constexpr int64_t kPairGrain = 256;  // pairs that are worth one more thread
constexpr int64_t kRowGrain = 16;    // vertices whose pairs are

constexpr double kClearly = 1 - 1e-5;  // the rounding of the bounds is far below the rest

// The same by upper bounds of the displacements since gaps were taken, bound [B, V].
template <class T>
bool stays_far_by(const AdvanceInputs<T>& in, const T* bound, int64_t pair) {
  const int32_t* record = in.listed.pairs + kPairRow * pair;
  const T* constants = in.constants + kConstants * pair;
  const T slack = PairHints<T>(constants).gap - PairConstants<T>(constants).dhat;
  return most_closed(record, in.vertices, bound + int64_t{record[5]} * in.vertices) < T(kClearly) * slack;
}

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

// fraction of each unit; infeasible [B]: zero at first
template <class T>
void advance(const AdvanceInputs<T>& in, T* fraction, int64_t* infeasible) {
  const int64_t rows = in.scenes * in.vertices, units = in.units();
  const int64_t pairs = in.listed.ptr[in.scenes * in.corners] / 4;
  std::vector<T> now(units);
  std::vector<uint8_t> blocked(units), stamp(units), failed(in.scenes);
  std::vector<uint8_t> far(pairs);  // in all rounds of a move
  AdvanceState<T> s{fraction, now.data(), blocked.data(), stamp.data(), failed.data(), true};
  // Shared by all pairs of a vertex.
  std::vector<Motion<T>> motion(rows);
  std::vector<T> bound(rows);
  s.motion = motion.data();
  const auto vertex = [&](int64_t row) { return static_cast<int32_t>(row % in.vertices); };
  const auto unit = [&](int64_t row) { return in.unit(row / in.vertices, vertex(row)); };
  const auto look = [&] {
    for_each(rows, [&](int64_t i) { motion[i] = motion_of(in, s, i / in.vertices, vertex(i)); }, kPairGrain);
  };
  // How many pairs of the vertices that `goes` names do not pass; each is looked at once.
  const auto failing = [&](const auto& goes, const auto& passes) {
    return count(rows, kRowGrain, [&](int64_t row) {
      if (!goes(row)) return int64_t{0};
      const int64_t scene = row / in.vertices, corner = scene * in.corners + row % in.vertices;
      int64_t found = 0;
      for (int32_t e = in.listed.ptr[corner]; e < in.listed.ptr[corner + 1]; ++e) {
        const int64_t pair = in.listed.entry[e] >> 2;
        const int32_t* record = in.listed.pairs + kPairRow * pair;
        bool looked = far[pair];
        for (int k = 0; k < (in.listed.entry[e] & 3) && !looked; ++k) {
          looked = record[k] < in.vertices && goes(scene * in.vertices + record[k]);
        }
        if (!looked) found += !passes(pair);
      }
      return found;
    });
  };
  for (int move = 0; move < kMoves; ++move) {
    s.first = move == 0;
    std::fill(far.begin(), far.end(), 0);
    std::fill(failed.begin(), failed.end(), 0);
    bool clean = false;  // everything passes as it wants to: only the first round looks at all pairs
    for_each(units, [&](int64_t i) { begin_move(s, i); });
    for (int round = 0; round < kRounds; ++round) {
      const bool begins = round == 0, last = round + 1 == kRounds;
      const auto fails = [&](int64_t scene, bool passes) {
        if (!passes && last) mark(failed.data() + scene);
        return !passes;
      };
      look();
      for (int64_t i = 0; i < rows && begins; ++i) {
        const Motion<T>& m = motion[i];
        const T since = dot(m.since, m.since), end = dot(m.end, m.end);
        bound[i] = square_root(since < end ? end : since) + guard_of_size(m.size);
      }
      const auto passes = [&](int64_t i) {
        far[i] = far[i] || (begins && (stays_far_by(in, bound.data(), i) || stays_far_at_any_fraction(in, s, i)));
        return far[i] || !fails(in.listed.pairs[kPairRow * i + 5], test_pair(in, s, i, last ? 0 : round));
      };
      int64_t found;
      if (last || (s.first && round == 0)) {
        found = count(pairs, kPairGrain, [&](int64_t i) { return !passes(i); });
      } else if (round == 0) {  // what the moves before have taken all the way does not move again
        const auto open = [&](int64_t row) { return !in.pinned[vertex(row)] && fraction[unit(row)] < T(1); };
        found = failing(open, passes);
      } else {
        found = failing([&](int64_t row) { return stamp[unit(row)] == round; }, passes);
      }
      clean = round == 0 && found == 0;
      if (found == 0 || last) break;
      if (count(units, kGrain, [&](int64_t i) { return retreat(s, i, round); }) == 0) break;
    }
    for (int64_t i = 0; i < units; ++i) give_up(in, s, i);
    if (s.first && !clean) {
      look();
      for_each(
          pairs,
          [&](int64_t i) {
            if (far[i] || test_pair(in, s, i, 0)) return;
            __atomic_fetch_add(infeasible + in.listed.pairs[kPairRow * i + 5], 1, __ATOMIC_RELAXED);
          },
          kPairGrain);
    }
    bool open = false;
    for (int64_t i = 0; i < units; ++i) {
      end_move(s, i);
      open = open || fraction[i] < T(1);
    }
    if (!open) break;
  }
}

}  // namespace

template <class T>
void start_substep(const StartStep<T>& s) {
  const auto each = [&](const auto& phase) { for_each(s.items(), [&](int64_t row) { phase(s, row); }, kPairGrain); };
  each(ClearUnit{}), each(LimitStart{}), each(WantStart{});
  advance(s.in.gate, s.m.passed, s.out.infeasible);
  each(EndStart{});
}

template <class T>
std::vector<T> find_gaps(const NearInputs<T>& in, int64_t scenes, T* radius) {
  std::vector<T> gaps(in.count);
  const auto left = [&](int64_t i) {
    radius[i] = in.radius_left(i / in.vertices, static_cast<int32_t>(i % in.vertices));
  };
  for_each(scenes * in.vertices, left, kPairGrain);
  const auto known = [&](int64_t scene, int32_t v) { return v < in.vertices ? radius[scene * in.vertices + v] : T(0); };
  for_each(in.count, [&](int64_t i) { gaps[i] = near_gap(in, i, known); }, kPairGrain);
  return gaps;
}

template <class T>
void copy_near(const NearInputs<T>& in, const std::vector<T>& gaps, const NearList<T>& out) {
  std::vector<int32_t> place(in.count);
  int32_t kept = 0, at = 0;
  for (int64_t i = 0; i < in.count; ++i) {
    place[i] = kept;
    if (is_near(gaps[i])) copy_pair(in, i, gaps[i], kept++, out);
  }
  for (int64_t i = kept; i < out.capacity; ++i) leave_empty(i, out);
  for (int64_t i = 0; i < in.corners; ++i) {
    out.ptr[i] = at;
    for (int32_t e = in.ptr[i]; e < in.ptr[i + 1]; ++e) {
      const int32_t entry = in.entry[e], pair = entry >> 2;
      if (is_near(gaps[pair])) out.entry[at++] = 4 * place[pair] + (entry & 3);
    }
  }
  out.ptr[in.corners] = at;
}

template std::vector<float> find_gaps<float>(const NearInputs<float>&, int64_t, float*);
template std::vector<double> find_gaps<double>(const NearInputs<double>&, int64_t, double*);
template void copy_near<float>(const NearInputs<float>&, const std::vector<float>&, const NearList<float>&);
template void copy_near<double>(const NearInputs<double>&, const std::vector<double>&, const NearList<double>&);
template void start_substep<float>(const StartStep<float>&);
template void start_substep<double>(const StartStep<double>&);

}  // namespace diffvbd
