// The system of a group of bodies whose rigid motions are solved for together, for the threads of one block: a warp for
// each of its bodies in turn.
#pragma once

#include "cholesky.cuh"
#include "contact_rigid_presses.cuh"

namespace diffvbd::cuda {
namespace {

constexpr int kTeam = 256, kTeamWarps = kTeam / 32;
constexpr int kOwn = kUnknowns + rigid::kSix;
constexpr int kLines = 4;  // slips that a thread keeps while a step looks for its length
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
  double* rubbing;                                // [kRubScalars, lagged rows]
  int32_t* floors;                                // of the scene, as of GroupMemory
  double *base, *matrix, *gradient, *step, *own;  // own: the motion of the group
  const uint64_t* touching;                       // [count] a bit for each body that a body touches,
  const uint64_t* columns;  // [count] bits of the blocks of the factor that are not zero, below the diagonal
  const int32_t* rows;      // as of GroupMemory
  const int32_t* begin;     // [count] where those of a body begin,
  const int32_t* lagged;    // [count] those of lagged pairs among them,
  const int32_t* end;       // [count] and where they end
  int32_t* borne;           // [count] how often planes bear vertices of a body
  double (*part)[2];
  int2 all_rows;  // where those of all begin and end

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
    butterfly<n, 32>(kWholeWarp, total);
    __syncthreads();
    for (int k = 0; threadIdx.x % 32 == 0 && k < n; ++k) part[threadIdx.x / 32][k] = total[k];
    __syncthreads();
#pragma unroll
    for (int k = 0; k < n; ++k) {
      total[k] = 0;
      for (int w = 0; w < kTeamWarps; ++w) total[k] += part[w][k];
    }
  }

  // No motion, and no factor.
  __device__ void stay(double* factor) const {
    each(size(), [&](int32_t i) { unknown(motion, i) = 0; });
    each_body([&](int32_t b) {
      const Whole whole = whole_of(body(b), Warp());
      if (Warp().leads()) put(center + 3 * member(b), whole.center);
    });
    if (threadIdx.x == 0) *factor = CUDART_NAN;  // which makes no number of all that is solved with it
  }
  // Adds to a body's gradient and its own part of a matrix, whose entries lanes have one each.
  __device__ void put_own(double mine, int32_t b, double* to, double* gradients) const {
    const int32_t entry = Warp().lane - kUnknowns;
    if (entry < 0) gradients[kUnknowns * b + entry + kUnknowns] += mine;
    if (entry < 0 || rigid::kSix <= entry) return;
    int i = 0;
    while (rigid::at6(i + 1, 0) <= entry) ++i;
    at(to, b, i, b, entry - rigid::at6(i, 0)) += mine;
  }
  // Gradient and matrix of what acts on vertices alone but for friction; and which vertices planes bear.
  __device__ void add_vertices(int32_t b) const {
    const Body<T> own = body(b);
    const Warp warp;
    const Whole whole = whole_of(own, warp);
    if (warp.leads()) put(center + 3 * own.body, whole.center);
    warp.meet();
    const bool free = in.free[own.body] && 0 < whole.mass;
    double total[32] = {};  // and the sum of m r^2
    for (int32_t i = warp.lane; free && i < own.size(); i += 32) {
      const int32_t v = own.vertex(i);
      const Vector arm = own.position(v) - whole.center;
      Vector g{};
      Sym3<double> H{};
      vertex_force(in, own, v, g, H);
      total[kOwn] += own.mass(v) * dot(arm, arm);
      rigid::add_vertex(arm, g, H, total, total + kUnknowns);
    }
    const double mine = sums_by_lane(total), turning = __shfl_sync(kWholeWarp, mine, kOwn);
    put_own(mine, b, base, gradient);
    __syncwarp();
    if (warp.lane < kUnknowns) {
      const double inertia = warp.lane < 3 ? turning : whole.mass;
      at(base, b, warp.lane, b, warp.lane) += free ? kLeastInertia * inertia : 1;
    }
    int32_t found = 0;
    const int32_t places = in.free[own.body] ? own.size() * in.planes : 0;
    for (int32_t from = 0; from < places; from += 32) {
      const int32_t i = from + warp.lane;
      const bool bearing = i < places && bears(in, own, own.vertex(i / in.planes), i % in.planes);
      const unsigned all = __ballot_sync(kWholeWarp, bearing);
      if (bearing) floors_of(own)[found + __popc(all & ((1u << warp.lane) - 1))] = i;
      found += __popc(all);
    }
    if (warp.leads()) borne[b] = found;
  }
  __device__ int32_t* floors_of(const Body<T>& own) const { return floors + in.planes * in.scene.ptr[own.body]; }
  // Friction on planes, linear about where a body has gone.
  __device__ void add_floors(int32_t b, double* out) const {
    const Body<T> own = body(b);
    const Vector c = center_of(b);
    for (int32_t i = Warp().lane; i < borne[b]; i += 32) {
      const int32_t place = floors_of(own)[i], v = own.vertex(place / in.planes);
      const Vector arm = own.position(v) - c;
      Vector g{};
      Sym3<double> H{};
      add_plane_friction(in, own, v, place % in.planes, moved_by(motion + kUnknowns * own.body, arm), g, H);
      rigid::add_vertex(arm, g, H, out, out + kUnknowns);
    }
  }
  // What a body's pairs of a list, and friction on planes, add to its own part of the matrix; and what the pairs add to
  // the parts between it and bodies before it.
  template <bool rubs>
  __device__ void add_pairs(int32_t b, double* of, double* gradients) const {
    const int32_t from = rubs ? lagged[b] : begin[b], to = rubs ? end[b] : lagged[b];
    const Vector c = center_of(b);
    const int lane = Warp().lane;
    double own[32] = {};
    if constexpr (rubs) add_floors(b, own);
    for (int32_t e = from + lane; e < to; e += 32) {
      const PairForce a = press_of<rubs>(rows[e] >> 1);
      const int side = rows[e] & 1;
#pragma unroll
      for (int j = 0; j < kUnknowns; ++j) {
        own[j] += a.gradient(side, j, c);
        const Vector pressed = a.stiffness * a.map(side, j, c);
#pragma unroll
        for (int i = j; i < kUnknowns; ++i) own[kUnknowns + rigid::at6(i, j)] += dot(a.map(side, i, c), pressed);
      }
    }
    put_own(sums_by_lane(own), b, of, gradients);
    for (uint64_t others = touching[b] & ((uint64_t{1} << b) - 1); from < to && others != 0; others &= others - 1) {
      const int32_t other = __ffsll(static_cast<long long>(others)) - 1, number = member(other);
      const Vector d = center_of(other);
      double most[32] = {}, rest[kUnknowns * kUnknowns - 32] = {};
      for (int32_t e = from + lane; e < to; e += 32) {
        const int32_t entry = rows[e];
        if (sides[entry ^ 1] != number) continue;
        const PairForce a = press_of<rubs>(entry >> 1);
        const int side = entry & 1;
#pragma unroll
        for (int j = 0; j < kUnknowns; ++j) {
          const Vector pressed = a.stiffness * a.map(1 - side, j, d);
#pragma unroll
          for (int i = 0; i < kUnknowns; ++i) {
            const int k = kUnknowns * i + j;
            (k < 32 ? most[k % 32] : rest[k - 32 < 0 ? 0 : k - 32]) += dot(a.map(side, i, c), pressed);
          }
        }
      }
      const double mine = sums_by_lane(most);
      at(of, b, lane / kUnknowns, other, lane % kUnknowns) += mine;
      butterfly<kUnknowns * kUnknowns - 32, 32>(kWholeWarp, rest);
#pragma unroll
      for (int k = 32; k < kUnknowns * kUnknowns; ++k) {
        if (lane == k - 32) at(of, b, k / kUnknowns, other, k % kUnknowns) += rest[k - 32];
      }
    }
  }
  template <bool rubs>
  __device__ PairForce press_of(int64_t row) const {
    if constexpr (!rubs) return load_force(press + kForceDoubles * row, sides + 2 * row);
    PairForce a = sides_of_rub(row);
    a.force = rub_vector(kForce, row);
    const auto s = [&](int k) { return rub(kStiffness + k, row); };
    a.stiffness = {s(0), s(1), s(2), s(3), s(4), s(5)};
    return a;
  }
  // A scalar, or three, of a row that rubs.
  __device__ double& rub(int k, int64_t row) const { return rubbing[k * room.lagged + row - room.listed]; }
  __device__ Vector rub_vector(int k, int64_t row) const { return {rub(k, row), rub(k + 1, row), rub(k + 2, row)}; }
  __device__ void put_rub(int k, int64_t row, const Vector& a) const {
    rub(k, row) = a.x, rub(k + 1, row) = a.y, rub(k + 2, row) = a.z;
  }
  // Where its sides are.
  __device__ PairForce sides_of_rub(int64_t row) const {
    PairForce a;
    for (int side = 0; side < 2; ++side) {
      a.body[side] = sides[2 * row + side];
      a.weight[side] = rub(kWeight + side, row), a.at[side] = rub_vector(kAt + 3 * side, row);
      a.pull[side] = a.torque[side] = Vector{};
    }
    a.doubled = 1;  // all that rub a body are of its group
    return a;
  }

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
    each_body([&](int32_t b) { add_vertices(b); });
    __syncthreads();
    each_body([&](int32_t b) { add_pairs<false>(b, base, gradient); });
    if (in.lag) {
      each_row([&](int64_t row) {
        PairForce a;
        LaggedFriction rubs;
        lagged_sides(in, row - room.listed, CornerPoints<T>{in, false}, -1, a, rubs);  // it acts, or had no row
        put_rub(kNormal, row, rubs.n), put_rub(kSlipBefore, row, rubs.u);
        rub(kLoad, row) = rubs.size, rub(kDamping, row) = rubs.damping, rub(kApproach, row) = rubs.approach;
        for (int side = 0; side < 2; ++side) {
          put_rub(kAt + 3 * side, row, a.at[side]);
          rub(kWeight + side, row) = a.weight[side];
        }
      });
    }
    __syncthreads();
  }
  // And these, linear about where bodies have gone.
  __device__ void add_friction() const {
    if (in.lag)
      each_row([&](int64_t row) {
        PairForce a = sides_of_rub(row);
        const LaggedFriction own = {rub_vector(kNormal, row), rub_vector(kSlipBefore, row), rub(kLoad, row),
                             rub(kDamping, row), rub(kApproach, row)};
        contact::lagged_friction_force(own, displacement_of(a, {center, motion}), in.friction_eps, a);
        put_rub(kForce, row, a.force), put_rub(kSlip, row, a.tangential);
        const Sym3<double>& s = a.stiffness;
        const double entries[] = {s.xx, s.xy, s.xz, s.yy, s.yz, s.zz};
        for (int k = 0; k < 6; ++k) rub(kStiffness + k, row) = entries[k];
      });
    __syncthreads();
    each_body([&](int32_t b) { add_pairs<true>(b, matrix, step); });
  }
  // Calls f(row) for the lagged pairs, each once, in a thread's share.
  template <class F>
  __device__ void each_row(const F& f) const {
    each(all_rows.y - all_rows.x, [&](int32_t i) {
      const int64_t row = rows[all_rows.x + i] >> 1;
      const int side = rows[all_rows.x + i] & 1;
      if (row >= room.listed && side == (sides[2 * row] < 0 ? 1 : 0)) f(row);
    });
  }

  // step += matrix motion
  __device__ void add_product() const {
    each(size(), [&](int32_t row) {
      double sum = 0;
      for (uint64_t blocks = touching[row / kUnknowns] | uint64_t{1} << row / kUnknowns; blocks != 0;
           blocks &= blocks - 1) {
        const int32_t first_column = kUnknowns * (__ffsll(static_cast<long long>(blocks)) - 1);
#pragma unroll
        for (int k = 0; k < kUnknowns; ++k) {
          const int32_t j = first_column + k;
          sum += matrix[j <= row ? size() * row + j : size() * j + row] * own[j];
        }
      }
      step[row] += sum;
    });
  }
  // Of the matrix, of the step and of the motion after it: half of the first is what the step lowers the potential by.
  __device__ void energies(double* total) const {
    total[0] = total[1] = 0;
    each(size(), [&](int32_t j) {
      double one = 0, whole = 0;
      const int32_t block = j / kUnknowns;
      for (uint64_t blocks = columns[block] | uint64_t{1} << block; blocks != 0; blocks &= blocks - 1) {
        const int32_t first_row = kUnknowns * (__ffsll(static_cast<long long>(blocks)) - 1);
#pragma unroll
        for (int k = 0; k < kUnknowns; ++k) {
          const int32_t i = first_row + k;
          if (i < j) continue;
          one += matrix[size() * i + j] * step[i];
          whole += matrix[size() * i + j] * (step[i] + own[i]);
        }
      }
      total[0] += one * one, total[1] += whole * whole;
    });
    reduce<2>(total);
  }
  // Calls f(line) for what slips, in a thread's share.
  template <class F>
  __device__ void each_line(const F& f) const {
    if (in.lag) {
      each_row([&](int64_t row) {
        const Vector n = rub_vector(kNormal, row), way = displacement_of(sides_of_rub(row), {center, steps});
        f(FrictionLine(rub_vector(kSlip, row), way - dot(n, way) * n, rub(kLoad, row), in.friction_eps));
      });
    }
    if (in.planes == 0) return;
    each_body([&](int32_t b) {
      const Body<T> own = body(b);
      for (auto i = static_cast<int32_t>(threadIdx.x % 32); i < borne[b]; i += 32) {
        const int32_t place = floors_of(own)[i], v = own.vertex(place / in.planes);
        const Vector arm = own.position(v) - center_of(b);
        const int64_t at = int64_t{kUnknowns} * own.body;
        f(friction_line(in, own, v, place % in.planes, arm, motion + at, steps + at));
      }
    });
  }
  __device__ double share(double fall) const {
    FrictionLine kept[kLines];
    int lines = 0;
    each_line([&](const FrictionLine& a) {
      if (lines < kLines) kept[lines] = a;
      ++lines;
    });
    return friction_fraction(fall, [&](double tried) {
      double total[1] = {0};
      for (int l = 0; l < lines && l < kLines; ++l) total[0] += kept[l].excess(tried, in.friction_eps);
      if (lines > kLines) {
        int seen = 0;
        each_line([&](const FrictionLine& line) {
          if (seen++ >= kLines) total[0] += line.excess(tried, in.friction_eps);
        });
      }
      reduce<1>(total);
      return total[0];
    });
  }

  __device__ void solve(Pivots& pivots) const {
    Settling state = kIterating;  // the same for all threads
    const bool slips = in.has_friction_in(scene);
    for (int iteration = 0; iteration < kFrictionIterations && state != kDone; ++iteration) {
      each_body([&](int32_t b) { copy_column(b); });
      each(size(), [&](int32_t i) { step[i] = gradient[i]; });
      __syncthreads();
      add_friction();
      __syncthreads();
      if (iteration > 0) add_product();
      __syncthreads();
      factor_blocks<kTeam>(count, columns, matrix, step, pivots);
      const auto inverses = Inverses::within(count, matrix, pivots.inverse);
      invert_pivots<kTeam>(count, matrix, inverses);
      solve_backward<kTeam>(count, matrix, inverses, step);
      each(count, [&](int32_t b) { keep_finite(step + kUnknowns * b); });
      __syncthreads();
      each(size(), [&](int32_t i) { unknown(steps, i) = step[i]; });
      __syncthreads();
      double of[2] = {0, 0};
      if (slips) energies(of);
      const double taken = settle(state, slips, of[0], of[1], [&](double fall) { return share(fall); });
      each(size(), [&](int32_t i) { unknown(motion, i) = own[i] += taken * step[i]; });
      __syncthreads();
    }
  }
};

}  // namespace
}  // namespace diffvbd::cuda
