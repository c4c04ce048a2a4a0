#include "contact_coarse.h"

#include "threads.h"

namespace diffvbd {

using namespace contact;

namespace {

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

}  // namespace

template <class T>
void contact_coarse_system(const CoarseInputs<T>& c, const Batched<const T>& packed, const SystemMemory& memory,
                           double* r, double* matrix) {
  coarse_system(Loops(), c, packed, memory, r, matrix);
}
template <class T>
void contact_coarse_move(const CoarseInputs<T>& c, const double* a, const double* r, const int32_t* info,
                         const TrialMemory<T>& memory, T* x) {
  coarse_move(Loops(), c, a, r, info, memory, x);
}
template <class T>
void contact_coarse_restrict(const CoarseInputs<T>& c, const T* x_bar, const double* fraction, double* to) {
  coarse_restrict(Loops(), c, x_bar, fraction, to);
}
template <class T>
void contact_coarse_motions(const CoarseInputs<T>& c, const double* a, const double* l, const double* fraction, T* p,
                            T* q) {
  coarse_motions(Loops(), c, a, l, fraction, p, q);
}
template <class T>
void contact_coarse_reverse(const CoarseInputs<T>& c, const double* a, const double* l, const double* fraction,
                            const T* x_bar, const VirtualMotions<T>& given, const PointWork<T>& scattered,
                            const CoarseAdjoints<T>& out) {
  coarse_reverse(Loops(), c, a, l, fraction, x_bar, given, scattered, out);
}

#define DIFFVBD_INSTANTIATE(T)                                                                                     \
  template void contact_coarse_system<T>(const CoarseInputs<T>&, const Batched<const T>&, const SystemMemory&,     \
                                         double*, double*);                                                        \
  template void contact_coarse_move<T>(const CoarseInputs<T>&, const double*, const double*, const int32_t*,       \
                                       const TrialMemory<T>&, T*);                                                 \
  template void contact_coarse_restrict<T>(const CoarseInputs<T>&, const T*, const double*, double*);              \
  template void contact_coarse_motions<T>(const CoarseInputs<T>&, const double*, const double*, const double*, T*, \
                                          T*);                                                                     \
  template void contact_coarse_reverse<T>(const CoarseInputs<T>&, const double*, const double*, const double*,     \
                                          const T*, const VirtualMotions<T>&, const PointWork<T>&,                 \
                                          const CoarseAdjoints<T>&);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)

}  // namespace diffvbd
