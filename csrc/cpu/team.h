// Threads that stay together for a whole step: one parallel region instead of one for every color, with a spinning
// barrier between colors. Waking a thread costs tens of microseconds, as much as a color of a thousand vertices.
#pragma once

#include <torch/csrc/stable/ops.h>

#include <atomic>
#include <chrono>
#include <cstdint>
#include <thread>

namespace diffvbd {

class Team {
 public:
  explicit Team(int64_t shares) : shares_(shares) {}

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
    // Returns when all members have arrived.
    void barrier() {
      if (last - first == team->shares_) return;
      team->arrived_.fetch_add(last - first, std::memory_order_acq_rel);
      ++phase;
      for (int spins = 0; team->arrived_.load(std::memory_order_acquire) < phase * team->shares_; ++spins) {
        if (spins > kSpins) std::this_thread::yield();
      }
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
  bool assemble(int64_t shares) {
    if (present_.fetch_add(shares) + shares == shares_) {
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
