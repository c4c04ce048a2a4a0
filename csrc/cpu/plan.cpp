#include "plan.h"

#include <algorithm>

namespace diffvbd {

Stars build_stars(const int64_t* tets, int64_t num_tets, int64_t num_vertices) {
  Stars out;
  out.ptr.assign(num_vertices + 1, 0);
  for (int64_t i = 0; i < 4 * num_tets; ++i) ++out.ptr[tets[i] + 1];
  for (int64_t v = 0; v < num_vertices; ++v) out.ptr[v + 1] += out.ptr[v];
  out.entry.resize(4 * num_tets);
  std::vector<int64_t> at(out.ptr.begin(), out.ptr.end() - 1);
  for (int64_t i = 0; i < 4 * num_tets; ++i) out.entry[at[tets[i]]++] = static_cast<int32_t>(i);
  return out;
}

Adjacency build_adjacency(const int64_t* tets, const Stars& stars) {
  const int64_t n = static_cast<int64_t>(stars.ptr.size()) - 1;
  Adjacency out{std::vector<int32_t>(3 * stars.entry.size()), std::vector<int32_t>(n, 0)};
  for (int64_t v = 0; v < n; ++v) {
    int32_t* const begin = out.neighbor.data() + 3 * stars.ptr[v];
    int32_t* end = begin;
    for (int64_t e = stars.ptr[v]; e < stars.ptr[v + 1]; ++e) {
      const int64_t* tet = tets + (stars.entry[e] & ~3);
      for (int a = 0; a < 4; ++a) {
        if (tet[a] != v) *end++ = static_cast<int32_t>(tet[a]);
      }
    }
    std::sort(begin, end);
    out.degree[v] = static_cast<int32_t>(std::unique(begin, end) - begin);
  }
  return out;
}

// One stack of vertices per saturation (number of colors among the neighbours). A vertex is pushed again whenever its
// saturation grows; entries that were overtaken are skipped, so the whole takes O(V + E). Of equal saturation the
// latest comes first: the coloring advances as a front, which finds the 4 colors of regular grids.
std::vector<int32_t> color_vertices(const Stars& stars, const Adjacency& graph, const uint8_t* active, int* colors) {
  const int64_t n = static_cast<int64_t>(graph.degree.size());
  const int32_t largest = n == 0 ? 0 : *std::max_element(graph.degree.begin(), graph.degree.end());
  const int64_t words = largest / 64 + 1;  // a vertex never needs more than its degree + 1 colors
  std::vector<uint64_t> seen(n * words, 0);
  std::vector<int32_t> color(n, -1), saturation(n, 0);
  std::vector<std::vector<int32_t>> stacks(largest + 2);
  int32_t top = 0;
  *colors = 0;
  for (int64_t start = 0; start < n; ++start) {
    if (!active[start] || color[start] >= 0) continue;
    stacks[0].push_back(static_cast<int32_t>(start));
    for (;;) {
      while (top > 0 && stacks[top].empty()) --top;
      if (stacks[top].empty()) break;
      const int32_t v = stacks[top].back();
      stacks[top].pop_back();
      if (color[v] >= 0 || saturation[v] != top) continue;
      int32_t c = 0;
      while (seen[v * words + c / 64] >> (c % 64) & 1) ++c;
      color[v] = c;
      *colors = std::max(*colors, c + 1);
      const int32_t* neighbor = graph.neighbor.data() + 3 * stars.ptr[v];
      for (int32_t e = 0; e < graph.degree[v]; ++e) {
        const int32_t u = neighbor[e];
        uint64_t& word = seen[u * words + c / 64];
        const uint64_t bit = uint64_t{1} << (c % 64);
        if (!active[u] || color[u] >= 0 || (word & bit) != 0) continue;
        word |= bit;
        top = std::max(top, ++saturation[u]);
        stacks[saturation[u]].push_back(u);
      }
    }
  }
  return color;
}

}  // namespace diffvbd
