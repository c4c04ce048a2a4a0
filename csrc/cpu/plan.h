// Sweep order of a mesh: stars, coloring, blocks. Built once for a Model, stored in one int32 buffer.
#pragma once

#include <cstdint>
#include <vector>

#include "../core/views.h"

namespace diffvbd {

// vertex -> incident tets: entries 4 tet + local index, ascending
struct Stars {
  std::vector<int64_t> ptr;    // [V + 1]
  std::vector<int32_t> entry;  // [4 T]
};

Stars build_stars(const int64_t* tets, int64_t num_tets, int64_t num_vertices);

// Neighbours of each vertex, ascending and without repetition: neighbor[3 stars.ptr[v] + e], e < degree[v].
struct Adjacency {
  std::vector<int32_t> neighbor, degree;
};

Adjacency build_adjacency(const int64_t* tets, const Stars& stars);

// Greedy coloring by saturation (after DSATUR, Brelaz 1979) of the vertices with active[v] (others get -1): no two that
// share a tet share a color.
std::vector<int32_t> color_vertices(const Stars& stars, const Adjacency& graph, const uint8_t* active, int* colors);

// The plan as one buffer (core/views.h), for this backend and for CUDA.
std::vector<int32_t> build_plan(const double* points, const int64_t* tets, int64_t num_tets, const Stars& stars,
                                const Adjacency& graph, const std::vector<int32_t>& color, int colors);
std::vector<int32_t> build_group_plan(const double* points, const int64_t* tets, int64_t num_tets, const Stars& stars,
                                      const Adjacency& graph, const std::vector<int32_t>& color, int colors);

}  // namespace diffvbd
