// Threads of the CPU backend: loops over items, teams of bodies, and a team that stays together for a step.
#pragma once

#include <torch/csrc/stable/ops.h>

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <limits>
#include <thread>
#include <vector>

#include "../sweep/body.h"

namespace diffvbd {

// Cheap items (tens of nanoseconds each) that a thread must be given: waking it takes as long as a thousand of them.
constexpr int64_t kGrain = 4096;

// Pieces of this many cheap items each that a thread must be given.
constexpr int64_t pieces_per_thread(int64_t items) { return items < kGrain ? kGrain / (items > 0 ? items : 1) : 1; }

// f(i) for all i < n, of which a thread is given at least `grain`; within a parallel region, one thread does it all.
template <class F>
void for_each(int64_t n, const F& f, int64_t grain = kGrain) {
  torch::stable::parallel_for(0, n, grain, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) f(i);
  });
}

// The team of one body on the CPU: its vertices in turn, or those of a large body on several threads.
// Sums go by chunks of a fixed size, so that they have the same bits for any number of threads.
class Threads {
 public:
  explicit Threads(bool many) : many_(many) {}

  bool leads() const { return true; }
  void meet() const {}  // sums and loops have ended for all threads

  template <int n, class F>
  void sum(int32_t count, double* out, const F& f) const {
    std::fill_n(out, n, 0.0);
    if (count <= kChunk) {
      for (int32_t i = 0; i < count; ++i) f(i, out);
      return;
    }
    const int64_t chunks = (count + kChunk - 1) / kChunk;
    std::vector<double> part(chunks * n, 0.0);
    each_chunk(count, [&](int64_t chunk, int32_t i) { f(i, part.data() + chunk * n); });
    for (int64_t chunk = 0; chunk < chunks; ++chunk) {
      for (int k = 0; k < n; ++k) out[k] += part[chunk * n + k];
    }
  }

  // the least f(i), or infinity
  template <class F>
  double least(int32_t count, const F& f) const {
    constexpr double none = std::numeric_limits<double>::infinity();
    std::vector<double> part((count + kChunk - 1) / kChunk, none);
    each_chunk(count, [&](int64_t chunk, int32_t i) { part[chunk] = std::min(part[chunk], f(i)); });
    return part.empty() ? none : *std::min_element(part.begin(), part.end());
  }

  // the largest of each of n numbers >= 0 that f(i, of) gives, or one that is no number
  template <int n, class F>
  void most(int32_t count, double* out, const F& f) const {
    std::vector<double> part((count + kChunk - 1) / kChunk * n, 0.0);
    each_chunk(count, [&](int64_t chunk, int32_t i) {
      double own[n];
      f(i, own);
      for (int k = 0; k < n; ++k) part[chunk * n + k] = larger(part[chunk * n + k], own[k]);
    });
    std::fill_n(out, n, 0.0);
    for (size_t k = 0; k < part.size(); ++k) out[k % n] = larger(out[k % n], part[k]);
  }

  template <class F>
  void each(int32_t count, const F& f) const {
    each_chunk(count, [&](int64_t, int32_t i) { f(i); });
  }

 private:
  static constexpr int32_t kChunk = 1024;

  template <class F>
  void each_chunk(int32_t count, const F& f) const {
    const int64_t chunks = (count + kChunk - 1) / kChunk;
    const auto run = [&](int64_t begin, int64_t end) {
      for (int64_t chunk = begin; chunk < end; ++chunk) {
        const int32_t last = static_cast<int32_t>(std::min<int64_t>(count, (chunk + 1) * kChunk));
        for (auto i = static_cast<int32_t>(chunk * kChunk); i < last; ++i) f(chunk, i);
      }
    };
    if (many_ && chunks > 1) {
      torch::stable::parallel_for(0, chunks, kGrain / kChunk, run);
    } else {
      run(0, chunks);
    }
  }

  bool many_;
};

// Calls f(body, team) for all bodies of all scenes.
template <template <class> class Body = rigid::Body, class In, class F>
void for_bodies(const In& in, const F& f) {
  const int64_t items = in.scenes * in.bodies;
  if (items == 0) return;
  const int64_t vertices = std::max<int64_t>(1, in.ptr[in.bodies] / in.bodies);
  const auto one = [&](int64_t item, bool many) {
    f(Body<typename In::Scalar>{in, item / in.bodies, static_cast<int32_t>(item % in.bodies)}, Threads(many));
  };
  if (items < static_cast<int64_t>(torch::stable::get_num_threads())) {
    for (int64_t i = 0; i < items; ++i) one(i, true);
  } else {
    for_each(items, [&](int64_t i) { one(i, false); }, pieces_per_thread(vertices));
  }
}

// Calls f(scene, vertex) for all of them.
template <class T, class F>
void for_vertices(const rigid::Inputs<T>& in, const F& f) {
  constexpr int64_t kPiece = 1024;
  const int64_t rows = in.scenes * in.vertices, pieces = (rows + kPiece - 1) / kPiece;
  torch::stable::parallel_for(0, pieces, kGrain / kPiece, [&](int64_t begin, int64_t end) {
    for (int64_t row = begin * kPiece; row < std::min(rows, end * kPiece); ++row) {
      f(row / in.vertices, static_cast<int32_t>(row % in.vertices));
    }
  });
}

// Threads that stay together for a whole step: one parallel region instead of one for every color, with a spinning
// barrier between colors. Waking a thread costs tens of microseconds, as much as a color of a thousand vertices.

class Team {
 public:
  explicit Team(int64_t fractions) : shares_(fractions) {}

  // The part of [begin, end) that belongs to shares [first, last) of the work.
  struct Member {
    Team* team;
    int64_t first, last, phase = 0;

    template <class F>
    void each(int64_t begin, int64_t end, const F& f) const {
      const int64_t n = end - begin;
      const int64_t a = begin + n * first / team->shares_, b = begin + n * last / team->shares_;
      if (a < b) f(a, b);
    }
    // The same for f(i) of each item.
    template <class F>
    void each_item(int64_t n, const F& f) const {
      each(0, n, [&](int64_t a, int64_t b) {
        for (int64_t i = a; i < b; ++i) f(i);
      });
    }
    // Returns when all members have arrived.
    void barrier() {
      if (last - first == team->shares_) return;
      team->arrived_.fetch_add(last - first, std::memory_order_acq_rel);
      ++phase;
      for (int spins = 0; team->arrived_.load(std::memory_order_acquire) < phase * team->shares_; ++spins) {
        if (spins > kSpins) std::this_thread::yield();
      }
    }
    // Both, and then a barrier.
    template <class F>
    void each_sync(int64_t begin, int64_t end, const F& f) {
      each(begin, end, f), barrier();
    }
    template <class F>
    void items_sync(int64_t n, const F& f) {
      each_item(n, f), barrier();
    }
  };

  // Calls work(member) on each thread. All threads must be running for a barrier to be safe, and a thread pool promises
  // no such thing: if they have not all come within a moment, the first to give up does the whole work alone.
  template <class F>
  static void run(int64_t threads, const F& work) {
    Team team(threads);
    if (threads <= 1) return work(Member{&team, 0, threads});
    torch::stable::parallel_for(0, threads, 1, [&](int64_t first, int64_t last) {
      if (team.assemble(last - first)) {
        work(Member{&team, first, last});
      } else if (!team.taken_.exchange(true)) {
        work(Member{&team, 0, team.shares_});
      }
    });
  }

 private:
  static constexpr int kSpins = 512;
  static constexpr std::chrono::microseconds kPatience{300};
  enum Decision { kUndecided, kTogether, kAlone };

  // Whether all shares run at the same time; every thread gets the same answer.
  bool assemble(int64_t fractions) {
    if (present_.fetch_add(fractions) + fractions == shares_) {
      int expected = kUndecided;
      decision_.compare_exchange_strong(expected, kTogether);
    }
    const auto deadline = std::chrono::steady_clock::now() + kPatience;
    while (decision_.load() == kUndecided) {
      if (std::chrono::steady_clock::now() > deadline) {
        int expected = kUndecided;
        decision_.compare_exchange_strong(expected, kAlone);
      }
    }
    return decision_.load() == kTogether;
  }

  const int64_t shares_;
  std::atomic<int64_t> present_{0}, arrived_{0};
  std::atomic<int> decision_{kUndecided};
  std::atomic<bool> taken_{false};
};

}  // namespace diffvbd
