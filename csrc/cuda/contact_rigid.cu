// The rigid correction of bodies that touch: what pairs press, which bodies are solved for together, and their motions.
#include <algorithm>

#include "beside.h"
#include "clear.h"
#include "contact_rigid_rows.cuh"

namespace diffvbd::cuda {
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
  return !in.together() && in.capacity > kFew;
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
  int64_t bytes = 3 * aligned(2 * rows * sizeof(int32_t)) + aligned(room.listed * kForceDoubles * sizeof(double)) +
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
  memory.press = static_cast<double*>(take(room.listed * kForceDoubles * sizeof(double)));
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
  const unsigned blocks = blocks_for(rows);
  if (rows > 0) press_kernel<T><<<blocks, kOne, 0, stream>>>(in, room, memory, !lists);
  if (lists) return solve_few(in, room, memory, true, center, motion, factor, stream);
  if (!in.together()) {
    void* work = take(groups_bytes(scenes, in.bodies()));
    if (auto error = find_groups(in, room, memory.sides, groups, work, stream)) return error;
  }
  if (rows > 0) {
    if (!in.together()) share_kernel<T><<<blocks_for(bodies), kOne, 0, stream>>>(in, memory);
    fill_kernel<T><<<blocks_for(std::max(rows, bodies)), kOne, 0, stream>>>(in, room, memory);
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

#define DIFFVBD_INSTANTIATE(T)                                                                                      \
  template int64_t rigid_system_bytes<T>(const RigidInputs<T>&, const PairRoom&);                                   \
  template cudaError_t rigid_system<T>(const RigidInputs<T>&, const PairRoom&, double*, double*, double*, int32_t*, \
                                       void*, cudaStream_t);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd::cuda
