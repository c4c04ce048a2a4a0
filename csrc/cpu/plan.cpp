#include "plan.h"

#include <algorithm>
#include <array>
#include <limits>
#include <stdexcept>

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

namespace {

uint64_t spread_bits(uint64_t a) {
  a &= 0x1fffff;
  a = (a | a << 32) & 0x1f00000000ffffull;
  a = (a | a << 16) & 0x1f0000ff0000ffull;
  a = (a | a << 8) & 0x100f00f00f00f00full;
  a = (a | a << 4) & 0x10c30c30c30c30c3ull;
  return (a | a << 2) & 0x1249249249249249ull;
}

std::vector<int32_t> morton_order(const double* points, int64_t n) {
  std::array<double, 3> low, scale;
  for (int c = 0; c < 3; ++c) {
    double a = std::numeric_limits<double>::infinity(), b = -a;
    for (int64_t v = 0; v < n; ++v) a = std::min(a, points[3 * v + c]), b = std::max(b, points[3 * v + c]);
    low[c] = a;
    scale[c] = b > a ? 2097151.0 / (b - a) : 0.0;
  }
  std::vector<std::pair<uint64_t, int32_t>> keys(n);
  for (int64_t v = 0; v < n; ++v) {
    uint64_t key = 0;
    for (int c = 0; c < 3; ++c) {
      key |= spread_bits(static_cast<uint64_t>((points[3 * v + c] - low[c]) * scale[c])) << c;
    }
    keys[v] = {key, static_cast<int32_t>(v)};
  }
  std::sort(keys.begin(), keys.end());
  std::vector<int32_t> out(n);
  for (int64_t i = 0; i < n; ++i) out[i] = keys[i].second;
  return out;
}

}  // namespace

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

std::vector<int32_t> build_plan(const double* points, const int64_t* tets, int64_t num_tets, const Stars& stars,
                                const Adjacency& graph, const std::vector<int32_t>& color, int colors) {
  const int64_t n = static_cast<int64_t>(color.size());
  const auto neighbors_of = [&](int32_t v) { return graph.neighbor.data() + 3 * stars.ptr[v]; };
  std::vector<int32_t> active_degree(n, 0);
  for (int64_t v = 0; v < n; ++v) {
    for (int32_t e = 0; e < graph.degree[v]; ++e) active_degree[v] += color[neighbors_of(v)[e]] >= 0;
  }
  const auto valence = [&](int32_t v) { return static_cast<int32_t>(stars.ptr[v + 1] - stars.ptr[v]); };
  // Morton order keeps the neighbours of a block near each other in memory; inside a window, sorting by valence lets
  // the lanes of a block have stars of like length.
  constexpr int64_t kWindow = 64 * kLanes;
  std::vector<std::vector<int32_t>> members(colors + 1);
  for (const int32_t v : morton_order(points, n)) members[color[v] < 0 ? colors : color[v]].push_back(v);
  int64_t blocks = 0, slots = 0, active = 0, edge_slots = 0, incoming_slots = 0;
  for (int c = 0; c <= colors; ++c) {
    auto& list = members[c];
    const int64_t size = static_cast<int64_t>(list.size());
    for (int64_t a = 0; a < size; a += kWindow) {
      std::stable_sort(list.begin() + a, list.begin() + std::min(size, a + kWindow),
                       [&](int32_t u, int32_t w) { return valence(u) > valence(w); });
    }
    blocks += (size + kLanes - 1) / kLanes;
    for (int64_t a = 0; a < size; a += kLanes) {
      int32_t most = 0, edges = 0, incoming = 0;
      for (int64_t l = a; l < std::min(size, a + kLanes); ++l) {
        most = std::max(most, valence(list[l]));
        incoming = std::max(incoming, active_degree[list[l]]);
        if (c < colors) edges = std::max(edges, graph.degree[list[l]]);
      }
      slots += most;
      edge_slots += edges;
      incoming_slots += incoming;
    }
    if (c < colors) active += size;
  }
  if (std::max(slots, (edge_slots + 1) * kRow) * kLanes > std::numeric_limits<int32_t>::max()) {
    throw std::invalid_argument("mesh: too large, expected at most 2^31 (vertex, tet) pairs");
  }
  const std::array<int64_t, 10> sizes = {
      colors + 1,      blocks + 1,     blocks + 1,         blocks + 1,         blocks + 1,
      blocks * kLanes, slots * kLanes, slots * 3 * kLanes, slots * 3 * kLanes, incoming_slots * kLanes};
  int64_t total = kPlanHeader;
  for (const int64_t s : sizes) total += s;
  std::vector<int32_t> out(total);
  const int64_t header[8] = {n, num_tets, active, colors, blocks, slots, edge_slots, incoming_slots};
  std::copy(header, header + 8, out.begin());
  const Plan plan = view_plan(out.data());
  const auto writable = [](const int32_t* p) { return const_cast<int32_t*>(p); };

  std::vector<int32_t> position(n);
  int32_t block = 0, slot = 0, rank = 0, edge = 0, incoming = 0;
  for (int c = 0; c <= colors; ++c) {
    writable(plan.color_block)[c] = block;
    const auto& list = members[c];
    const int64_t size = static_cast<int64_t>(list.size());
    for (int64_t a = 0; a < size; a += kLanes, ++block) {
      writable(plan.block_slot)[block] = slot;
      writable(plan.block_rank)[block] = rank;
      writable(plan.block_edge)[block] = edge;
      writable(plan.block_incoming)[block] = incoming;
      int32_t most = 0, edges = 0, arriving = 0;
      for (int l = 0; l < kLanes; ++l) {
        const int32_t v = a + l < size ? list[a + l] : -1;
        writable(plan.order)[block * kLanes + l] = v;
        if (v < 0) continue;
        ++rank;
        position[v] = block * kLanes + l;
        most = std::max(most, valence(v));
        arriving = std::max(arriving, active_degree[v]);
        if (c < colors) edges = std::max(edges, graph.degree[v]);
      }
      slot += most;
      edge += edges;
      incoming += arriving;
    }
  }
  writable(plan.block_slot)[blocks] = slot;
  writable(plan.block_rank)[blocks] = rank;
  writable(plan.block_edge)[blocks] = edge;
  writable(plan.block_incoming)[blocks] = incoming;

  // which of v's edges leads to u
  const auto edge_to = [&](int32_t v, int32_t u) {
    const int32_t* first = neighbors_of(v);
    return static_cast<int32_t>(std::lower_bound(first, first + graph.degree[v], u) - first);
  };
  for (int32_t b = 0; b < blocks; ++b) {
    for (int l = 0; l < kLanes; ++l) {
      const int32_t v = plan.order[b * kLanes + l], size = v < 0 ? 0 : valence(v);
      for (int32_t s = plan.block_slot[b], e = 0; s < plan.block_slot[b + 1]; ++s, ++e) {
        const bool real = e < size;
        const int32_t entry = real ? stars.entry[stars.ptr[v] + e] : 0;
        writable(plan.pair)[s * static_cast<int64_t>(kLanes) + l] = entry;
        for (int a = 0; a < 3; ++a) {
          const int64_t at = (s * int64_t{3} + a) * kLanes + l;
          const int32_t other = static_cast<int32_t>(tets[(entry & ~3) + kOthers[entry & 3][a]]);
          writable(plan.neighbors)[at] = kRow * (real ? position[other] : b * kLanes + l);
          writable(plan.edge)[at] = kRow * ((real ? edge_to(v, other) : 0) * kLanes + l);
        }
      }
      int64_t at = int64_t{plan.block_incoming[b]} * kLanes + l;
      for (int32_t e = 0; v >= 0 && e < graph.degree[v]; ++e) {
        const int32_t u = neighbors_of(v)[e];
        if (color[u] < 0) continue;
        const int32_t row = plan.block_edge[position[u] / kLanes] + edge_to(u, v);
        writable(plan.incoming)[at] = kRow * (row * kLanes + position[u] % kLanes);
        at += kLanes;
      }
      for (; at < int64_t{plan.block_incoming[b + 1]} * kLanes; at += kLanes) {
        writable(plan.incoming)[at] = kRow * plan.edge_slots * kLanes;
      }
    }
  }
  return out;
}

Plan view_plan(const int32_t* buffer) {
  Plan p{};
  p.num_vertices = buffer[0];
  p.num_tets = buffer[1];
  p.num_active = buffer[2];
  p.colors = buffer[3];
  p.blocks = buffer[4];
  p.slots = buffer[5];
  p.edge_slots = buffer[6];
  p.incoming_slots = buffer[7];
  const int32_t* at = buffer + kPlanHeader;
  const auto take = [&](int64_t size) {
    const int32_t* here = at;
    at += size;
    return here;
  };
  p.color_block = take(p.colors + 1);
  p.block_slot = take(p.blocks + 1);
  p.block_rank = take(p.blocks + 1);
  p.block_edge = take(p.blocks + 1);
  p.block_incoming = take(p.blocks + 1);
  p.order = take(int64_t{p.blocks} * kLanes);
  p.pair = take(int64_t{p.slots} * kLanes);
  p.neighbors = take(int64_t{p.slots} * 3 * kLanes);
  p.edge = take(int64_t{p.slots} * 3 * kLanes);
  p.incoming = take(int64_t{p.incoming_slots} * kLanes);
  return p;
}

}  // namespace diffvbd
