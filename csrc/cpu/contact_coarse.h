// The coarse correction of bodies that touch (subspace/contact_coarse.h), on the CPU.
#pragma once

#include "../subspace/contact_coarse.h"
#include "threads.h"

namespace diffvbd {

// A Run of subspace/contact_coarse.h.
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

  template <class F>
  void each(int64_t n, const F& f) const {
    for_each(n, f, 64);
  }
  template <class F>
  void lanes(int64_t n, const F& f) const {
    for_each(n, [&](int64_t i) { f(i, Lane()); }, 4);
  }
  template <class F>
  void teams(int64_t n, const F& f) const {
    for_each(n, [&](int64_t i) { f(i, Threads(false)); }, 4);
  }
  bool is_done(const uint8_t* decided, int64_t n) const {
    return std::all_of(decided, decided + n, [](uint8_t a) { return a != 0; });
  }
  static int32_t root_of(const int32_t* lead, int32_t i) {
    while (lead[i] != i) i = lead[i];
    return i;
  }
  static void unite(int32_t* lead, int32_t a, int32_t b) {
    a = root_of(lead, a), b = root_of(lead, b);
    lead[std::max(a, b)] = std::min(a, b);
  }
};

template <class T, class... Args>
void contact_coarse_system(const Args&... args) {
  contact::coarse_system<T>(Loops(), args...);
}
template <class T, class... Args>
void contact_coarse_move(const Args&... args) {
  contact::coarse_move<T>(Loops(), args...);
}
template <class T, class... Args>
void contact_coarse_restrict(const Args&... args) {
  contact::coarse_restrict<T>(Loops(), args...);
}
template <class T, class... Args>
void contact_coarse_motions(const Args&... args) {
  contact::coarse_motions<T>(Loops(), args...);
}
template <class T, class... Args>
void contact_coarse_reverse(const Args&... args) {
  contact::coarse_reverse<T>(Loops(), args...);
}

}  // namespace diffvbd
