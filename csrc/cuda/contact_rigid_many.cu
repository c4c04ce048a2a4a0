// Rigid correction of large groups of bodies: all of Newton's method in one launch, a block for each group and a warp
// for each of its bodies in turn.
#include "cholesky.cuh"
#include "common.cuh"
#include "contact_rigid_rows.cuh"

namespace diffvbd::cuda {
namespace {

constexpr int kTeam = 256, kTeamWarps = kTeam / 32;
constexpr int kOwn = kUnknowns + rigid::kSix;
constexpr int kLines = 4;  // tangential motions that a thread stores during a line search
constexpr int kMostUnknowns = kUnknowns * kMostCoupled;
constexpr int64_t kShared = 16;    // bodies whose matrix is in shared memory where there are many groups
constexpr int kStatic = 16 << 10;  // bytes of static shared memory, at most

using Warp = Tile<32>;

// Newton system of a group.
template <class T>
struct GroupSystem {
  const RigidInputs<T>& in;
  PairCapacity capacity;
  int64_t scene;
  Groups groups;
  int32_t first, count;
  const int32_t* sides;
  double *center, *motion, *steps, *forces;       // of the scene's bodies; of all rows
  double* friction_rows;                          // [kFrictionScalars, lagged rows]
  int32_t* floors;                                // of the scene, as of GroupMemory
  double *base, *matrix, *gradient, *step, *own;  // own: the motion of the group
  const uint64_t* touching;                       // [count] bit set of the bodies that a body touches
  const uint64_t* columns;  // [count] bit set of the nonzero blocks of the factor below the diagonal
  const int32_t* rows;      // as of GroupMemory
  const int32_t* begin;     // [count] begin of the rows of a body,
  const int32_t* lagged;    // [count] of its lagged rows,
  const int32_t* end;       // [count] and end
  int32_t* borne;           // [count] contacts of a body's vertices with planes
  double (*part)[2];
  int2 all_rows;  // begin and end of the rows of all bodies

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
  __device__ void each_body(const F& f) const {  // a warp each
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

  // A group that does not move: no motion, no factor.
  __device__ void stay(double* factor) const {
    each(size(), [&](int32_t i) { unknown(motion, i) = 0; });
    each_body([&](int32_t b) {
      const Whole whole = whole_of(body(b), Warp());
      if (Warp().leads()) diffvbd::put(center + 3 * member(b), whole.center);
    });
    if (threadIdx.x == 0) *factor = CUDART_NAN;  // solving with it gives NaN
  }
  // Adds to the gradient and the diagonal block of a body; each lane has one entry.
  __device__ void put_own(double mine, int32_t b, double* to, double* gradients) const {
    const int32_t entry = Warp().lane - kUnknowns;
    if (entry < 0) gradients[kUnknowns * b + entry + kUnknowns] += mine;
    if (entry < 0 || rigid::kSix <= entry) return;
    int i = 0;
    while (rigid::at6(i + 1, 0) <= entry) ++i;
    at(to, b, i, b, entry - rigid::at6(i, 0)) += mine;
  }
  // Gradient and matrix of vertices except friction, and contacts with planes.
  __device__ void add_vertices(int32_t b) const {
    const Body<T> own = body(b);
    const Warp warp;
    const Whole whole = whole_of(own, warp);
    if (warp.leads()) diffvbd::put(center + 3 * own.body, whole.center);
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
      const double inertia = warp.lane < 3 ? kLeastInertia * turning : 0;
      at(base, b, warp.lane, b, warp.lane) += free ? inertia : 1;
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
  // Friction on planes, linearized about the current motion.
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
  // Contribution of a body's pairs of a list, and of friction on planes, to its diagonal block; and of the pairs to the
  // blocks with earlier bodies.
  template <bool lagged_rows>
  __device__ void add_pairs(int32_t b, double* of, double* gradients) const {
    const int32_t from = lagged_rows ? lagged[b] : begin[b], to = lagged_rows ? end[b] : lagged[b];
    const Vector c = center_of(b);
    const int lane = Warp().lane;
    double own[32] = {};
    if constexpr (lagged_rows) add_floors(b, own);
    for (int32_t e = from + lane; e < to; e += 32) {
      const PairForce a = force_of<lagged_rows>(rows[e] >> 1);
      const int side = rows[e] & 1;
#pragma unroll
      for (int j = 0; j < kUnknowns; ++j) {
        own[j] += a.gradient(side, j, c);
        const Vector force = a.stiffness * a.map(side, j, c);
#pragma unroll
        for (int i = j; i < kUnknowns; ++i) own[kUnknowns + rigid::at6(i, j)] += dot(a.map(side, i, c), force);
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
        const PairForce a = force_of<lagged_rows>(entry >> 1);
        const int side = entry & 1;
#pragma unroll
        for (int j = 0; j < kUnknowns; ++j) {
          const Vector force = a.stiffness * a.map(1 - side, j, d);
#pragma unroll
          for (int i = 0; i < kUnknowns; ++i) {
            const int k = kUnknowns * i + j;
            (k < 32 ? most[k % 32] : rest[k - 32 < 0 ? 0 : k - 32]) += dot(a.map(side, i, c), force);
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
  template <bool lagged_rows>
  __device__ PairForce force_of(int64_t row) const {
    if constexpr (!lagged_rows) return load_force(forces + kForceDoubles * row, sides + 2 * row);
    PairForce a = friction_sides(row);
    a.force = friction_vector(kForce, row);
    const auto s = [&](int k) { return friction(kStiffness + k, row); };
    a.stiffness = {s(0), s(1), s(2), s(3), s(4), s(5)};
    return a;
  }
  // Scalar or vector of a lagged pair.
  __device__ double& friction(int k, int64_t row) const {
    return friction_rows[k * capacity.lagged + row - capacity.listed];
  }
  __device__ Vector friction_vector(int k, int64_t row) const {
    return {friction(k, row), friction(k + 1, row), friction(k + 2, row)};
  }
  __device__ void put_friction(int k, int64_t row, const Vector& a) const {
    friction(k, row) = a.x, friction(k + 1, row) = a.y, friction(k + 2, row) = a.z;
  }
  // Sides of a lagged pair.
  __device__ PairForce friction_sides(int64_t row) const {
    PairForce a;
    for (int side = 0; side < 2; ++side) {
      a.body[side] = sides[2 * row + side];
      a.weight[side] = friction(kWeight + side, row), a.at[side] = friction_vector(kAt + 3 * side, row);
      a.pull[side] = a.torque[side] = Vector{};
    }
    a.doubled = 1;  // all lagged pairs of a body are in its group
    return a;
  }

  // Copies the nonzero blocks of a column of the constant matrix.
  __device__ void copy_column(int32_t b) const {
    for (uint64_t blocks = columns[b] | uint64_t{1} << b; blocks != 0; blocks &= blocks - 1) {
      const int32_t row = __ffsll(static_cast<long long>(blocks)) - 1;
      for (int k = static_cast<int>(threadIdx.x % 32); k < kUnknowns * kUnknowns; k += 32) {
        at(matrix, row, k / kUnknowns, b, k % kUnknowns) = at(base, row, k / kUnknowns, b, k % kUnknowns);
      }
    }
  }

  // Terms that do not change as bodies move: all but friction and damping.
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
        LaggedFriction load;
        lagged_sides(in, row - capacity.listed, CornerPoints<T>{in, false}, -1, a,
                     load);  // rows exist only for pairs that act
        put_friction(kNormal, row, load.n), put_friction(kTangentialBefore, row, load.u);
        friction(kLoad, row) = load.size, friction(kDamping, row) = load.damping,
                        friction(kApproach, row) = load.approach;
        for (int side = 0; side < 2; ++side) {
          put_friction(kAt + 3 * side, row, a.at[side]);
          friction(kWeight + side, row) = a.weight[side];
        }
      });
    }
    __syncthreads();
  }
  // Friction and damping, linearized about the current motion.
  __device__ void add_friction() const {
    if (in.lag)
      each_row([&](int64_t row) {
        PairForce a = friction_sides(row);
        const LaggedFriction own = {friction_vector(kNormal, row), friction_vector(kTangentialBefore, row),
                                    friction(kLoad, row), friction(kDamping, row), friction(kApproach, row)};
        contact::lagged_friction_force(own, displacement_of(a, {center, motion}), in.friction_eps, a);
        put_friction(kForce, row, a.force), put_friction(kTangential, row, a.tangential);
        const Sym3<double>& s = a.stiffness;
        const double entries[] = {s.xx, s.xy, s.xz, s.yy, s.yz, s.zz};
        for (int k = 0; k < 6; ++k) friction(kStiffness + k, row) = entries[k];
      });
    __syncthreads();
    each_body([&](int32_t b) { add_pairs<true>(b, matrix, step); });
  }
  // Calls f(row) for the lagged pairs of a thread, each once.
  template <class F>
  __device__ void each_row(const F& f) const {
    each(all_rows.y - all_rows.x, [&](int32_t i) {
      const int64_t row = rows[all_rows.x + i] >> 1;
      const int side = rows[all_rows.x + i] & 1;
      if (row >= capacity.listed && side == (sides[2 * row] < 0 ? 1 : 0)) f(row);
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
  // Energy norms of the step and of the motion after it; half of the first is the expected decrease.
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
  // Calls f(line) for the tangential motions of a thread.
  template <class F>
  __device__ void each_line(const F& f) const {
    if (in.lag) {
      each_row([&](int64_t row) {
        const Vector n = friction_vector(kNormal, row), way = displacement_of(friction_sides(row), {center, steps});
        f(FrictionLine(friction_vector(kTangential, row), way - dot(n, way) * n, friction(kLoad, row),
                       in.friction_eps));
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
    const bool has_friction = in.has_friction_in(scene);
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
      if (has_friction) energies(of);
      const double taken = settle(state, has_friction, of[0], of[1], [&](double fall) { return share(fall); });
      each(size(), [&](int32_t i) { unknown(motion, i) = own[i] += taken * step[i]; });
      __syncthreads();
    }
  }
};

// Shared memory of a group.
struct Lists {
  int32_t begin[kMostCoupled], lagged[kMostCoupled], end[kMostCoupled], borne[kMostCoupled];  // as of GroupSystem
  int32_t place[kMostCoupled], member[kMostCoupled];
  uint64_t touching[kMostCoupled], columns[kMostCoupled];  // as of GroupSystem
};

// Minimum-degree order of elimination, by a warp: next is the body that touches the fewest remaining ones, which then
// touch one another. A lane keeps the neighbours of two bodies.
__device__ void find_order(int32_t count, Lists& lists) {
  const int lane = static_cast<int>(threadIdx.x % 32);
  uint64_t own[2], left = count < 64 ? (uint64_t{1} << count) - 1 : ~uint64_t{0};
  for (int h = 0; h < 2; ++h) own[h] = lane + 32 * h < count ? lists.touching[lane + 32 * h] : 0;
  const uint64_t before[2] = {own[0], own[1]};
  for (int32_t step = 0; step < count; ++step) {
    unsigned least = ~0u;
    for (int h = 0; h < 2; ++h) {
      const int k = lane + 32 * h;
      if (left >> k & 1) least = min(least, static_cast<unsigned>(64 * __popcll(own[h] & left) + k));
    }
    for (int d = 16; d > 0; d /= 2) least = min(least, __shfl_xor_sync(kWholeWarp, least, d));
    const int next = static_cast<int>(least % 64);
    left &= ~(uint64_t{1} << next);
    const uint64_t rest = left & __shfl_sync(kWholeWarp, next < 32 ? own[0] : own[1], next % 32);
    for (int h = 0; h < 2; ++h) {
      const int k = lane + 32 * h;
      if (rest >> k & 1) own[h] |= rest & ~(uint64_t{1} << k);
    }
    if (lane == 0) lists.place[next] = step, lists.columns[step] = rest;
  }
  __syncwarp();
  // bit sets by number become bit sets by place
  const auto by_place = [&](uint64_t bits) {
    uint64_t out = 0;
    for (; bits != 0; bits &= bits - 1) out |= uint64_t{1} << lists.place[__ffsll(static_cast<long long>(bits)) - 1];
    return out;
  };
  for (int32_t k = lane; k < count; k += 32) lists.columns[k] = by_place(lists.columns[k]);
  for (int h = 0; h < 2; ++h) {
    if (lane + 32 * h < count) lists.touching[lists.place[lane + 32 * h]] = by_place(before[h]);
  }
}

// Sorts the rows of a group and orders its bodies for elimination.
template <class T>
__device__ void find_order(const GroupSystem<T>& system, const GroupRows<T>& rows, int32_t* ordered, Lists& lists) {
  const int32_t count = system.count, n = system.groups.bodies;
  system.each(count, [&](int32_t b) { lists.touching[b] = 0, lists.member[b] = system.member(b); });
  __syncthreads();
  rows.template sort<kTeam>([&](int32_t body, int32_t other) {
    atomicOr(reinterpret_cast<unsigned long long*>(lists.touching + system.groups.rank(body)),
             1ull << system.groups.rank(other));
  });
  __syncthreads();
  if (threadIdx.x < 32) find_order(count, lists);
  __syncthreads();
  system.each(count, [&](int32_t b) {
    const int32_t place = lists.place[b], body = lists.member[b];
    ordered[system.first + place] = body, ordered[2 * n + body] = place;
    lists.begin[place] = rows.begin(body), lists.lagged[place] = rows.lagged(body), lists.end[place] = rows.end(body);
  });
  __syncthreads();
}

// fits: unknowns whose matrix fits into dynamic shared memory.
template <class T>
__global__ void __launch_bounds__(kTeam) groups_kernel(const __grid_constant__ RigidInputs<T> in, PairCapacity capacity,
                                                       const __grid_constant__ GroupMemory memory, int32_t* ordered,
                                                       double* center, double* motion, double* factors, int32_t fits) {
  __shared__ double part[kTeamWarps][2], vectors[3][kMostUnknowns];
  __shared__ Lists lists;
  __shared__ Pivots pivots;
  static_assert(sizeof(part) + sizeof(vectors) + sizeof(lists) + sizeof(pivots) + sizeof(GroupSystem<T>) <= kStatic);
  extern __shared__ double matrix[];
  const int32_t n = in.bodies();
  const int64_t scene = blockIdx.x / n;
  const auto first = static_cast<int32_t>(blockIdx.x % n);
  const Groups groups = in.groups_of(scene);
  const int32_t count = groups.count(first), size = kUnknowns * count;
  if (count <= kFew || count > in.capacity) return;
  const int64_t at = in.matrix_size() * scene + groups.matrix(first);
  const GroupRows<T> rows{in, capacity, memory, scene, groups, first, count};
  // in shared memory for lack of registers
  alignas(GroupSystem<T>) __shared__ unsigned char bytes[sizeof(GroupSystem<T>)];
  if (threadIdx.x == 0) {
    new (bytes) GroupSystem<T>{in,
                               capacity,
                               scene,
                               groups,
                               first,
                               count,
                               memory.sides,
                               center + 3 * n * scene,
                               motion + kUnknowns * n * scene,
                               memory.steps + kUnknowns * n * scene,
                               memory.forces,
                               memory.friction,
                               memory.floors + scene * in.scene.vertices * in.planes,
                               memory.bases + at,
                               size <= fits ? matrix : factors + at,
                               vectors[0],
                               vectors[1],
                               vectors[2],
                               lists.touching,
                               lists.columns,
                               memory.rows,
                               lists.begin,
                               lists.lagged,
                               lists.end,
                               lists.borne,
                               part,
                               rows.all()};
  }
  __syncthreads();
  const auto& system = *reinterpret_cast<const GroupSystem<T>*>(bytes);
  if (!in.moves(scene, groups, first)) return system.stay(factors + at);
  find_order(system, rows, ordered + int64_t{kGroupRows} * n * scene, lists);
  system.assemble();
  system.solve(pivots);
  if (size <= fits) system.each(size * size, [&](int32_t i) { factors[at + i] = matrix[i]; });
}

}  // namespace

template <class T>
cudaError_t solve_groups_of_many(const RigidInputs<T>& in, const PairCapacity& capacity, const GroupMemory& memory,
                                 int32_t* ordered, double* center, double* motion, double* factors,
                                 cudaStream_t stream) {
  int device = 0, room_for = 0, processors = 0;
  if (auto error = cudaGetDevice(&device)) return error;
  if (auto error = cudaDeviceGetAttribute(&room_for, cudaDevAttrMaxSharedMemoryPerBlockOptin, device)) return error;
  if (auto error = cudaDeviceGetAttribute(&processors, cudaDevAttrMultiProcessorCount, device)) return error;
  const int64_t largest = most_grouped(in.bodies());
  const auto blocks = static_cast<unsigned>(in.scene.scenes * in.bodies());
  // with many groups a multiprocessor runs several blocks at once
  const int64_t most_shared = blocks > 2 * processors ? kShared : kMostCoupled;
  auto unknowns = static_cast<int32_t>(kUnknowns * (largest < most_shared ? largest : most_shared));
  const auto bytes_of = [](int32_t n) { return static_cast<int>(n * n * sizeof(double)); };
  while (unknowns > 0 && bytes_of(unknowns) + kStatic > room_for) unknowns -= kUnknowns;
  // the same value for all launches: other threads may launch concurrently
  const auto most = cudaFuncAttributeMaxDynamicSharedMemorySize;
  if (auto error = cudaFuncSetAttribute(groups_kernel<T>, most, room_for - kStatic)) return error;
  groups_kernel<T>
      <<<blocks, kTeam, bytes_of(unknowns), stream>>>(in, capacity, memory, ordered, center, motion, factors, unknowns);
  return cudaGetLastError();
}

DIFFVBD_INSTANTIATE(solve_groups_of_many)

}  // namespace diffvbd::cuda
