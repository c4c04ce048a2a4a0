// The system of a group of bodies whose rigid motions are solved for together, for the threads of one block: a warp for
// each of its bodies in turn.
#pragma once

#include "cholesky.cuh"
#include "contact_rigid_presses.cuh"

namespace diffvbd::cuda {
namespace {

constexpr unsigned kAll = 0xffffffffu;
constexpr int kTeam = 256, kTeamWarps = kTeam / 32;
constexpr int kOwn = kUnknowns + rigid::kSix;
constexpr int kLines = 16;  // slips that a thread keeps while a step looks for its length
constexpr int kMostUnknowns = kUnknowns * kMostCoupled;
constexpr int64_t kShared = 16;    // bodies up to which their matrix is in shared memory, where there are many groups
constexpr int kStatic = 16 << 10;  // bytes of shared memory that are not for the matrix, at most

using Warp = Tile<32>;

// The system of a group.
template <class T>
struct GroupSystem {
  const RigidInputs<T>& in;
  PairRoom room;
  int64_t scene;
  Groups groups;
  int32_t first, count;
  const int32_t* sides;
  double *center, *motion, *steps, *press;        // of the scene's bodies; of all rows
  double* rubbing;                                // [lagged rows, kRubbing]
  double *base, *matrix, *gradient, *step, *own;  // own: the motion of the group
  const uint64_t* touching;                       // [count] a bit for each body that a body touches,
  const uint64_t* columns;  // [count] bits of the blocks of the factor that are not zero, below the diagonal
  int32_t* rows;            // twice the row of a pair, and its side: those of each body
  const int32_t* begin;     // [count + 1] where they begin, and
  const int32_t* lagged;    // [count] those of lagged pairs
  double (*part)[2];

  __device__ int32_t size() const { return kUnknowns * count; }
  __device__ int32_t member(int32_t b) const { return groups.member(first + b); }
  __device__ Body<T> body(int32_t b) const { return {in.scene, scene, member(b)}; }
  __device__ Vector center_of(int32_t b) const { return vector_of(center + 3 * member(b)); }
  __device__ double& unknown(double* of, int32_t i) const {  // of the scene's bodies
    return of[kUnknowns * member(i / kUnknowns) + i % kUnknowns];
  }
  // In the lower half of a matrix.
  __device__ double& at(double* of, int32_t b, int i, int32_t c, int j) const {
    return of[size() * (kUnknowns * b + i) + kUnknowns * c + j];
  }
  template <class F>
  __device__ void each(int32_t items, const F& f) const {
    for (auto i = static_cast<int32_t>(threadIdx.x); i < items; i += kTeam) f(i);
  }
  template <class F>
  __device__ void each_body(const F& f) const {  // with a warp
    for (auto b = static_cast<int32_t>(threadIdx.x / 32); b < count; b += kTeamWarps) f(b);
  }
  template <int n>
  __device__ void reduce(double* total) const {
    butterfly<n, 32>(kAll, total);
    __syncthreads();
    for (int k = 0; threadIdx.x % 32 == 0 && k < n; ++k) part[threadIdx.x / 32][k] = total[k];
    __syncthreads();
#pragma unroll
    for (int k = 0; k < n; ++k) {
      total[k] = 0;
      for (int w = 0; w < kTeamWarps; ++w) total[k] += part[w][k];
    }
  }

  // Calls f(row, side) for what a body has of pairs of a list that act, in order; the listed come before the lagged.
  template <class F>
  __device__ void each_side(int32_t b, bool which, const F& f) const {
    const PairList& list = which ? in.lagged : in.gate.listed;
    const int64_t before = which ? room.listed : 0;
    const Body<T> whose = body(b);
    for (int32_t i = 0; i < whose.size(); ++i) {
      const int64_t corner = scene * in.gate.corners + whose.vertex(i);
      for (int32_t from = list.ptr[corner]; from < list.ptr[corner + 1]; from += 32) {
        const int32_t mine = from + static_cast<int32_t>(threadIdx.x % 32);
        const int32_t entry = mine < list.ptr[corner + 1] ? list.entry[mine] : 3;
        f(before + (entry >> 2), side_of(list, sides + 2 * before, entry, whose.body));
      }
    }
  }

  // Gradient and matrix of what acts on vertices alone, or of friction on planes where bodies have gone.
  template <bool rubs>
  __device__ void add_vertices(int32_t b, double* to, double* gradients) const {
    const Body<T> own = body(b);
    if (rubs && !in.free[own.body]) return;
    const Warp warp;
    Whole whole{};
    if constexpr (!rubs) {
      whole = whole_of(own, warp);
      if (warp.leads()) rigid::put(center + 3 * own.body, whole.center);
      warp.meet();
    }
    const Vector c = rubs ? center_of(b) : whole.center;
    const bool free = rubs || (in.free[own.body] && 0 < whole.mass);
    double total[kOwn + 1];  // and the sum of m r^2
    warp.template sum<kOwn + 1>(free ? own.size() : 0, total, [&](int32_t i, double* out) {
      const int32_t v = own.vertex(i);
      const Vector arm = own.position(v) - c;
      Vector g{};
      Sym3<double> H{};
      if constexpr (rubs) {
        add_floor_friction(in, own, v, moved_by(motion + kUnknowns * own.body, arm), g, H);
      } else {
        vertex_press(in, own, v, g, H);
        out[kOwn] += own.mass(v) * dot(arm, arm);
      }
      rigid::add_vertex(arm, g, H, out, out + kUnknowns);
    });
    if (!warp.leads()) return;
#pragma unroll
    for (int i = 0; i < kUnknowns; ++i) {
      gradients[kUnknowns * b + i] += total[i];
#pragma unroll
      for (int j = 0; j <= i; ++j) at(to, b, i, b, j) += total[kUnknowns + rigid::at6(i, j)];
      if constexpr (!rubs) at(to, b, i, b, i) += free ? kLeastInertia * (i < 3 ? total[kOwn] : whole.mass) : 1;
    }
  }
  // Of the pairs in a part of the rows of a body: what they add to its own part of the matrix, and to those between it
  // and bodies before it.
  __device__ void add_pairs(int32_t b, int32_t from, int32_t to, double* of, double* gradients) const {
    const Warp warp;
    const Vector c = center_of(b);
    double own[kOwn];
    warp.template sum<kOwn>(to - from, own, [&](int32_t e, double* out) {
      const PairPress a = press_of(rows[from + e] >> 1);
      const int side = rows[from + e] & 1;
#pragma unroll
      for (int j = 0; j < kUnknowns; ++j) {
        out[j] += a.gradient(side, j, c);
        const Vector pressed = a.stiffness * a.map(side, j, c);
#pragma unroll
        for (int i = j; i < kUnknowns; ++i) out[kUnknowns + rigid::at6(i, j)] += dot(a.map(side, i, c), pressed);
      }
    });
    if (warp.leads()) {
#pragma unroll
      for (int i = 0; i < kUnknowns; ++i) {
        gradients[kUnknowns * b + i] += own[i];
#pragma unroll
        for (int j = 0; j <= i; ++j) at(of, b, i, b, j) += own[kUnknowns + rigid::at6(i, j)];
      }
    }
    for (int32_t other = 0; other < b; ++other) {
      if (!(touching[b] >> other & 1)) continue;
      const int32_t body = member(other);
      const Vector d = center_of(other);
      double total[kUnknowns * kUnknowns];
      warp.template sum<kUnknowns * kUnknowns>(to - from, total, [&](int32_t e, double* out) {
        const int64_t row = rows[from + e] >> 1;
        const int side = rows[from + e] & 1;
        if (sides[2 * row + 1 - side] != body) return;
        const PairPress a = press_of(row);
#pragma unroll
        for (int j = 0; j < kUnknowns; ++j) {
          const Vector pressed = a.stiffness * a.map(1 - side, j, d);
#pragma unroll
          for (int i = 0; i < kUnknowns; ++i) out[kUnknowns * i + j] += dot(a.map(side, i, c), pressed);
        }
      });
      if (!warp.leads()) continue;
#pragma unroll
      for (int k = 0; k < kUnknowns * kUnknowns; ++k) at(of, b, k / kUnknowns, other, k % kUnknowns) += total[k];
    }
  }
  __device__ PairPress press_of(int64_t row) const { return load_press(press + kPressDoubles * row, sides + 2 * row); }

  // Of what does not change, all blocks of a column that may not be zero.
  __device__ void copy_column(int32_t b) const {
    for (uint64_t blocks = columns[b] | uint64_t{1} << b; blocks != 0; blocks &= blocks - 1) {
      const int32_t row = __ffsll(static_cast<long long>(blocks)) - 1;
      for (int k = static_cast<int>(threadIdx.x % 32); k < kUnknowns * kUnknowns; k += 32) {
        at(matrix, row, k / kUnknowns, b, k % kUnknowns) = at(base, row, k / kUnknowns, b, k % kUnknowns);
      }
    }
  }

  // What does not change as bodies move: all but friction and damping.
  __device__ void assemble() const {
    each(size() * size(), [&](int32_t i) { base[i] = matrix[i] = 0; });
    each(size(), [&](int32_t i) { gradient[i] = own[i] = unknown(motion, i) = 0; });
    __syncthreads();
    each_body([&](int32_t b) { add_vertices<false>(b, base, gradient); });
    __syncthreads();
    each_body([&](int32_t b) { add_pairs(b, begin[b], lagged[b], base, gradient); });
    if (in.lag) {
      each_row([&](int64_t row, int64_t pair) {
        PairPress a;
        Rubbing rubs;
        lagged_sides(in, pair, CornerPoints<T>{in, false}, -1, a, rubs);  // it acts, or had no row
        a.force = Vector{}, a.stiffness = Sym3<double>{};
        store_press(a, press + kPressDoubles * row);
        double* to = rubbing + kRubbing * pair;
        rigid::put(to, rubs.n), rigid::put(to + 3, rubs.u);
        to[6] = rubs.size, to[7] = rubs.damping, to[8] = rubs.approach;
      });
    }
    __syncthreads();
  }
  // And these, linear about where bodies have gone.
  __device__ void add_friction() const {
    if (in.planes > 0) each_body([&](int32_t b) { add_vertices<true>(b, matrix, step); });
    if (!in.lag) return;
    each_row([&](int64_t row, int64_t pair) {
      PairPress a = press_of(row);
      a.doubled = 1;
      double* of = rubbing + kRubbing * pair;
      rub({vector_of(of), vector_of(of + 3), of[6], of[7], of[8]}, way_of(a, {center, motion}), in.friction_eps, a);
      store_press(a, press + kPressDoubles * row);
      rigid::put(of + 9, a.slip);
    });
    __syncthreads();
    each_body([&](int32_t b) { add_pairs(b, lagged[b], begin[b + 1], matrix, step); });
  }
  // Calls f(row, pair) for the lagged pairs, each once, in a thread's share.
  template <class F>
  __device__ void each_row(const F& f) const {
    each(begin[count] - begin[0], [&](int32_t i) {
      const int64_t row = rows[begin[0] + i] >> 1;
      const int side = rows[begin[0] + i] & 1;
      if (row >= room.listed && side == (sides[2 * row] < 0 ? 1 : 0)) f(row, row - room.listed);
    });
  }

  // step += matrix motion
  __device__ void add_product() const {
    each_body([&](int32_t b) {
      for (int i = 0; i < kUnknowns; ++i) {
        const int32_t row = kUnknowns * b + i;
        double sum = 0;
        for (auto j = static_cast<int32_t>(threadIdx.x % 32); j < size(); j += 32) {
          sum += matrix[j <= row ? size() * row + j : size() * j + row] * own[j];
        }
        butterfly<1, 32>(kAll, &sum);
        if (threadIdx.x % 32 == 0) step[row] += sum;
      }
    });
  }
  // Of the matrix, of the step and of the motion after it: half of the first is what the step lowers the potential by.
  __device__ void energies(double* total) const {
    total[0] = total[1] = 0;
    each(size(), [&](int32_t j) {
      double one = 0, whole = 0;
      for (int32_t i = j; i < size(); ++i) {
        one += matrix[size() * i + j] * step[i];
        whole += matrix[size() * i + j] * (step[i] + own[i]);
      }
      total[0] += one * one, total[1] += whole * whole;
    });
    reduce<2>(total);
  }
  // Calls f(line) for what slips, in a thread's share.
  template <class F>
  __device__ void each_line(const F& f) const {
    if (in.lag) {
      each_row([&](int64_t row, int64_t pair) {
        PairPress a = press_of(row);
        a.doubled = 1;
        const double* of = rubbing + kRubbing * pair;
        const Vector n = vector_of(of), way = way_of(a, {center, steps});
        f(SlipLine(vector_of(of + 9), way - dot(n, way) * n, of[6], in.friction_eps));
      });
    }
    if (in.planes == 0) return;
    each_body([&](int32_t b) {
      const Body<T> own = body(b);
      for (auto i = static_cast<int32_t>(threadIdx.x % 32); in.free[own.body] && i < own.size() * in.planes; i += 32) {
        const int32_t v = own.vertex(i / in.planes), k = i % in.planes;
        if (!bears(in, own, v, k)) continue;
        const Vector arm = own.position(v) - center_of(b);
        const int64_t at = int64_t{kUnknowns} * own.body;
        f(slip_line(in, own, v, k, arm, motion + at, steps + at));
      }
    });
  }
  __device__ double share(double fall) const {
    SlipLine kept[kLines];
    int lines = 0;
    each_line([&](const SlipLine& a) {
      if (lines < kLines) kept[lines] = a;
      ++lines;
    });
    return slip_share(fall, [&](double tried) {
      double total[1] = {0};
      for (int l = 0; l < lines && l < kLines; ++l) total[0] += kept[l].excess(tried);
      if (lines > kLines) {
        int seen = 0;
        each_line([&](const SlipLine& line) {
          if (seen++ >= kLines) total[0] += line.excess(tried);
        });
      }
      reduce<1>(total);
      return total[0];
    });
  }

  __device__ void solve(Pivots& pivots) const {
    Settling state = kOnItsWay;  // the same for all threads
    for (int iteration = 0; iteration < kSlipIterations && state != kDone; ++iteration) {
      each_body([&](int32_t b) { copy_column(b); });
      each(size(), [&](int32_t i) { step[i] = gradient[i]; });
      __syncthreads();
      add_friction();
      __syncthreads();
      if (iteration > 0) add_product();
      __syncthreads();
      factor_blocks<kTeam>(count, columns, matrix, step, pivots);
      solve_backward<kTeam>(count, matrix, step);
      each(count, [&](int32_t b) { keep_finite(step + kUnknowns * b); });
      __syncthreads();
      each(size(), [&](int32_t i) { unknown(steps, i) = step[i]; });
      __syncthreads();
      double of[2] = {0, 0};
      if (in.rubs()) energies(of);
      const double taken = settle(state, in.rubs(), of[0], of[1], [&](double fall) { return share(fall); });
      each(size(), [&](int32_t i) { unknown(motion, i) = own[i] += taken * step[i]; });
      __syncthreads();
    }
  }
};

}  // namespace
}  // namespace diffvbd::cuda
