// Loops over bodies, vertices and pairs that need no file of their own, with the names and arguments of the launches in
// csrc/cuda.
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "../contact/friction.h"
#include "../contact/islands.h"
#include "../contact/passes.h"
#include "../contact/trust_region.h"
#include "../subspace/begin.h"
#include "../subspace/coarse.h"
#include "../subspace/rigid.h"
#include "kernels.h"
#include "reductions.h"
#include "run.h"
#include "threads.h"

namespace diffvbd {

// Calls f(scene, item) for all items of all scenes, of which a thread gets at least so many.
template <class F>
void for_items(int64_t scenes, int64_t items, int64_t grain, const F& f) {
  torch::stable::parallel_for(0, scenes * items, grain, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) f(i / items, static_cast<int32_t>(i % items));
  });
}

// --- the start of a step, the rigid correction, potentials
// ------------------------------------------------------------

// others: whether some vertices are in no body that is corrected
template <class T>
void rigid_correct(const rigid::Inputs<T>& in, bool others, T* x, T* velocity) {
  if (others) for_vertices(in, [&](int64_t scene, int32_t i) { keep_vertex(in, scene, i, x, velocity); });
  for_bodies(in, [&](const rigid::Body<T>& body, const Threads& team) {
    rigid::Iteration record[rigid::kMaxIterations];
    if (in.data.data != nullptr) {
      rigid::correct<true>(body, team, record, x, velocity);
    } else {
      rigid::correct<false>(body, team, record, x, velocity);
    }
  });
}
template <class T>
void rigid_reverse(const rigid::Inputs<T>& in, bool others, const rigid::Adjoints<T>& a) {
  if (others) for_vertices(in, [&](int64_t scene, int32_t i) { reverse_kept(in, a, scene, i); });
  for_bodies(in, [&](const rigid::Body<T>& body, const Threads& team) {
    rigid::Iteration record[rigid::kMaxIterations];
    if (in.data.data != nullptr) {
      rigid::reverse<true>(body, team, record, a);
    } else {
      rigid::reverse<false>(body, team, record, a);
    }
  });
}

using start::StartChoice;

template <class T>
void begin(const start::Inputs<T>& in, const StartChoice<T>& of_corrected, const StartChoice<T>& of_others, T* x_start,
           T* y) {
  if (in.some_alone) {
    T* second = of_others.two && of_others.second != y ? of_others.second : nullptr;
    for_vertices(in.bodies, [&](int64_t scene, int32_t i) { begin_vertex(in, x_start, second, y, scene, i); });
  }
  if (of_others.two) {
    for_bodies(of_others.two->bodies, [&](const rigid::Body<T>& body, const Threads& team) {
      of_others.taken[body.scene * in.others + body.body] =
          start::path_between<false>(*of_others.two, body, team).increase <= 0;
    });
    for_vertices(in.bodies, [&](int64_t scene, int32_t i) { choose_vertex(in, x_start, of_others.second, scene, i); });
  }
  for_bodies(in.bodies, [&](const rigid::Body<T>& body, const Threads& team) {
    if (in.bodies.data.data != nullptr) {
      start::begin_body<true>(in, body, team, x_start, y, of_corrected.taken);
    } else {
      start::begin_body<false>(in, body, team, x_start, y, of_corrected.taken);
    }
  });
  if (of_corrected.two) {
    for_bodies(of_corrected.two->bodies, [&](const rigid::Body<T>& body, const Threads& team) {
      start::release_body(in, *of_corrected.two, body, team, x_start, of_corrected.second, of_corrected.taken);
    });
  }
}
template <class T>
void begin_backward(const start::Inputs<T>& in, const start::Adjoints<T>& a, T* extrapolated, T* y) {
  if (in.some_alone) {
    for_vertices(in.bodies, [&](int64_t scene, int32_t i) { reverse_vertex(in, a, scene, i); });
  }
  for_bodies(in.bodies, [&](const rigid::Body<T>& body, const Threads& team) {
    rigid::Iteration record[rigid::kMaxIterations];
    if (in.bodies.data.data != nullptr) {
      start::reverse_body<true>(in, body, team, record, extrapolated, y, a);
    } else {
      start::reverse_body<false>(in, body, team, record, extrapolated, y, a);
    }
  });
}

// out [B, bodies, 2]: the increase, and how much of it is rounding at most; infinite where a vertex would be too near a
// plane.
template <class T>
void energy_increase(const coarse::IncreaseInputs<T>& in, double* out) {
  static_assert(coarse::kBlockTets == kLanes);
  const int64_t scenes = in.bodies.scenes, vertices = in.bodies.vertices;
  // x[i] and to[i] - x[i] as rows of four
  const Buffer<T> at(size_t(scenes * vertices) * 4, true), displacement(size_t(scenes * vertices) * 4, true);
  for (int64_t v = 0; v < scenes * vertices; ++v) {
    for (int c = 0; c < 3; ++c) {
      at.get()[4 * v + c] = in.bodies.x[3 * v + c];
      displacement.get()[4 * v + c] = in.to[3 * v + c] - in.bodies.x[3 * v + c];
    }
  }
  const auto kernels = coarse_kernels<T>(kExactBlock);
  for_bodies(in.bodies, [&](const rigid::Body<T>& b, const Threads& team) {
    double single[3];
    team.template sum<3>(b.size(), single, [&](int32_t i, double* sum) {
      const int32_t v = b.vertex(i);
      rigid::add_energy_increase(b, v, diffvbd::wide_at(in.to + 3 * b.row(v)), sum);
    });
    double change[2 * coarse::kDegree];
    const int64_t row = 4 * b.scene * vertices;
    const int32_t first = in.block_ptr[b.body];
    const T* rest = in.rest.data + b.scene * in.rest.scene;
    const T* material = in.material.data + b.scene * in.material.scene;
    team.template sum<2 * coarse::kDegree>(in.block_ptr[b.body + 1] - first, change, [&](int32_t i, double* sum) {
      double c[coarse::kDegree] = {};
      kernels.line(in.corner, rest, material, at.get() + row, displacement.get() + row, first + i, first + i + 1, c);
      for (int k = 0; k < coarse::kDegree; ++k) sum[k] += c[k], sum[coarse::kDegree + k] += std::abs(c[k]);
    });
    const double h2 = b.in.time_step * b.in.time_step;
    double* to = out + 2 * (b.scene * in.bodies.bodies + b.body);
    to[0] = single[0], to[1] = single[1];
    for (int k = 0; k < coarse::kDegree; ++k) to[0] += h2 * change[k], to[1] += h2 * change[coarse::kDegree + k];
    if (single[2] > 0) to[0] = std::numeric_limits<double>::infinity();
  });
}

// --- contact
// ----------------------------------------------------------------------------------------------------------

// Positions in the user's numbering.
template <class T>
struct UserPositions {
  const T* x;
  Vec3<T> operator()(int v) const { return diffvbd::vector_at(x + int64_t{3} * v); }
};
// Calls f(pair, record, corners, constants, kappa) for each listed pair.
template <class T, class F>
void for_pairs(const contact::ContactInputs<T>& in, const T* x, int64_t scenes, const F& f) {
  const int64_t count = in.listed.ptr[scenes * in.corners] / 4;
  for (int64_t pair = 0; pair < count; ++pair) {
    const int32_t* record = in.listed.pairs + contact::kPairRow * pair;
    const UserPositions<T> positions{x + int64_t{record[5]} * 3 * in.num_vertices};
    const contact::Source<T, UserPositions<T>> source{in, record[5], positions};
    const contact::PairConstants<T> a(in.constants + contact::kConstants * pair);
    f(pair, record, source.corners(record), a, in.kappa.data[record[5] * in.kappa.scene]);
  }
}
// Adds what the corners of a pair receive to points [B, N, 3].
template <class T>
void add_at_corners(const contact::ContactInputs<T>& in, const int32_t* record, const Vec3<T> (&values)[4], T* points) {
  for (int k = 0; k < 4; ++k) diffvbd::add_to(points + 3 * (record[5] * in.corners + record[k]), values[k]);
}

template <class T>
void pair_lag(const contact::ContactInputs<T>& in, const T* x, int64_t scenes, int64_t pairs, T* values) {
  std::fill_n(values, pairs * contact::kLagScalars, T(0));
  for_pairs(in, x, scenes, [&](int64_t pair, const int32_t* record, const auto& corners, const auto& a, T stiffness) {
    contact::store_lag(contact::lag_state(record[4], corners, a, stiffness), values + contact::kLagScalars * pair);
  });
}
template <class T>
void pair_loads(const contact::PairList& listed, int64_t corners, const int32_t* body, const T* lag, int64_t scenes,
                int64_t pairs, T* force, int64_t* bearer) {
  const int64_t count = listed.ptr[scenes * corners] / 4;
  for (int64_t pair = 0; pair < pairs; ++pair) {
    const auto load = pair < count ? contact::load_of(listed, corners, body, lag, pair) : contact::Load<T>{pair, T(0)};
    force[pair] = load.force, bearer[pair] = load.bearer;
  }
}
template <class T>
void pair_lag_backward(const contact::ContactInputs<T>& in, const T* x, int64_t scenes, const T* bar, T* points,
                       T* kappa) {
  std::fill_n(points, 3 * scenes * in.corners, T(0)), std::fill_n(kappa, scenes, T(0));
  for_pairs(in, x, scenes, [&](int64_t pair, const int32_t* record, const auto& corners, const auto& a, T stiffness) {
    contact::PairAdjoint<T> out;
    contact::reverse_lag(record[4], corners, a, stiffness, bar + contact::kLagScalars * pair, out);
    add_at_corners(in, record, out.x, points);
    kappa[record[5]] += out.kappa;
  });
}
// --- sums over a mesh
// -------------------------------------------------------------------------------------------------

template <class T>
void gather_rows(const T* values, const int64_t* index, int64_t scenes, int64_t vertices, int64_t n, int64_t c,
                 T* out) {
  for (int64_t i = 0; i < scenes; ++i) gather_rows(values + i * vertices * c, index, n, c, out + i * n * c);
}
template <class T>
void sum_segments(const T* values, const int64_t* ptr, const int32_t* entry, int64_t scenes, int64_t n,
                  int64_t segments, int64_t c, T* out) {
  for (int64_t i = 0; i < scenes; ++i)
    sum_segments(values + i * n * c, ptr, entry, segments, c, out + i * segments * c);
}
template <class T>
void sum_rows(const T* values, int64_t rows, int64_t columns, T* out) {
  for (int64_t i = 0; i < rows; ++i) out[i] = pairwise_sum(values + i * columns, columns);
}
template <class T>
void pack_rest(const Plan& plan, int64_t scenes, const T* rest, T* packed) {
  const int64_t size = int64_t{plan.slots} * kPairRest * kLanes;
  for (int64_t i = 0; i < scenes; ++i) pack_rest<T>(plan, rest + i * plan.num_tets * kRestScalars, packed + i * size);
}

}  // namespace diffvbd
