// The rigid correction where more than a few bodies are solved for together: all of Newton's method in one launch, a
// block for each group.
#include "contact_rigid_group.cuh"

namespace diffvbd::cuda {
namespace {

// Memory of a group, shared.
struct Lists {
  int32_t begin[kMostCoupled], lagged[kMostCoupled], end[kMostCoupled], borne[kMostCoupled];  // as of GroupSystem
  int32_t place[kMostCoupled], member[kMostCoupled];
  uint64_t touching[kMostCoupled], columns[kMostCoupled];  // as of GroupSystem
};

// The order in which bodies are eliminated, by a warp: always next the one that touches the fewest of those left, and
// then these touch one another. Two bodies a lane, which keeps whom they touch.
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
  // what was found by number, by place
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

// Brings the rows of a group into their order, and its bodies into that of their elimination.
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

// fits: unknowns whose matrix fits into the dynamic shared memory.
template <class T>
__global__ void __launch_bounds__(kTeam)
    groups_kernel(const __grid_constant__ RigidInputs<T> in, PairRoom room, const __grid_constant__ GroupMemory memory,
                  int32_t* ordered, double* center, double* motion, double* factors, int32_t fits) {
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
  const GroupRows<T> rows{in, room, memory, scene, groups, first, count};
  // shared, as there are not enough registers for it
  alignas(GroupSystem<T>) __shared__ unsigned char bytes[sizeof(GroupSystem<T>)];
  if (threadIdx.x == 0) {
    new (bytes) GroupSystem<T>{in,
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
                               memory.rubbing,
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
cudaError_t solve_groups_of_many(const RigidInputs<T>& in, const PairRoom& room, const GroupMemory& memory,
                                 int32_t* ordered, double* center, double* motion, double* factors,
                                 cudaStream_t stream) {
  int device = 0, room_for = 0, processors = 0;
  if (auto error = cudaGetDevice(&device)) return error;
  if (auto error = cudaDeviceGetAttribute(&room_for, cudaDevAttrMaxSharedMemoryPerBlockOptin, device)) return error;
  if (auto error = cudaDeviceGetAttribute(&processors, cudaDevAttrMultiProcessorCount, device)) return error;
  const int64_t largest = most_grouped(in.bodies());
  const auto blocks = static_cast<unsigned>(in.scene.scenes * in.bodies());
  // where there are many, a multiprocessor has several at once
  const int64_t most_shared = blocks > 2 * processors ? kShared : kMostCoupled;
  auto unknowns = static_cast<int32_t>(kUnknowns * (largest < most_shared ? largest : most_shared));
  const auto bytes_of = [](int32_t n) { return static_cast<int>(n * n * sizeof(double)); };
  while (unknowns > 0 && bytes_of(unknowns) + kStatic > room_for) unknowns -= kUnknowns;
  // the same for all scenes, which other threads may be about to launch
  const auto most = cudaFuncAttributeMaxDynamicSharedMemorySize;
  if (auto error = cudaFuncSetAttribute(groups_kernel<T>, most, room_for - kStatic)) return error;
  groups_kernel<T>
      <<<blocks, kTeam, bytes_of(unknowns), stream>>>(in, room, memory, ordered, center, motion, factors, unknowns);
  return cudaGetLastError();
}

#define DIFFVBD_INSTANTIATE(T)                                                                                       \
  template cudaError_t solve_groups_of_many<T>(const RigidInputs<T>&, const PairRoom&, const GroupMemory&, int32_t*, \
                                               double*, double*, double*, cudaStream_t);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd::cuda
