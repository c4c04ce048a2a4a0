// Groups of bodies whose rigid motions are solved for together, in scenes of many (contact/groups.h), and the solutions
// of their systems.
#include "contact_rigid_backward.cuh"
#include "union.cuh"

namespace diffvbd::cuda {
namespace {

__global__ void __launch_bounds__(kOne) start_kernel(int64_t count, int32_t bodies, int32_t* label) {
  const int64_t i = own_item();
  if (i < count) label[i] = static_cast<int32_t>(i % bodies);
}

// Joins what pairs press, or, where no group has more than one body, marks it by -1; sides as of GroupMemory.
template <class T>
__global__ void __launch_bounds__(kOne)
    join_kernel(const __grid_constant__ RigidInputs<T> in, PairRoom room, const int32_t* sides, int32_t* label) {
  const int64_t row = own_item();
  if (!is_row(in, room, row)) return;
  const int32_t a = sides[2 * row], b = sides[2 * row + 1];
  if (a < 0 || b < 0) return;
  const int64_t scene = row < room.listed ? in.gate.listed.pairs[kPairRow * row + 5]
                                          : in.lagged.pairs[kPairRow * (row - room.listed) + 5];
  int32_t* own = label + scene * in.bodies();
  if (most_grouped(in.bodies()) > 1) {
    unite(own, a, b);
  } else {
    own[a] = own[b] = -1;
  }
}

// Places where no group has more than one body.
__global__ void __launch_bounds__(kOne) alone_kernel(int64_t count, int32_t n, const int32_t* label, int32_t* rows) {
  const int64_t i = own_item();
  if (i >= count) return;
  const int64_t scene = i / n, k = i % n;
  int32_t* member = rows + kGroupRows * n * scene + k;
  member[0] = member[n] = static_cast<int32_t>(k);
  member[int64_t{2} * n] = 0, member[int64_t{3} * n] = label[i] < 0 ? kLeft : 1;
}

// Places of the bodies of a scene: a block. work [scenes, 2, bodies]: memory.
__global__ void __launch_bounds__(kThreads)
    places_kernel(int32_t n, const int32_t* label, int32_t* work, int32_t* rows) {
  __shared__ int32_t begins[kThreads + 1];
  const int32_t most = static_cast<int32_t>(most_grouped(n));
  const int32_t* own = label + int64_t{n} * blockIdx.x;
  int32_t *size = work + int64_t{2 * n} * blockIdx.x, *lead = size + n;
  int32_t* member = rows + int64_t{kGroupRows} * n * blockIdx.x;
  int32_t *first = member + n, *rank = first + n, *count = rank + n;
  const auto each = [&](const auto& f) {
    for (auto k = static_cast<int32_t>(threadIdx.x); k < n; k += kThreads) f(k);
    __syncthreads();
  };
  each([&](int32_t k) { size[k] = 0, count[k] = 0; });
  each([&](int32_t k) {
    lead[k] = root_of(own, k);
    atomicAdd(size + lead[k], 1);
  });
  each([&](int32_t k) {
    if (size[lead[k]] > most) lead[k] = k;
  });
  // groups follow one another in the order of their first bodies
  const int32_t share = (n + kThreads - 1) / kThreads, from = share * static_cast<int32_t>(threadIdx.x);
  const int32_t to = from + share < n ? from + share : n;
  const auto is_left = [&](int32_t k) { return size[k] > most || size[k] == 0; };
  const auto grouped = [&](int32_t k) { return lead[k] != k ? 0 : is_left(k) ? 1 : size[k]; };
  int32_t sum = 0;
  for (int32_t k = from; k < to; ++k) sum += grouped(k);
  begins[threadIdx.x + 1] = sum;
  __syncthreads();
  if (threadIdx.x == 0) {
    begins[0] = 0;
    for (int i = 0; i < kThreads; ++i) begins[i + 1] += begins[i];
  }
  __syncthreads();
  int32_t place = begins[threadIdx.x];
  for (int32_t k = from; k < to; ++k) {
    const int32_t bodies = grouped(k);
    if (bodies > 0) first[k] = place, count[place] = is_left(k) ? kLeft : bodies;
    place += bodies;
  }
  __syncthreads();
  // those of a group come in any order, and are sorted by the first of them
  each([&](int32_t k) { rank[k] = 0; });
  each([&](int32_t k) { member[first[lead[k]] + atomicAdd(rank + lead[k], 1)] = k; });
  each([&](int32_t k) {
    if (lead[k] != k) return;
    int32_t* all = member + first[k];
    for (int32_t i = 1; i < count[first[k]]; ++i) {
      for (int32_t j = i; j > 0 && all[j] < all[j - 1]; --j) {
        const int32_t other = all[j];
        all[j] = all[j - 1], all[j - 1] = other;
      }
    }
  });
  each([&](int32_t k) {
    if (lead[k] != k) return;
    for (int32_t i = 0; i < grouped(k); ++i) {
      const int32_t body = member[first[k] + i];
      rank[body] = i, first[body] = first[k];
    }
  });
}

// A block for each place where a group may begin.
template <class T>
__global__ void __launch_bounds__(kThreads)
    solve_groups_kernel(const __grid_constant__ RigidInputs<T> in, const double* factor, double* x) {
  __shared__ GroupSolve<kMostCoupled> memory;
  const int32_t places = in.together() ? 1 : in.bodies();
  solve_group(in, blockIdx.x / places, static_cast<int32_t>(blockIdx.x % places), factor, x, memory);
}

}  // namespace

int64_t groups_bytes(int64_t scenes, int64_t bodies) { return 3 * scenes * bodies * sizeof(int32_t); }

template <class T>
cudaError_t find_groups(const RigidInputs<T>& in, const PairRoom& room, const int32_t* sides, int32_t* groups,
                        void* workspace, cudaStream_t stream) {
  const int64_t bodies = in.scene.scenes * in.bodies();
  auto *label = static_cast<int32_t*>(workspace), *work = label + bodies;
  start_kernel<<<blocks_for(bodies), kOne, 0, stream>>>(bodies, in.bodies(), label);
  if (room.rows() > 0) join_kernel<T><<<blocks_for(room.rows()), kOne, 0, stream>>>(in, room, sides, label);
  if (most_grouped(in.bodies()) > 1) {
    places_kernel<<<static_cast<unsigned>(in.scene.scenes), kThreads, 0, stream>>>(in.bodies(), label, work, groups);
  } else {
    alone_kernel<<<blocks_for(bodies), kOne, 0, stream>>>(bodies, in.bodies(), label, groups);
  }
  return cudaGetLastError();
}

template <class T>
cudaError_t solve_groups(const RigidInputs<T>& in, const double* factor, double* x, cudaStream_t stream) {
  const auto blocks = static_cast<unsigned>(in.scene.scenes * (in.together() ? 1 : in.bodies()));
  solve_groups_kernel<T><<<blocks, kThreads, 0, stream>>>(in, factor, x);
  return cudaGetLastError();
}

#define DIFFVBD_INSTANTIATE(T)                                                                                 \
  template cudaError_t find_groups<T>(const RigidInputs<T>&, const PairRoom&, const int32_t*, int32_t*, void*, \
                                      cudaStream_t);                                                           \
  template cudaError_t solve_groups<T>(const RigidInputs<T>&, const double*, double*, cudaStream_t);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd::cuda
