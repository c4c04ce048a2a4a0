#include "plan.h"

#include <algorithm>
#include <array>
#include <limits>
#include <stdexcept>

#include "../contact/detection.h"

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

// Sweep orders of the CPU (blocks of kLanes) and of CUDA (blocks of kSlice), and the buffers that hold them.

namespace {

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
      key |= contact::spread_bits(static_cast<uint64_t>((points[3 * v + c] - low[c]) * scale[c])) << c;
    }
    keys[v] = {key, static_cast<int32_t>(v)};
  }
  std::sort(keys.begin(), keys.end());
  std::vector<int32_t> out(n);
  for (int64_t i = 0; i < n; ++i) out[i] = keys[i].second;
  return out;
}

// Vertices in sweep order, in blocks of `lanes`.
struct Layout {
  int lanes;
  int32_t colors, active, blocks, slots, edge_slots, incoming_slots, degree;
  std::vector<int32_t> color_block, block_slot, block_rank, block_edge, block_incoming, order, position;
};

Layout lay_out(const double* points, const Stars& stars, const Adjacency& graph, const std::vector<int32_t>& color,
               int colors, int lanes) {
  const int64_t n = static_cast<int64_t>(color.size());
  std::vector<int32_t> active_degree(n, 0);
  for (int64_t v = 0; v < n; ++v) {
    const int32_t* neighbor = graph.neighbor.data() + 3 * stars.ptr[v];
    for (int32_t e = 0; e < graph.degree[v]; ++e) active_degree[v] += color[neighbor[e]] >= 0;
  }
  const auto valence = [&](int32_t v) { return static_cast<int32_t>(stars.ptr[v + 1] - stars.ptr[v]); };
  // Morton order keeps the neighbours of a block near each other in memory; inside a window, sorting by valence lets
  // the lanes of a block have stars of like length.
  const int64_t window = 64 * lanes;
  std::vector<std::vector<int32_t>> members(colors + 1);
  for (const int32_t v : morton_order(points, n)) members[color[v] < 0 ? colors : color[v]].push_back(v);
  Layout out{};
  out.lanes = lanes;
  out.colors = colors;
  out.position.resize(n);
  int64_t slots = 0, edge_slots = 0, incoming_slots = 0;
  for (int c = 0; c <= colors; ++c) {
    auto& list = members[c];
    const int64_t size = static_cast<int64_t>(list.size());
    for (int64_t a = 0; a < size; a += window) {
      std::stable_sort(list.begin() + a, list.begin() + std::min(size, a + window),
                       [&](int32_t u, int32_t w) { return valence(u) > valence(w); });
    }
    out.color_block.push_back(out.blocks);
    for (int64_t a = 0; a < size; a += lanes, ++out.blocks) {
      out.block_slot.push_back(static_cast<int32_t>(slots));
      out.block_rank.push_back(out.active);
      out.block_edge.push_back(static_cast<int32_t>(edge_slots));
      out.block_incoming.push_back(static_cast<int32_t>(incoming_slots));
      int32_t most = 0, edges = 0, incoming = 0;
      for (int64_t i = a; i < a + lanes; ++i) {
        const int32_t v = i < size ? list[i] : -1;
        out.order.push_back(v);
        if (v < 0) continue;
        out.position[v] = static_cast<int32_t>(out.blocks * lanes + i - a);
        most = std::max(most, valence(v));
        incoming = std::max(incoming, active_degree[v]);
        if (c < colors) edges = std::max(edges, graph.degree[v]), ++out.active;
      }
      slots += most;
      edge_slots += edges;
      incoming_slots += incoming;
      out.degree = std::max(out.degree, edges);
    }
  }
  if (std::max({slots, (edge_slots + 1) * kRow, incoming_slots}) * lanes > std::numeric_limits<int32_t>::max()) {
    throw std::invalid_argument("mesh: too large, expected at most 2^31 (vertex, tet) pairs");
  }
  out.slots = static_cast<int32_t>(slots);
  out.edge_slots = static_cast<int32_t>(edge_slots);
  out.incoming_slots = static_cast<int32_t>(incoming_slots);
  out.block_slot.push_back(out.slots);
  out.block_rank.push_back(out.active);
  out.block_edge.push_back(out.edge_slots);
  out.block_incoming.push_back(out.incoming_slots);
  return out;
}

// Header and blocks, which both plans share; `extra` scalars follow.
std::vector<int32_t> start_buffer(const Layout& layout, int64_t vertices, int64_t tets, int64_t extra) {
  const auto n = static_cast<int32_t>(vertices), t = static_cast<int32_t>(tets);
  std::vector<int32_t> out = {
      n, t, layout.active, layout.colors, layout.blocks, layout.slots, layout.edge_slots, layout.incoming_slots};
  out.resize(kPlanHeader);
  for (const auto* list : {&layout.color_block, &layout.block_slot, &layout.block_rank, &layout.block_edge,
                           &layout.block_incoming, &layout.order}) {
    out.insert(out.end(), list->begin(), list->end());
  }
  out.resize(out.size() + extra);
  return out;
}

int32_t* writable(const int32_t* p) { return const_cast<int32_t*>(p); }

// The mesh, for visits of the pairs and edges of a layout.
struct Mesh {
  const int64_t* tets;
  const Stars& stars;
  const Adjacency& graph;
  const std::vector<int32_t>& color;

  const int32_t* neighbors(int32_t v) const { return graph.neighbor.data() + 3 * stars.ptr[v]; }
  // which of v's edges leads to u
  int32_t edge_to(int32_t v, int32_t u) const {
    const int32_t* first = neighbors(v);
    return static_cast<int32_t>(std::lower_bound(first, first + graph.degree[v], u) - first);
  }
  // calls f(slot, lane, block, vertex, entry) for each place of a pair; entry is -1 for padding
  template <class F>
  void each_pair(const Layout& layout, const F& f) const {
    for (int32_t b = 0; b < layout.blocks; ++b) {
      for (int l = 0; l < layout.lanes; ++l) {
        const int32_t v = layout.order[int64_t{b} * layout.lanes + l];
        int64_t e = v < 0 ? 0 : stars.ptr[v];
        const int64_t end = v < 0 ? 0 : stars.ptr[v + 1];
        for (int32_t s = layout.block_slot[b]; s < layout.block_slot[b + 1]; ++s, ++e) {
          f(s, l, b, v, e < end ? stars.entry[e] : -1);
        }
      }
    }
  }
  // fills the rows that end in each vertex, times `scale`
  void fill_incoming(const Layout& layout, int32_t* incoming, int32_t scale) const {
    const int32_t lanes = layout.lanes;
    for (int32_t b = 0; b < layout.blocks; ++b) {
      for (int l = 0; l < lanes; ++l) {
        const int32_t v = layout.order[int64_t{b} * lanes + l];
        int64_t at = int64_t{layout.block_incoming[b]} * lanes + l;
        for (int32_t e = 0; v >= 0 && e < graph.degree[v]; ++e) {
          const int32_t u = neighbors(v)[e];
          if (color[u] < 0) continue;
          const int32_t row = layout.block_edge[layout.position[u] / lanes] + edge_to(u, v);
          incoming[at] = scale * (row * lanes + layout.position[u] % lanes);
          at += lanes;
        }
        for (; at < int64_t{layout.block_incoming[b + 1]} * lanes; at += lanes) {
          incoming[at] = scale * layout.edge_slots * lanes;
        }
      }
    }
  }
};

// The corners of pairs of a vertex that lead along each edge (see GroupPlan).
struct Entries {
  std::vector<int32_t> first, entry;
};

Entries list_entries(const Mesh& mesh, const Layout& layout) {
  Entries out;
  std::vector<std::vector<int32_t>> found;  // [edges of the block, kSlice]
  for (int32_t b = 0; b < layout.blocks; ++b) {
    const int32_t edges = layout.block_edge[b + 1] - layout.block_edge[b];
    found.assign(static_cast<size_t>(edges) * kSlice, {});
    for (int l = 0; l < kSlice && edges > 0; ++l) {
      const int32_t v = layout.order[int64_t{b} * kSlice + l];
      if (v < 0) continue;
      for (int64_t e = mesh.stars.ptr[v]; e < mesh.stars.ptr[v + 1]; ++e) {
        const int32_t pair = mesh.stars.entry[e], number = static_cast<int32_t>(e - mesh.stars.ptr[v]);
        for (int a = 0; a < 3; ++a) {
          const int64_t other = mesh.tets[(pair & ~3) + other_corner(pair & 3, a)];
          found[mesh.edge_to(v, static_cast<int32_t>(other)) * size_t{kSlice} + l].push_back(3 * number + a);
        }
      }
    }
    const int32_t none = 3 * (layout.block_slot[b + 1] - layout.block_slot[b]);
    for (int32_t a = 0; a < edges; ++a) {
      out.first.push_back(static_cast<int32_t>(out.entry.size() / kSlice));
      size_t most = 0;
      for (int l = 0; l < kSlice; ++l) most = std::max(most, found[a * size_t{kSlice} + l].size());
      for (size_t i = 0; i < most; ++i) {
        for (int l = 0; l < kSlice; ++l) {
          const auto& list = found[a * size_t{kSlice} + l];
          out.entry.push_back(i < list.size() ? list[i] : none);
        }
      }
    }
  }
  out.first.push_back(static_cast<int32_t>(out.entry.size() / kSlice));
  return out;
}

}  // namespace

std::vector<int32_t> build_plan(const double* points, const int64_t* tets, int64_t num_tets, const Stars& stars,
                                const Adjacency& graph, const std::vector<int32_t>& color, int colors) {
  const Layout layout = lay_out(points, stars, graph, color, colors, kLanes);
  const Mesh mesh{tets, stars, graph, color};
  const int64_t extra = int64_t{layout.slots} * 7 * kLanes + int64_t{layout.incoming_slots} * kLanes;
  std::vector<int32_t> out = start_buffer(layout, static_cast<int64_t>(color.size()), num_tets, extra);
  const Plan plan = view_plan(out.data());
  mesh.each_pair(layout, [&](int32_t s, int l, int32_t b, int32_t v, int32_t entry) {
    const bool real = entry >= 0;
    writable(plan.pair)[s * int64_t{kLanes} + l] = real ? entry : 0;
    for (int a = 0; a < 3; ++a) {
      const int64_t at = (s * int64_t{3} + a) * kLanes + l;
      const int32_t other = real ? static_cast<int32_t>(tets[(entry & ~3) + other_corner(entry & 3, a)]) : 0;
      writable(plan.neighbors)[at] = kRow * (real ? layout.position[other] : b * kLanes + l);
      writable(plan.edge)[at] = kRow * ((real ? mesh.edge_to(v, other) : 0) * kLanes + l);
    }
  });
  mesh.fill_incoming(layout, writable(plan.incoming), kRow);
  return out;
}

std::vector<int32_t> build_group_plan(const double* points, const int64_t* tets, int64_t num_tets, const Stars& stars,
                                      const Adjacency& graph, const std::vector<int32_t>& color, int colors) {
  Layout layout = lay_out(points, stars, graph, color, colors, kSlice);
  ++layout.slots;  // one of padding alone, for threads that have no pair left
  if (layout.degree > kMaxDegree) {
    throw std::invalid_argument("mesh: expected at most 1023 neighbours of a vertex on CUDA");
  }
  const Mesh mesh{tets, stars, graph, color};
  const bool small = color.size() <= kSmallMesh;
  const Entries entries = list_entries(mesh, layout);
  const int64_t extra = (int64_t{layout.slots} * 2 + layout.edge_slots + layout.incoming_slots) * kSlice +
                        static_cast<int64_t>(entries.first.size() + entries.entry.size()) + 4 * num_tets +
                        (small ? 2 * layout.active + 16 * num_tets : 0);
  std::vector<int32_t> out = start_buffer(layout, static_cast<int64_t>(color.size()), num_tets, extra);
  out[8] = static_cast<int32_t>(entries.entry.size() / kSlice);
  out[9] = layout.degree;
  for (int32_t b = 0; b < layout.color_block[colors]; ++b) {
    out[10] = std::max(out[10], layout.block_slot[b + 1] - layout.block_slot[b]);
  }
  const GroupPlan plan = view_group_plan(out.data(), out.data());
  std::copy(entries.first.begin(), entries.first.end(), writable(plan.edge_entry));
  std::copy(entries.entry.begin(), entries.entry.end(), writable(plan.entry));
  std::fill_n(writable(plan.tet_pair), 4 * num_tets, -1);
  std::fill_n(writable(plan.pair) + (layout.slots - 1) * int64_t{kSlice}, kSlice, -1);
  mesh.each_pair(layout, [&](int32_t s, int l, int32_t, int32_t v, int32_t entry) {
    const int64_t at = s * int64_t{kSlice} + l;
    writable(plan.pair)[at] = entry;
    int32_t where = 0;
    for (int a = 0; a < 3 && entry >= 0 && color[v] >= 0; ++a) {
      const int32_t other = static_cast<int32_t>(tets[(entry & ~3) + other_corner(entry & 3, a)]);
      where |= mesh.edge_to(v, other) << (a * kLocalBits);
    }
    writable(plan.local)[at] = where;
    if (entry >= 0 && color[v] >= 0) writable(plan.tet_pair)[entry] = static_cast<int32_t>(at);
  });
  for (int32_t b = 0; b < layout.blocks; ++b) {
    for (int32_t l = 0; l < kSlice; ++l) {
      const int32_t own = b * kSlice + l, v = layout.order[own];
      for (int32_t e = 0; e < layout.block_edge[b + 1] - layout.block_edge[b]; ++e) {
        writable(plan.adjacent)[(int64_t{layout.block_edge[b]} + e) * kSlice + l] =
            v >= 0 && e < graph.degree[v] ? layout.position[mesh.neighbors(v)[e]] : own;
      }
    }
  }
  mesh.fill_incoming(layout, writable(plan.incoming), 1);
  for (int64_t i = 0, rank = 0, next = 0; small && rank < layout.active; ++i) {
    const int32_t v = layout.order[i];
    if (v < 0) continue;
    writable(plan.visit)[2 * rank] = v + (static_cast<int32_t>(stars.ptr[v + 1] - stars.ptr[v]) << kLocalBits);
    writable(plan.visit)[2 * rank++ + 1] = static_cast<int32_t>(next);
    for (int64_t e = stars.ptr[v]; e < stars.ptr[v + 1]; ++e, ++next) {
      const int32_t entry = stars.entry[e], corner = entry & 3;
      int32_t where = 0;
      for (int a = 0; a < 3; ++a) {
        where |= static_cast<int32_t>(tets[(entry & ~3) + other_corner(corner, a)]) << (a * kLocalBits);
      }
      const int32_t row[] = {where, entry >> 2, plan.tet_pair[entry], corner};
      std::copy(row, row + 4, writable(plan.visit_pair) + 4 * next);
    }
  }
  return out;
}

}  // namespace diffvbd
