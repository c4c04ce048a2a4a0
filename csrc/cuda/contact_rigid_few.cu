// Rigid correction of small groups of bodies: all of Newton's method in one launch, a block for each group.
#include "../subspace/contact_rigid.h"
#include "cholesky.cuh"
#include "cluster.cuh"
#include "common.cuh"
#include "contact_rigid_rows.cuh"

namespace diffvbd::cuda {
namespace {

constexpr int kSlots = 2, kLineDoubles = 6;  // tangential motions that a thread stores during a line search
constexpr int kOwn = kUnknowns + rigid::kSix, kHalf = 3 * kUnknowns;
constexpr int kSmall = kUnknowns * kFew;  // unknowns whose system fits into shared memory

// Newton system of a group.
template <class T>
struct System {
  const RigidInputs<T>& in;
  const BlockTeam& team;
  int64_t scene;
  Groups groups;
  int32_t first, count;
  double *center, *motion, *steps;  // of the scene's bodies
  double *base, *matrix, *gradient, *step;
  const GroupRows<T>& rows;
  const int32_t (*ranges)[3];  // [count] begin of the rows of a body, of its lagged rows, and end
  uint8_t* touching;           // [count, count]
  Pivots& pivots;
  double (*slots)[kLineDoubles][kThreads];

  __device__ int32_t member(int32_t b) const { return groups.member(first + b); }
  __device__ Body<T> body(int32_t b) const { return {in.scene, scene, member(b)}; }
  __device__ int32_t size() const { return kUnknowns * count; }
  template <class F>
  __device__ void each_body(const F& f) const {
    each_body_of(count, team, [&](int32_t b) { return body(b).size(); }, f);
  }
  __device__ Vector center_of(int32_t b) const { return vector_of(center + 3 * member(b)); }
  __device__ double* motion_of(int32_t b) const { return motion + kUnknowns * member(b); }
  __device__ double& unknown(double* of, int32_t i) const {  // of the scene's bodies
    return of[kUnknowns * member(i / kUnknowns) + i % kUnknowns];
  }
  __device__ double& at(double* of, int32_t b, int i, int32_t c, int j) const {
    return of[size() * (kUnknowns * b + i) + kUnknowns * c + j];
  }

  // Begin and number of the rows of body b.
  template <class Forces>
  __device__ int2 rows_of(const Forces&, int32_t b) const {
    const int32_t from = ranges[b][Forces::lagged ? 1 : 0];
    return {from, ranges[b][Forces::lagged ? 2 : 1] - from};
  }

  // Contribution of a row to the gradient of body b and to its diagonal block.
  template <class Forces>
  __device__ void add_own(const Forces& forces, int32_t b, int32_t entry, double* out) const {
    const Vector c = center_of(b);
    const int side = entry & 1;
    const PairForce a = forces(entry >> 1, side);
    const double share = borne(in, scene, a);
#pragma unroll
    for (int j = 0; j < kUnknowns; ++j) {
      out[j] += a.gradient(side, j, c);
      const Vector force = share * (a.stiffness * a.map(side, j, c));
#pragma unroll
      for (int i = j; i < kUnknowns; ++i) out[kUnknowns + rigid::at6(i, j)] += dot(a.map(side, i, c), force);
    }
  }
  // Number that a thread stores. Chosen by comparison, which keeps the array in registers.
  template <int n>
  __device__ static double own_of(const double* total, int thread = static_cast<int>(threadIdx.x)) {
    double out = 0;
#pragma unroll
    for (int k = 0; k < n; ++k) out = thread == k ? total[k] : out;
    return out;
  }
  // Adds the sums of a team, one number by each of its first threads.
  __device__ void put_own(const double* total, int32_t b, double* to, double* gradients,
                          int thread = static_cast<int>(threadIdx.x)) const {
    const double value = own_of<kOwn>(total, thread);
    const int entry = thread - kUnknowns;
    if (entry < 0) gradients[kUnknowns * b + thread] += value;
    if (entry < 0 || rigid::kSix <= entry) return;
    int i = 0;
    while (rigid::at6(i + 1, 0) <= entry) ++i;
    const int j = entry - rigid::at6(i, 0);
    at(to, b, i, b, j) += value;
    if (j < i) at(to, b, j, b, i) += value;
  }
  // Contribution to the block of two bodies, half of its rows at a time.
  template <class Forces>
  __device__ void add_between(const Forces& forces, double* to) const {
    for (int32_t b = 0; b < count; ++b) {
      for (int32_t other = b + 1; other < count; ++other) {
        if (!touching[count * b + other]) continue;
        const Vector c = center_of(b), d = center_of(other);
        for (int half = 0; half < 2; ++half) {
          double total[kHalf];
          const int2 range = rows_of(forces, b);
          team.template sum<kHalf>(range.y, total, [&](int32_t e, double* out) {
            const int32_t entry = rows.memory.rows[range.x + e];
            if (rows.memory.sides[entry ^ 1] != member(other)) return;
            const int side = entry & 1;
            const PairForce a = forces(entry >> 1, side);
#pragma unroll
            for (int j = 0; j < kUnknowns; ++j) {
              const Vector force = a.stiffness * a.map(1 - side, j, d);
#pragma unroll
              for (int i = 0; i < 3; ++i) out[kUnknowns * i + j] += dot(a.map(side, 3 * half + i, c), force);
            }
          });
          const double value = own_of<kHalf>(total);
          if (threadIdx.x >= kHalf) continue;
          const int i = 3 * half + static_cast<int>(threadIdx.x) / kUnknowns, j = threadIdx.x % kUnknowns;
          at(to, b, i, other, j) += value, at(to, other, j, b, i) += value;
        }
      }
    }
  }

  // Center of a body, forces on its vertices except friction, and the regularization of its diagonal block.
  template <class By>
  __device__ void add_vertices(int32_t b, const By& by) const {
    const Body<T> own = body(b);
    const Whole whole = whole_of(own, by);
    if (by.leads()) diffvbd::put(center + 3 * own.body, whole.center);
    const bool free = in.free[own.body] && 0 < whole.mass;
    double total[kOwn + 1];  // and the sum of m r^2
    by.template sum<kOwn + 1>(free ? own.size() : 0, total, [&](int32_t i, double* out) {
      const int32_t v = own.vertex(i);
      Vector g;
      Sym3<double> H;
      vertex_force(in, own, v, g, H);
      const Vector arm = own.position(v) - whole.center;
      rigid::add_vertex(arm, g, H, out, out + kUnknowns);
      out[kOwn] += own.mass(v) * dot(arm, arm);
    });
#pragma unroll
    for (int i = 0; i < kUnknowns; ++i) {
      total[kUnknowns + rigid::at6(i, i)] += !free ? 1 : i < 3 ? kLeastInertia * total[kOwn] : 0;
    }
    put_own(total, b, base, gradient, by.number());
  }
  // Terms that do not change as bodies move: all but friction and damping.
  __device__ void assemble(const BarrierForces<T>& barriers) const {
    team.each(size() * size(), [&](int32_t i) { base[i] = 0; });
    team.each(size(), [&](int32_t i) { gradient[i] = 0; });
    team.meet();
    each_body([&](int32_t b, const auto& by) { add_vertices(b, by); });
    team.meet();
    for (int32_t b = 0; b < count; ++b) {
      const int2 range = rows_of(barriers, b);
      if (range.y == 0) continue;
      double total[kOwn];
      team.template sum<kOwn>(
          range.y, total, [&](int32_t e, double* out) { add_own(barriers, b, rows.memory.rows[range.x + e], out); });
      put_own(total, b, base, gradient);
    }
    team.meet();
    add_between(barriers, base);
    team.meet();
  }
  // Friction and damping, linearized about the current motion.
  __device__ void add_friction(const LaggedForces<T>& friction) const {
    if (!in.lag && in.planes == 0) return;
    for (int32_t b = 0; b < count; ++b) {
      const Body<T> own = body(b);
      if (!in.free[own.body]) continue;
      const Vector c = center_of(b);
      double total[kOwn];
      const int2 range = rows_of(friction, b);
      const int32_t borne = in.planes > 0 ? own.size() : 0;
      if (borne + range.y == 0) continue;
      team.template sum<kOwn>(borne + range.y, total, [&](int32_t item, double* out) {
        if (item >= borne) return add_own(friction, b, rows.memory.rows[range.x + item - borne], out);
        const int32_t v = own.vertex(item);
        bool any = false;
        for (int k = 0; k < in.planes; ++k) any = bears(in, own, v, k) || any;
        if (!any) return;
        const Vector arm = own.position(v) - c;
        Vector g{};
        Sym3<double> H{};
        add_floor_friction(in, own, v, moved_by(motion_of(b), arm), g, H);
        rigid::add_vertex(arm, g, H, out, out + kUnknowns);
      });
      put_own(total, b, matrix, step);
    }
    if (in.lag) add_between(friction, matrix);
    team.meet();
  }

  // Energy norms of the step and of the motion after it; half of the first is the expected decrease.
  __device__ void energies(double* total) const {
    team.template sum<2>(size(), total, [&](int32_t j, double* out) {
      double one = 0, whole = 0;
      for (int32_t i = j; i < size(); ++i) {
        one += matrix[size() * i + j] * step[i];
        whole += matrix[size() * i + j] * (step[i] + unknown(motion, i));
      }
      out[0] += one * one, out[1] += whole * whole;
    });
  }
  // Calls f(line) for the tangential motions of a thread.
  template <class F>
  __device__ void each_line(const LaggedForces<T>& friction, const F& f) const {
    for (int32_t b = 0; b < count; ++b) {
      const Body<T> own = body(b);
      if (!in.free[own.body]) continue;
      const int2 range = rows_of(friction, b);
      team.each(range.y, [&](int32_t e) {
        const int32_t entry = rows.memory.rows[range.x + e];
        const PairForce a = friction(entry >> 1, entry & 1);
        if ((entry & 1) == (a.body[0] < 0 ? 1 : 0))
          f(friction_line(in, (entry >> 1) - friction.listed, a, center, steps));  // once
      });
      team.each(own.size() * in.planes, [&](int32_t i) {
        const int32_t v = own.vertex(i / in.planes), k = i % in.planes;
        if (!bears(in, own, v, k)) return;
        const Vector arm = own.position(v) - center_of(b);
        f(friction_line(in, own, v, k, arm, motion_of(b), step + kUnknowns * b));
      });
    }
  }
  // Number of lines of a thread; the first ones are stored in its slots.
  __device__ int keep_lines(const LaggedForces<T>& friction) const {
    int lines = 0;
    each_line(friction, [&](const FrictionLine& a) {
      const double values[] = {a.start, a.along, a.step_square, a.size, a.rate, a.bend};
      for (int i = 0; lines < kSlots && i < kLineDoubles; ++i) slots[lines][i][threadIdx.x] = values[i];
      ++lines;
    });
    return lines;
  }
  __device__ double share(const LaggedForces<T>& friction, double fall) const {
    const int lines = keep_lines(friction);
    return friction_fraction(fall, [&](double tried) {
      double total[1] = {0};
      for (int l = 0; l < lines && l < kSlots; ++l) {
        const auto at = [&](int i) { return slots[l][i][threadIdx.x]; };
        FrictionLine line;
        line.start = at(0), line.along = at(1), line.step_square = at(2), line.size = at(3), line.rate = at(4),
        line.bend = at(5);
        total[0] += line.excess(tried, in.friction_eps);
      }
      if (lines > kSlots) {
        int seen = 0;
        each_line(friction, [&](const FrictionLine& line) {
          if (seen++ >= kSlots) total[0] += line.excess(tried, in.friction_eps);
        });
      }
      team.template reduce<1>(total);
      return total[0];
    });
  }

  __device__ void solve(const LaggedForces<T>& friction) const {
    Settling state = kIterating;  // the same for all threads
    const bool has_friction = in.has_friction_in(scene);
    for (int iteration = 0; iteration < kFrictionIterations && state != kDone; ++iteration) {
      team.each(size() * size(), [&](int32_t i) { matrix[i] = base[i]; });
      team.each(size(), [&](int32_t i) { step[i] = gradient[i]; });
      team.meet();
      add_friction(friction);
      if (iteration > 0) {
        team.each(size(), [&](int32_t i) {
          for (int32_t j = 0; j < size(); ++j) step[i] += matrix[size() * i + j] * unknown(motion, j);
        });
        team.meet();
      }
      factor_blocks<kThreads>(count, nullptr, matrix, step, pivots);
      const auto inverses = Inverses::within(count, matrix, pivots.inverse);
      invert_pivots<kThreads>(count, matrix, inverses);
      solve_backward<kThreads>(count, matrix, inverses, step);
      team.each(count, [&](int32_t b) { keep_finite(step + kUnknowns * b); });
      team.meet();
      team.each(size(), [&](int32_t i) { unknown(steps, i) = step[i]; });
      team.meet();
      double of[2] = {0, 0};
      if (has_friction) energies(of);
      const double taken =
          settle(state, has_friction, of[0], of[1], [&](double fall) { return share(friction, fall); });
      team.each(size(), [&](int32_t i) { unknown(motion, i) += taken * step[i]; });
      team.meet();
    }
  }
};

// A block for each place where a group may begin.
template <class T>
__global__ void __launch_bounds__(kThreads) few_kernel(const __grid_constant__ RigidInputs<T> in, PairCapacity capacity,
                                                       const __grid_constant__ GroupMemory memory, bool lists,
                                                       double* center, double* motion, double* factors) {
  __shared__ double part[kWarps][kMostSums];
  __shared__ uint8_t touching[kFew * kFew];
  __shared__ int32_t ranges[kFew][3];
  __shared__ Pivots pivots;
  __shared__ double slots[kSlots][kLineDoubles][kThreads];
  __shared__ double matrices[2][kSmall * kSmall], vectors[2][kSmall];
  const BlockTeam team{part};
  const int32_t n = in.bodies(), places = in.together() ? 1 : n;
  const int64_t scene = blockIdx.x / places;
  const auto first = static_cast<int32_t>(blockIdx.x % places);
  const Groups groups = in.groups_of(scene);
  const int32_t count = groups.count(first), size = kUnknowns * count;
  if (count == 0 || (kFew < count && count <= in.capacity)) return;
  double* factor = factors + in.matrix_size() * scene + groups.matrix(first);
  const GroupRows<T> rows{in, capacity, memory, scene, groups, first, count};
  const System<T> system{in,
                         team,
                         scene,
                         groups,
                         first,
                         count,
                         center + 3 * n * scene,
                         motion + kUnknowns * n * scene,
                         memory.steps + kUnknowns * n * scene,
                         matrices[0],
                         matrices[1],
                         vectors[0],
                         vectors[1],
                         rows,
                         ranges,
                         touching,
                         pivots,
                         slots};
  team.each(size, [&](int32_t i) { system.unknown(system.motion, i) = 0; });
  if (!in.moves(scene, groups, first)) {
    const auto find_center = [&](int32_t b, const auto& by) {
      const Whole whole = whole_of(system.body(b), by);
      if (by.leads()) diffvbd::put(system.center + 3 * system.member(b), whole.center);
    };
    system.each_body(find_center);
    if (threadIdx.x == 0) *factor = CUDART_NAN;  // solving with it gives NaN
    return;
  }
  team.each(count * count, [&](int32_t i) { touching[i] = 0; });
  if (lists) list_rows(in, capacity, memory, team, scene);
  team.meet();
  const BarrierForces<T> barriers{memory.sides, memory.forces};
  const LaggedForces<T> friction{in, capacity.listed, {system.center, system.motion}};
  rows.template sort<kThreads>([&](int32_t body, int32_t other) {
    if (groups.first(other) == first) touching[count * groups.rank(body) + groups.rank(other)] = 1;
  });
  team.each(3 * count, [&](int32_t i) {
    const int32_t body = groups.member(first + i / 3);
    ranges[i / 3][i % 3] = i % 3 == 0 ? rows.begin(body) : i % 3 == 1 ? rows.lagged(body) : rows.end(body);
  });
  team.meet();
  system.assemble(barriers);
  system.solve(friction);
  team.each(size * size, [&](int32_t i) { factor[i] = system.matrix[i]; });
  if (!in.moving || !in.together()) return;
  bool moves[kFew];
  find_moving(count, in.moving + n * scene, touching, moves);
  team.each(size, [&](int32_t i) {
    if (!moves[i / kUnknowns]) system.unknown(system.motion, i) = 0;
  });
}

}  // namespace

template <class T>
cudaError_t solve_few(const RigidInputs<T>& in, const PairCapacity& capacity, const GroupMemory& memory, bool lists,
                      double* center, double* motion, double* factors, cudaStream_t stream) {
  const auto blocks = static_cast<unsigned>(in.scene.scenes * (in.together() ? 1 : in.bodies()));
  few_kernel<T><<<blocks, kThreads, 0, stream>>>(in, capacity, memory, lists, center, motion, factors);
  return cudaGetLastError();
}

DIFFVBD_INSTANTIATE(solve_few)

}  // namespace diffvbd::cuda
