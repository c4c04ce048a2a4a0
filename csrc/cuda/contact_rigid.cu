// Rigid correction of bodies that touch: forces of pairs, groups of bodies, and their motions (contact/groups.h).
#include <cuda_runtime_api.h>

#include <algorithm>
#include <map>

#include "arrays.h"
#include "atomics.cuh"
#include "common.cuh"
#include "contact_rigid_rows.cuh"

namespace diffvbd::cuda {

// A second stream of a device, of the calling thread. In the capture of a graph it is captured as well, until that
// ends.
class Beside {
 public:
  Beside() = default;
  Beside(const Beside&) = delete;
  Beside& operator=(const Beside&) = delete;
  ~Beside() {  // at the end of the thread
    if (begun_) cudaEventDestroy(begun_);
    if (ended_) cudaEventDestroy(ended_);
    if (stream_) cudaStreamDestroy(stream_);
  }

  // That of the current device.
  static cudaError_t of_device(Beside** out) {
    thread_local std::map<int, Beside> all;
    int device = 0;
    if (auto error = cudaGetDevice(&device)) return error;
    *out = &all[device];
    return (*out)->make();
  }
  cudaStream_t stream() const { return stream_; }
  // What this stream is given from now on waits for what `main` has been given,
  cudaError_t fork(cudaStream_t main) const {
    if (auto error = cudaEventRecord(begun_, main)) return error;
    return cudaStreamWaitEvent(stream_, begun_, 0);
  }
  // and what `main` is given from now on for what this one has.
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

}  // namespace

int64_t groups_bytes(int64_t scenes, int64_t bodies) { return 3 * scenes * bodies * sizeof(int32_t); }

template <class T>
cudaError_t find_groups(const RigidInputs<T>& in, const PairRoom& room, const int32_t* sides, int32_t* groups,
                        void* workspace, cudaStream_t stream) {
  const int64_t bodies = in.scene.scenes * in.bodies();
  auto *label = static_cast<int32_t*>(workspace), *work = label + bodies;
  start_kernel<<<blocks_for(bodies, kOne), kOne, 0, stream>>>(bodies, in.bodies(), label);
  if (room.rows() > 0) join_kernel<T><<<blocks_for(room.rows(), kOne), kOne, 0, stream>>>(in, room, sides, label);
  if (most_grouped(in.bodies()) > 1) {
    places_kernel<<<static_cast<unsigned>(in.scene.scenes), kThreads, 0, stream>>>(in.bodies(), label, work, groups);
  } else {
    alone_kernel<<<blocks_for(bodies, kOne), kOne, 0, stream>>>(bodies, in.bodies(), label, groups);
  }
  return cudaGetLastError();
}

DIFFVBD_INSTANTIATE(find_groups)

namespace {

template <class T>
__global__ void __launch_bounds__(kOne) press_kernel(const __grid_constant__ RigidInputs<T> in, PairRoom room,
                                                     const __grid_constant__ GroupMemory memory, bool counts) {
  const int64_t row = own_item();
  if (!is_row(in, room, row)) return;
  press_row(in, room, memory, row);
  if (counts) count_row(in, room, memory, row);
}

// Shares memory out for the rows of groups.
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
// And puts them there. Scenes that are one group need no kernel that shares memory out.
template <class T>
__global__ void __launch_bounds__(kOne)
    fill_kernel(const __grid_constant__ RigidInputs<T> in, PairRoom room, const __grid_constant__ GroupMemory memory) {
  const int64_t i = own_item();
  if (in.together() && i < in.scene.scenes * in.bodies()) memory.begins[i] = begin_in_scene(in, memory, i);
  if (!is_row(in, room, i)) return;
  fill_row(in, room, memory, i,
           [&](int64_t unit) { return in.together() ? begin_in_scene(in, memory, unit) : memory.begins[unit]; });
}

// Whether groups of more than kFew bodies may move.
template <class T>
bool has_many(const RigidInputs<T>& in) {
  return !in.together() && in.room > kFew;
}

constexpr int64_t kRowsOfBlock = 16384;  // of a scene whose block lists them

// Numbers that are counted up from zero, of so many bodies.
int64_t counters(int64_t bodies) { return 5 * bodies + 1; }

// How often vertices may be borne by planes.
template <class T>
int64_t floors_of(const RigidInputs<T>& in) {
  return in.scene.scenes * in.scene.vertices * in.planes;
}

}  // namespace

template <class T>
int64_t rigid_system_bytes(const RigidInputs<T>& in, const PairRoom& room) {
  const int64_t scenes = in.scene.scenes, bodies = scenes * in.bodies(), rows = room.rows();
  int64_t bytes = 3 * aligned(2 * rows * sizeof(int32_t)) + aligned(room.listed * kPressDoubles * sizeof(double)) +
                  aligned(bodies * kUnknowns * sizeof(double)) + aligned(counters(bodies) * sizeof(int32_t));
  if (!in.together()) bytes += aligned(groups_bytes(scenes, in.bodies()));
  if (has_many(in)) {
    bytes += aligned(scenes * in.matrix_size() * sizeof(double)) + aligned(room.lagged * kRubScalars * sizeof(double)) +
             aligned(floors_of(in) * sizeof(int32_t));
  }
  return bytes;
}

template <class T>
cudaError_t rigid_system(const RigidInputs<T>& in, const PairRoom& room, double* center, double* motion, double* factor,
                         int32_t* groups, void* workspace, cudaStream_t stream) {
  const int64_t scenes = in.scene.scenes, bodies = scenes * in.bodies(), rows = room.rows();
  if (bodies == 0) return cudaSuccess;
  auto* next = static_cast<uint8_t*>(workspace);
  const auto take = [&](int64_t bytes) -> void* {
    uint8_t* here = next;
    next += aligned(bytes);
    return here;
  };
  GroupMemory memory{};
  memory.sides = static_cast<int32_t*>(take(2 * rows * sizeof(int32_t)));
  memory.press = static_cast<double*>(take(room.listed * kPressDoubles * sizeof(double)));
  memory.steps = static_cast<double*>(take(bodies * kUnknowns * sizeof(double)));
  memory.found = static_cast<int32_t*>(take(2 * rows * sizeof(int32_t)));
  memory.rows = static_cast<int32_t*>(take(2 * rows * sizeof(int32_t)));
  memory.counts = static_cast<int32_t*>(take(counters(bodies) * sizeof(int32_t)));
  memory.filled = memory.counts + 2 * bodies, memory.begins = memory.filled + 2 * bodies;
  memory.taken = memory.begins + bodies;
  const bool lists = in.together() && rows <= kRowsOfBlock * scenes;  // a block of each scene does
  if (!lists) {
    if (auto error = clear({{memory.counts, counters(bodies) * int64_t{sizeof(int32_t)}}}, stream)) return error;
  }
  const unsigned blocks = blocks_for(rows, kOne);
  if (rows > 0) press_kernel<T><<<blocks, kOne, 0, stream>>>(in, room, memory, !lists);
  if (lists) return solve_few(in, room, memory, true, center, motion, factor, stream);
  if (!in.together()) {
    void* work = take(groups_bytes(scenes, in.bodies()));
    if (auto error = find_groups(in, room, memory.sides, groups, work, stream)) return error;
  }
  if (rows > 0) {
    if (!in.together()) share_kernel<T><<<blocks_for(bodies, kOne), kOne, 0, stream>>>(in, memory);
    fill_kernel<T><<<blocks_for(std::max(rows, bodies), kOne), kOne, 0, stream>>>(in, room, memory);
  }
  if (!has_many(in)) return solve_few(in, room, memory, false, center, motion, factor, stream);
  memory.bases = static_cast<double*>(take(scenes * in.matrix_size() * sizeof(double)));
  memory.rubbing = static_cast<double*>(take(room.lagged * kRubScalars * sizeof(double)));
  memory.floors = static_cast<int32_t*>(take(floors_of(in) * sizeof(int32_t)));
  // Each leaves out the groups that the other solves for; the larger ones are reordered, each in its own rows of
  // `groups`, of which the other reads only where groups begin and how many they have.
  Beside* beside = nullptr;
  if (auto error = Beside::of_device(&beside)) return error;
  if (auto error = beside->fork(stream)) return error;
  const cudaError_t few = solve_few(in, room, memory, false, center, motion, factor, beside->stream());
  const cudaError_t many = solve_groups_of_many(in, room, memory, groups, center, motion, factor, stream);
  const cudaError_t joined = beside->join(stream);  // whatever the errors: memory is given back to `stream`
  return few ? few : many ? many : joined;
}

DIFFVBD_INSTANTIATE(rigid_system_bytes)
DIFFVBD_INSTANTIATE(rigid_system)

}  // namespace diffvbd::cuda
