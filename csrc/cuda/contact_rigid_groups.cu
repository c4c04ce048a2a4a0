// The rigid correction where more than a few bodies are solved for together: all of Newton's method in one launch, a
// block for each group, a warp for each of its bodies in turn.
#include "cholesky.cuh"
#include "contact_rigid_presses.cuh"

namespace diffvbd::cuda {
namespace {

constexpr unsigned kAll = 0xffffffffu;
constexpr int kTeam = kGroupThreads, kTeamWarps = kTeam / 32;
constexpr int kOwn = kUnknowns + rigid::kSix,
              kLines = 2;  // slips that a thread keeps while a step looks for its length
constexpr int kMostUnknowns = kUnknowns * kMostCoupled;
constexpr int64_t kShared = 16;    // bodies up to which their matrix is in shared memory, where there are many groups
constexpr int kStatic = 12 << 10;  // bytes of shared memory beside the matrix, and some more

struct Warp {
  int lane = static_cast<int>(threadIdx.x % 32);
  __device__ bool leads() const { return lane == 0; }
  __device__ void meet() const { __syncwarp(); }
  template <int n, class F>
  __device__ void sum(int32_t count, double* out, const F& f) const {
    own_sum<n>(lane, count, 32, out, f);
    butterfly<n, 32>(kAll, out);
  }
};

// The system of a group.
template <class T>
struct GroupSystem {
  const RigidInputs<T>& in;
  PairRoom room;
  int64_t scene;
  Groups groups;
  int32_t first, count;
  const int32_t* sides;
  double *center, *motion, *steps, *press;  // of the scene's bodies; of all rows
  double *base, *matrix, *gradient, *step;
  int32_t* rows;          // twice the row of a pair, and its side: those of each body
  const int32_t* begin;   // [count + 1] where they begin, and
  const int32_t* lagged;  // [count] those of lagged pairs
  double (*part)[kShares];

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
    const Body<T> own = body(b);
    for (int32_t i = 0; i < own.size(); ++i) {
      const int64_t corner = scene * in.gate.corners + own.vertex(i);
      for (int32_t from = list.ptr[corner]; from < list.ptr[corner + 1]; from += 32) {
        const int32_t mine = from + static_cast<int32_t>(threadIdx.x % 32);
        const int32_t entry = mine < list.ptr[corner + 1] ? list.entry[mine] : 3;
        f(before + (entry >> 2), side_of(list, sides + 2 * before, entry, own.body));
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
  // Of the pairs in a part of the rows of a body. Each lane has one number of what they add to its own part of the
  // matrix, and two of what they add to that between it and a body before it.
  __device__ void add_pairs(int32_t b, int32_t from, int32_t to, double* of, double* gradients) const {
    const int lane = static_cast<int>(threadIdx.x % 32);
    int i = 0, j = 0;
    while (kUnknowns <= lane && rigid::at6(i + 1, 0) <= lane - kUnknowns) ++i;
    if (kUnknowns <= lane) j = lane - kUnknowns - rigid::at6(i, 0);
    const Vector c = center_of(b);
    double own = 0;
    for (int32_t e = from; e < to; ++e) {
      const int64_t row = rows[e] >> 1;
      const int side = rows[e] & 1;
      const PairPress a = load_press(press + kPressDoubles * row, sides + 2 * row);
      if (lane < kUnknowns) {
        own += a.gradient(side, lane, c);
      } else if (lane < kOwn) {
        own += a.block(side, i, j, c);
      }
      const int32_t other = a.body[1 - side];
      if (other < 0 || groups.rank(other) >= b) continue;
      const Vector d = vector_of(center + 3 * other);
      for (int k = lane; k < kUnknowns * kUnknowns; k += 32) {
        at(of, b, k / kUnknowns, groups.rank(other), k % kUnknowns) +=
            dot(a.map(side, k / kUnknowns, c), a.stiffness * a.map(1 - side, k % kUnknowns, d));
      }
    }
    if (lane < kUnknowns) {
      gradients[kUnknowns * b + lane] += own;
    } else if (lane < kOwn) {
      at(of, b, i, b, j) += own;
    }
  }

  // What does not change as bodies move: all but friction and damping.
  __device__ void assemble() const {
    each(size() * size(), [&](int32_t i) { base[i] = 0; });
    each(size(), [&](int32_t i) { gradient[i] = 0, unknown(motion, i) = 0; });
    __syncthreads();
    each_body([&](int32_t b) { add_vertices<false>(b, base, gradient); });
    __syncthreads();
    each_body([&](int32_t b) { add_pairs(b, begin[b], lagged[b], base, gradient); });
    __syncthreads();
  }
  // And these, linear about where bodies have gone.
  __device__ void add_friction() const {
    if (in.planes > 0) each_body([&](int32_t b) { add_vertices<true>(b, matrix, step); });
    if (!in.lag) return;
    each_row([&](int64_t row, int64_t pair) {
      PairPress a;
      if (lagged_press(in, pair, CornerPoints<T>{in, false}, slid(), a, -1))
        store_press(a, press + kPressDoubles * row);
    });
    __syncthreads();
    each_body([&](int32_t b) { add_pairs(b, lagged[b], begin[b + 1], matrix, step); });
  }
  __device__ Slid slid() const { return {center, motion}; }
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
          sum += matrix[j <= row ? size() * row + j : size() * j + row] * unknown(motion, j);
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
        whole += matrix[size() * i + j] * (step[i] + unknown(motion, i));
      }
      total[0] += one * one, total[1] += whole * whole;
    });
    reduce<2>(total);
  }
  // Calls f(line) for what slips, in a thread's share.
  template <class F>
  __device__ void each_line(const F& f) const {
    if (in.lag) {
      each_row([&](int64_t, int64_t pair) {
        PairPress a;
        if (lagged_press(in, pair, CornerPoints<T>{in, false}, slid(), a, -1)) f(slip_line(in, pair, a, center, steps));
      });
    }
    for (int32_t b = 0; in.planes > 0 && b < count; ++b) {
      const Body<T> own = body(b);
      if (!in.free[own.body]) continue;
      each(own.size() * in.planes, [&](int32_t item) {
        const int32_t v = own.vertex(item / in.planes), k = item % in.planes;
        if (!bears(in, own, v, k)) return;
        const Vector arm = own.position(v) - center_of(b);
        const int64_t at = int64_t{kUnknowns} * own.body;
        f(slip_line(in, own, v, k, arm, motion + at, steps + at));
      });
    }
  }
  __device__ double share(double fall) const {
    SlipLine kept[kLines];
    int lines = 0;
    each_line([&](const SlipLine& a) {
#pragma unroll
      for (int k = 0; k < kLines; ++k) {
        if (lines == k) kept[k] = a;
      }
      ++lines;
    });
    return share_of_step(fall, [&](auto number, const double* shares, double* total) {
      constexpr int n = decltype(number)::value;
#pragma unroll
      for (int k = 0; k < n; ++k) total[k] = 0;
      const auto add = [&](const SlipLine& line) {
#pragma unroll
        for (int k = 0; k < n; ++k) total[k] += line.excess(shares[k]);
      };
#pragma unroll
      for (int l = 0; l < kLines; ++l) {
        if (l < lines) add(kept[l]);
      }
      if (lines > kLines) {
        int seen = 0;
        each_line([&](const SlipLine& line) {
          if (seen++ >= kLines) add(line);
        });
      }
      reduce<n>(total);
    });
  }

  __device__ void solve(Pivots& pivots) const {
    Settling state = kOnItsWay;  // the same for all threads
    for (int iteration = 0; iteration < kSlipIterations && state != kDone; ++iteration) {
      each(size() * size(), [&](int32_t i) { matrix[i] = base[i]; });
      each(size(), [&](int32_t i) { step[i] = gradient[i]; });
      __syncthreads();
      add_friction();
      __syncthreads();
      if (iteration > 0) add_product();
      __syncthreads();
      factor_blocks<kTeam>(count, matrix, pivots);
      solve_blocks<kTeam>(count, matrix, step);
      each(count, [&](int32_t b) { keep_finite(step + kUnknowns * b); });
      __syncthreads();
      each(size(), [&](int32_t i) { unknown(steps, i) = step[i]; });
      __syncthreads();
      double of[2] = {0, 0};
      if (in.rubs()) energies(of);
      const double taken = settle(state, in.rubs(), of[0], of[1], [&](double fall) { return share(fall); });
      each(size(), [&](int32_t i) { unknown(motion, i) += taken * step[i]; });
      __syncthreads();
    }
  }
};

// Where the rows of each body of a group begin, and its lagged ones; then these rows, in memory that a counter shares
// out.
template <class T>
__device__ void find_rows(const GroupSystem<T>& system, int32_t* begin, int32_t* lagged, int32_t* taken) {
  const auto count_rows = [&](int32_t b, bool which, int32_t at) {
    system.each_side(b, which, [&](int64_t row, int side) {
      const unsigned found = __ballot_sync(kAll, 0 <= side);
      if (0 <= side && 0 <= at) {
        const unsigned before = found & ((1u << threadIdx.x % 32) - 1);
        system.rows[at + __popc(before)] = static_cast<int32_t>(2 * row) + side;
      }
      at = at < 0 ? at - __popc(found) : at + __popc(found);
    });
    return at;
  };
  const bool any_lagged = system.in.lag != nullptr;
  system.each_body([&](int32_t b) {
    const int32_t listed = -1 - count_rows(b, false, -1), all = any_lagged ? -1 - count_rows(b, true, -1) : 0;
    if (threadIdx.x % 32 == 0) lagged[b] = listed, begin[b + 1] = listed + all;
  });
  __syncthreads();
  if (threadIdx.x == 0) {
    begin[0] = 0;
    for (int32_t b = 0; b < system.count; ++b) begin[b + 1] += begin[b];
    const int32_t base = atomicAdd(taken, begin[system.count]);
    for (int32_t b = 0; b <= system.count; ++b) begin[b] += base;
    for (int32_t b = 0; b < system.count; ++b) lagged[b] += begin[b];
  }
  __syncthreads();
  system.each_body([&](int32_t b) {
    count_rows(b, false, begin[b]);
    if (any_lagged) count_rows(b, true, lagged[b]);
  });
  __syncthreads();
}

// fits: unknowns whose matrix fits into the dynamic shared memory.
template <class T>
__global__ void __launch_bounds__(kTeam)
    groups_kernel(const __grid_constant__ RigidInputs<T> in, PairRoom room, const __grid_constant__ GroupMemory memory,
                  double* center, double* motion, double* factors, int32_t fits) {
  __shared__ double part[kTeamWarps][kShares], gradient[kMostUnknowns], step[kMostUnknowns];
  __shared__ int32_t begin[kMostCoupled + 1], lagged[kMostCoupled];
  __shared__ Pivots pivots;
  extern __shared__ double matrix[];
  const int32_t n = in.bodies(), places = in.together() ? 1 : n;
  const int64_t scene = blockIdx.x / places;
  const auto first = static_cast<int32_t>(blockIdx.x % places);
  const Groups groups = in.groups_of(scene);
  const int32_t count = groups.count(first), size = kUnknowns * count;
  if (count <= kFew) return;
  const int64_t at = in.matrix_size() * scene + groups.matrix(first);
  const GroupSystem<T> system{in,
                              room,
                              scene,
                              groups,
                              first,
                              count,
                              memory.sides,
                              center + 3 * n * scene,
                              motion + kUnknowns * n * scene,
                              memory.steps + kUnknowns * n * scene,
                              memory.press,
                              memory.bases + at,
                              size <= fits ? matrix : factors + at,
                              gradient,
                              step,
                              memory.rows,
                              begin,
                              lagged,
                              part};
  find_rows(system, begin, lagged, memory.taken);
  system.assemble();
  system.solve(pivots);
  if (size <= fits) system.each(size * size, [&](int32_t i) { factors[at + i] = matrix[i]; });
}

}  // namespace

template <class T>
cudaError_t solve_groups_of_many(const RigidInputs<T>& in, const PairRoom& room, const GroupMemory& memory,
                                 double* center, double* motion, double* factors, cudaStream_t stream) {
  if (room.rows() > 0) {
    if (auto error = cudaMemsetAsync(memory.taken, 0, sizeof(int32_t), stream)) return error;
  }
  int device = 0, room_for = 0, processors = 0;
  if (auto error = cudaGetDevice(&device)) return error;
  if (auto error = cudaDeviceGetAttribute(&room_for, cudaDevAttrMaxSharedMemoryPerBlockOptin, device)) return error;
  if (auto error = cudaDeviceGetAttribute(&processors, cudaDevAttrMultiProcessorCount, device)) return error;
  const int64_t largest = in.together() ? in.bodies() : most_grouped(in.bodies());
  const auto blocks = static_cast<unsigned>(in.scene.scenes * (in.together() ? 1 : in.bodies()));
  // where there are many, a multiprocessor has several at once
  const int64_t most_shared = blocks > 2 * processors ? kShared : kMostCoupled;
  auto unknowns = static_cast<int32_t>(kUnknowns * (largest < most_shared ? largest : most_shared));
  const auto bytes_of = [](int32_t n) { return static_cast<int>(n * n * sizeof(double)); };
  while (unknowns > 0 && bytes_of(unknowns) + kStatic > room_for) unknowns -= kUnknowns;
  const auto most = cudaFuncAttributeMaxDynamicSharedMemorySize;
  if (auto error = cudaFuncSetAttribute(groups_kernel<T>, most, bytes_of(unknowns))) return error;
  groups_kernel<T><<<blocks, kTeam, bytes_of(unknowns), stream>>>(in, room, memory, center, motion, factors, unknowns);
  return cudaGetLastError();
}

#define DIFFVBD_INSTANTIATE(T)                                                                                      \
  template cudaError_t solve_groups_of_many<T>(const RigidInputs<T>&, const PairRoom&, const GroupMemory&, double*, \
                                               double*, double*, cudaStream_t);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd::cuda
