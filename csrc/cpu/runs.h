// A Run of subspace/contact_coarse.h and subspace/rigid_step.h on the CPU.
#pragma once

#include "../subspace/rigid_step.h"
#include "threads.h"

namespace diffvbd {

struct Loops {
  using Team = Threads;
  struct Lane {
    bool leads() const { return true; }
    void meet() const {}
    template <class F>
    void each(int64_t count, const F& f) const {
      for (int64_t i = 0; i < count; ++i) f(i);
    }
  };
  static constexpr int64_t kItems = 64, kTeams = 4;  // that a thread must be given

  template <class F>
  void each(int64_t n, const F& f) const {
    for_each(n, f, kItems);
  }
  template <class F>
  void lanes(int64_t n, const F& f) const {
    for_each(n, [&](int64_t i) { f(i, Lane()); }, kTeams);
  }
  template <class F>
  void teams(int64_t n, const F& f) const {
    for_each(n, [&](int64_t i) { f(i, Threads(false)); }, kTeams);
  }

  template <class Phase, class Step>
  void each(const Phase& phase, const Step& s, int64_t n) const {
    for_each(s.inputs().scene.scenes * n, [&](int64_t i) { phase(s, i / n, i % n); }, kItems);
  }
  template <class Phase, class Step>
  void rows(const Phase& phase, const Step& s) const {
    for_each(s.listed() + s.lagged(), [&](int64_t row) { phase(s, row); }, kItems);
  }
  template <class Phase, class Step>
  void parts(const Phase& phase, const Step& s, int count) const {
    const auto all = [&](int64_t row) {
      for (int part = 0; part < count; ++part) phase(s, row, part);
    };
    for_each(s.listed(), all, kItems);
  }
  template <class Phase, class Step>
  void bodies(const Phase& phase, const Step& s) const {
    for_bodies(s.inputs().scene, [&](const auto& body, const Threads& team) { phase(s, body, team); });
  }
  template <class Phase, class Step>
  void groups(const Phase& phase, const Step& s) const {
    const int64_t n = s.inputs().bodies();
    const auto one = [&](int64_t i) { phase(s, i / n, static_cast<int32_t>(i % n), Threads(false)); };
    for_each(s.inputs().scene.scenes * n, one, kTeams);
  }
  template <class Phase, class Step>
  void points(const Phase& phase, const Step& s) const {
    const int64_t count = s.inputs().scene.scenes * s.inputs().gate.corners;
    for_each(count, [&](int64_t point) { phase(s, point, Threads(false)); }, kItems);
  }

  bool all(const uint8_t* flags, int64_t n) const {
    return std::all_of(flags, flags + n, [](uint8_t a) { return a != 0; });
  }
  bool none(const uint8_t* flags, int64_t n) const {
    return std::none_of(flags, flags + n, [](uint8_t a) { return a != 0; });
  }
  // Labels may change while they are read; every value read is an item of the same set.
  static int32_t root_of(const int32_t* label, int32_t i) {
    for (;;) {
      const int32_t parent = __atomic_load_n(label + i, __ATOMIC_RELAXED);
      if (parent == i) return i;
      i = parent;
    }
  }
  // Makes the larger of two roots a child of the smaller.
  static void unite(int32_t* label, int32_t a, int32_t b) {
    for (;;) {
      a = root_of(label, a), b = root_of(label, b);
      if (a == b) return;
      int32_t high = std::max(a, b);
      if (__atomic_compare_exchange_n(label + high, &high, std::min(a, b), false, __ATOMIC_RELAXED, __ATOMIC_RELAXED))
        return;
    }
  }
  static void set_bit(uint64_t* bits, int32_t k) { __atomic_fetch_or(bits, uint64_t{1} << k, __ATOMIC_RELAXED); }
};

}  // namespace diffvbd
