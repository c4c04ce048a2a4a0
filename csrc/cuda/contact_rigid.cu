// Rigid correction of bodies that touch: forces of pairs, groups of bodies, and their motions (contact/groups.h).
#include <cuda_runtime_api.h>

#include <algorithm>
#include <map>

#include "arrays.h"
#include "atomics.cuh"
#include "common.cuh"
#include "contact_rigid_rows.cuh"

namespace diffvbd::cuda {
namespace {

__global__ void __launch_bounds__(kOne) start_kernel(int64_t count, int32_t bodies, int32_t* label) {
  const int64_t i = own_item();
  if (i < count) label[i] = static_cast<int32_t>(i % bodies);
}

// Unites the bodies of pairs that act; where no group has more than one body, marks them by -1. sides: as in
// GroupMemory.
template <class T>
__global__ void __launch_bounds__(kOne) join_kernel(const __grid_constant__ RigidInputs<T> in, PairCapacity capacity,
                                                    const int32_t* sides, int32_t* label) {
  const int64_t row = own_item();
  if (!is_row(in, capacity, row)) return;
  const int32_t a = sides[2 * row], b = sides[2 * row + 1];
  if (a < 0 || b < 0) return;
  const int64_t scene = row < capacity.listed ? in.gate.listed.pairs[kPairRow * row + 5]
                                              : in.lagged.pairs[kPairRow * (row - capacity.listed) + 5];
  int32_t* own = label + scene * in.bodies();
  if (most_grouped(in.bodies()) > 1) {
    unite(own, a, b);
  } else {
    own[a] = own[b] = -1;
  }
}

// Places of bodies where no group has more than one.
__global__ void __launch_bounds__(kOne) alone_kernel(int64_t count, int32_t n, const int32_t* label, int32_t* rows) {
  const int64_t i = own_item();
  if (i >= count) return;
  const int64_t scene = i / n, k = i % n;
  int32_t* member = rows + kGroupRows * n * scene + k;
  member[0] = member[n] = static_cast<int32_t>(k);
  member[int64_t{2} * n] = 0, member[int64_t{3} * n] = label[i] < 0 ? kLeft : 1;
}

// Places of the bodies of a scene, by a block. work [scenes, 2, bodies]: memory.
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
  // groups in the order of their first bodies
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
  // members of a group arrive in any order; the first of them sorts
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

template <class T>
__global__ void __launch_bounds__(kOne) force_kernel(const __grid_constant__ RigidInputs<T> in, PairCapacity capacity,
                                                     const __grid_constant__ GroupMemory memory, bool counts) {
  const int64_t row = own_item();
  if (!is_row(in, capacity, row)) return;
  force_row(in, capacity, memory, row);
  if (counts) count_row(in, capacity, memory, row);
}

// Assigns memory to the rows of groups.
template <class T>
__global__ void __launch_bounds__(kOne)
    share_kernel(const __grid_constant__ RigidInputs<T> in, const __grid_constant__ GroupMemory memory) {
  const int64_t place = own_item(), n = in.bodies();
  if (place >= in.scene.scenes * n) return;
  const int64_t scene = place / n;
  const auto first = static_cast<int32_t>(place % n);
  const Groups groups = in.groups_of(scene);
  const int32_t count = groups.count(first);
  if (count == 0) return;
  const auto rows_of = [&](int32_t b) { return memory.counts + 2 * (scene * n + groups.member(first + b)); };
  int32_t rows = 0;
  for (int32_t b = 0; b < count; ++b) rows += rows_of(b)[0] + rows_of(b)[1];
  int32_t at = atomicAdd(memory.taken, rows);
  for (int32_t b = 0; b < count; ++b) {
    memory.begins[scene * n + groups.member(first + b)] = at;
    at += rows_of(b)[0] + rows_of(b)[1];
  }
}
// Stores the rows there. Scenes that are one group need no assignment.
template <class T>
__global__ void __launch_bounds__(kOne) fill_kernel(const __grid_constant__ RigidInputs<T> in, PairCapacity capacity,
                                                    const __grid_constant__ GroupMemory memory) {
  const int64_t i = own_item();
  if (in.together() && i < in.scene.scenes * in.bodies()) memory.begins[i] = begin_in_scene(in, memory, i);
  if (!is_row(in, capacity, i)) return;
  fill_row(in, capacity, memory, i,
           [&](int64_t unit) { return in.together() ? begin_in_scene(in, memory, unit) : memory.begins[unit]; });
}

// Whether groups of more than kFew bodies may move.
template <class T>
bool has_many(const RigidInputs<T>& in) {
  return !in.together() && in.capacity > kFew;
}

constexpr int64_t kRowsOfBlock = 16384;  // rows of a scene up to which its block lists them

// Counters that start from zero.
int64_t counters(int64_t bodies) { return 5 * bodies + 1; }

// Parts of the workspace; without memory, its size.
struct SystemWork {
  GroupMemory memory{};
  unsigned char* groups = nullptr;  // of find_groups()
  int64_t bytes = 0;
  template <class T>
  SystemWork(const RigidInputs<T>& in, const PairCapacity& capacity, void* workspace) {
    Parts<16> take(workspace);
    const int64_t scenes = in.scene.scenes, bodies = scenes * in.bodies(), rows = capacity.rows();
    take(memory.sides, 2 * rows), take(memory.forces, capacity.listed * kForceDoubles);
    take(memory.steps, bodies * kUnknowns), take(memory.found, 2 * rows), take(memory.rows, 2 * rows);
    take(memory.counts, counters(bodies));
    memory.filled = memory.counts + 2 * bodies, memory.begins = memory.filled + 2 * bodies;
    memory.taken = memory.begins + bodies;
    if (!in.together()) take(groups, groups_bytes(scenes, in.bodies()));
    if (has_many(in)) {
      take(memory.bases, scenes * in.matrix_size()), take(memory.friction, capacity.lagged * kFrictionScalars);
      take(memory.floors, scenes * in.scene.vertices * in.planes);
    }
    bytes = static_cast<int64_t>(take.bytes);
  }
};

}  // namespace

// Side stream of a device, one for each host thread. Capturing a graph captures it, too, until join().
class SideStream {
 public:
  SideStream() = default;
  SideStream(const SideStream&) = delete;
  SideStream& operator=(const SideStream&) = delete;
  ~SideStream() {  // when the host thread ends
    if (begun_) cudaEventDestroy(begun_);
    if (ended_) cudaEventDestroy(ended_);
    if (stream_) cudaStreamDestroy(stream_);
  }

  // Side stream of the current device.
  static cudaError_t of_device(SideStream** out) {
    thread_local std::map<int, SideStream> all;
    int device = 0;
    if (auto error = cudaGetDevice(&device)) return error;
    *out = &all[device];
    return (*out)->make();
  }
  cudaStream_t stream() const { return stream_; }
  // Later work of this stream waits for earlier work of `main`.
  cudaError_t fork(cudaStream_t main) const {
    if (auto error = cudaEventRecord(begun_, main)) return error;
    return cudaStreamWaitEvent(stream_, begun_, 0);
  }
  // Later work of `main` waits for earlier work of this stream.
  cudaError_t join(cudaStream_t main) const {
    if (auto error = cudaEventRecord(ended_, stream_)) return error;
    return cudaStreamWaitEvent(main, ended_, 0);
  }

 private:
  cudaError_t make() {
    if (ended_) return cudaSuccess;
    if (!stream_) {
      if (auto error = cudaStreamCreateWithFlags(&stream_, cudaStreamNonBlocking)) return error;
    }
    if (!begun_) {
      if (auto error = cudaEventCreateWithFlags(&begun_, cudaEventDisableTiming)) return error;
    }
    return cudaEventCreateWithFlags(&ended_, cudaEventDisableTiming);
  }

  cudaStream_t stream_ = nullptr;
  cudaEvent_t begun_ = nullptr, ended_ = nullptr;
};

int64_t groups_bytes(int64_t scenes, int64_t bodies) { return 3 * scenes * bodies * sizeof(int32_t); }

template <class T>
cudaError_t find_groups(const RigidInputs<T>& in, const PairCapacity& capacity, const int32_t* sides, int32_t* groups,
                        void* workspace, cudaStream_t stream) {
  const int64_t bodies = in.scene.scenes * in.bodies();
  auto *label = static_cast<int32_t*>(workspace), *work = label + bodies;
  start_kernel<<<blocks_for(bodies, kOne), kOne, 0, stream>>>(bodies, in.bodies(), label);
  if (capacity.rows() > 0)
    join_kernel<T><<<blocks_for(capacity.rows(), kOne), kOne, 0, stream>>>(in, capacity, sides, label);
  if (most_grouped(in.bodies()) > 1) {
    places_kernel<<<static_cast<unsigned>(in.scene.scenes), kThreads, 0, stream>>>(in.bodies(), label, work, groups);
  } else {
    alone_kernel<<<blocks_for(bodies, kOne), kOne, 0, stream>>>(bodies, in.bodies(), label, groups);
  }
  return cudaGetLastError();
}

template <class T>
int64_t rigid_system_bytes(const RigidInputs<T>& in, const PairCapacity& capacity) {
  return SystemWork(in, capacity, nullptr).bytes;
}

template <class T>
cudaError_t rigid_system(const RigidInputs<T>& in, const PairCapacity& capacity, double* center, double* motion,
                         double* factor, int32_t* groups, void* workspace, cudaStream_t stream) {
  const int64_t scenes = in.scene.scenes, bodies = scenes * in.bodies(), rows = capacity.rows();
  if (bodies == 0) return cudaSuccess;
  const SystemWork work(in, capacity, workspace);
  const GroupMemory& memory = work.memory;
  const bool lists = in.together() && rows <= kRowsOfBlock * scenes;  // by the block of each scene
  if (!lists) {
    if (auto error = clear({{memory.counts, counters(bodies) * int64_t{sizeof(int32_t)}}}, stream)) return error;
  }
  const unsigned blocks = blocks_for(rows, kOne);
  if (rows > 0) force_kernel<T><<<blocks, kOne, 0, stream>>>(in, capacity, memory, !lists);
  if (lists) return solve_few(in, capacity, memory, true, center, motion, factor, stream);
  if (!in.together()) {
    if (auto error = find_groups(in, capacity, memory.sides, groups, work.groups, stream)) return error;
  }
  if (rows > 0) {
    if (!in.together()) share_kernel<T><<<blocks_for(bodies, kOne), kOne, 0, stream>>>(in, memory);
    fill_kernel<T><<<blocks_for(std::max(rows, bodies), kOne), kOne, 0, stream>>>(in, capacity, memory);
  }
  if (!has_many(in)) return solve_few(in, capacity, memory, false, center, motion, factor, stream);
  // Each skips the groups of the other. The larger groups are reordered in rows of `groups` of their own; the other
  // launch reads only their begins and sizes.
  SideStream* side = nullptr;
  if (auto error = SideStream::of_device(&side)) return error;
  if (auto error = side->fork(stream)) return error;
  const cudaError_t few = solve_few(in, capacity, memory, false, center, motion, factor, side->stream());
  const cudaError_t many = solve_groups_of_many(in, capacity, memory, groups, center, motion, factor, stream);
  const cudaError_t joined = side->join(stream);  // also after errors: `stream` reuses the memory
  return few ? few : many ? many : joined;
}

DIFFVBD_INSTANTIATE(find_groups)
DIFFVBD_INSTANTIATE(rigid_system_bytes)
DIFFVBD_INSTANTIATE(rigid_system)

}  // namespace diffvbd::cuda
