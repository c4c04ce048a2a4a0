// Bodies side by side, or the vertices of a large one: the loops and sums of csrc/rigid and csrc/start on the CPU.
#pragma once

#include <torch/csrc/stable/ops.h>

#include <algorithm>
#include <cstdint>
#include <limits>
#include <vector>

#include "../rigid/body.h"
#include "grain.h"

namespace diffvbd {

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
    torch::stable::parallel_for(0, items, pieces_per_thread(vertices), [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) one(i, false);
    });
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

}  // namespace diffvbd
