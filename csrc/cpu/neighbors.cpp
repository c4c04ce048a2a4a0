#include "neighbors.h"

#include <torch/csrc/stable/ops.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <vector>

#include "../core/hash_grid.h"

namespace diffvbd {
namespace {

constexpr int64_t kChunk = 2048;  // points that a thread takes at a time

template <class F>
void for_chunks(int64_t n, int64_t chunk, const F& f) {
  torch::stable::parallel_for(0, (n + chunk - 1) / chunk, 1, [&](int64_t first, int64_t last) {
    for (int64_t c = first; c < last; ++c) f(c, c * chunk, std::min(n, (c + 1) * chunk));
  });
}

// The points sorted by bucket, those of a bucket by row.
template <class T>
struct SortedPoints {
  HashGrid grid;
  std::vector<uint32_t> bucket;  // of each row
  std::vector<int32_t> start;    // of each bucket
  std::vector<GridPoint<T>> point;
  std::atomic<bool> finite{true};

  SortedPoints(const T* points, int64_t scenes, int64_t n, double radius)
      : grid(radius, scenes * n), bucket(scenes * n), start(grid.buckets() + 1), point(scenes * n) {
    const int64_t rows = scenes * n;
    for_chunks(rows, kChunk, [&](int64_t, int64_t begin, int64_t end) {
      bool good = true;
      for (int64_t row = begin; row < end; ++row) {
        const T* p = points + 3 * row;
        good = good && std::isfinite(p[0]) && std::isfinite(p[1]) && std::isfinite(p[2]);
        bucket[row] = grid.bucket(p, static_cast<uint32_t>(row / n));
      }
      if (!good) finite = false;
    });
    for (const uint32_t b : bucket) ++start[b + 1];
    for (uint32_t b = 0; b < grid.buckets(); ++b) start[b + 1] += start[b];
    std::vector<int32_t> next(start.begin(), start.end() - 1);
    for (int64_t row = 0; row < rows; ++row) {
      const T* p = points + 3 * row;
      point[next[bucket[row]]++] = {p[0], p[1], p[2], static_cast<int32_t>(row)};
    }
  }
};

}  // namespace

template <class T>
int64_t neighbor_pairs(const T* points, int64_t scenes, int64_t n, double radius, int32_t* pairs, int64_t max_pairs) {
  const int64_t rows = scenes * n, chunks = (rows + kChunk - 1) / kChunk;
  const SortedPoints<T> sorted(points, scenes, n, radius);
  const T squared = static_cast<T>(radius) * static_cast<T>(radius);
  std::vector<int64_t> first(rows + 1);             // of the pairs of each row; until they are summed, their number
  std::vector<std::vector<int32_t>> found(chunks);  // second rows of the pairs, in the order in which they are found
  std::atomic<int64_t> total{0};
  if (sorted.finite) {
    for_chunks(rows, kChunk, [&](int64_t chunk, int64_t begin, int64_t end) {
      std::vector<int32_t>& mine = found[chunk];
      for (int64_t at = begin; at < end; ++at) {
        const GridPoint<T> p = sorted.point[at];
        const int64_t scene_end = (p.row / n + 1) * n, before = static_cast<int64_t>(mine.size());
        int64_t count = 0;
        sorted.grid.each_range(sorted.bucket[p.row], sorted.start.data(), [&](int32_t from, int32_t to) {
          for (int32_t q = from; q < to; ++q) {
            const GridPoint<T>& other = sorted.point[q];
            if (other.row <= p.row || other.row >= scene_end || !within(p, other, squared)) continue;
            if (count++ <= max_pairs) mine.push_back(other.row);
          }
        });
        first[p.row + 1] = count;
        std::sort(mine.begin() + before, mine.end());
        if ((total += count) > max_pairs) mine.resize(before);  // too many to be given: only their number matters
      }
    });
  }
  const bool given = sorted.finite && total <= max_pairs;
  if (given) {
    for (int64_t row = 0; row < rows; ++row) first[row + 1] += first[row];
    for_chunks(rows, kChunk, [&](int64_t chunk, int64_t begin, int64_t end) {
      const int32_t* second = found[chunk].data();
      for (int64_t at = begin; at < end; ++at) {
        const int32_t row = sorted.point[at].row, scene = static_cast<int32_t>(row / n);
        const auto base = static_cast<int32_t>(scene * n);
        for (int64_t k = first[row]; k < first[row + 1]; ++k) {
          pairs[3 * k] = scene, pairs[3 * k + 1] = row - base, pairs[3 * k + 2] = *second++ - base;
        }
      }
    });
  }
  int32_t* unused = pairs + (given ? 3 * total : 0);
  for_chunks(pairs + 3 * max_pairs - unused, int64_t{1} << 18,
             [&](int64_t, int64_t begin, int64_t end) { std::fill(unused + begin, unused + end, -1); });
  return sorted.finite ? total.load() : -1;
}

template int64_t neighbor_pairs<float>(const float*, int64_t, int64_t, double, int32_t*, int64_t);
template int64_t neighbor_pairs<double>(const double*, int64_t, int64_t, double, int32_t*, int64_t);

}  // namespace diffvbd
