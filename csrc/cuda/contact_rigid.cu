// The rigid correction of bodies that touch: what pairs press, which bodies are solved for together, and their motions.
#include "../contact/rigid_rub.h"
#include "contact_rigid.cuh"

namespace diffvbd::cuda {
namespace {

// What listed pairs press, and the sides of all.
template <class T>
__global__ void __launch_bounds__(kOne)
    press_kernel(const __grid_constant__ RigidInputs<T> in, PairRoom room, int32_t* sides, double* press) {
  const int64_t row = own_item();
  if (row >= room.listed + room.lagged) return;
  const CornerPoints<T> at{in, false};
  PairPress a;
  bool acts = false;
  if (row < room.listed) {
    acts = row < in.first_listed(in.scene.scenes) && barrier_press(in, row, at, a);
    if (acts) store_press(a, press + kPressDoubles * row);
  } else if (row - room.listed < in.first_lagged(in.scene.scenes)) {
    acts = lagged_press(in, row - room.listed, at, Slid{}, a, -1);
  }
  sides[2 * row] = acts ? a.body[0] : -1;
  sides[2 * row + 1] = acts ? a.body[1] : -1;
}

// Whether a scene may have groups of more than kFew bodies.
template <class T>
bool has_many(const RigidInputs<T>& in) {
  return most_grouped(in.bodies()) > kFew;
}

// How often vertices may be borne by planes.
template <class T>
int64_t floors_of(const RigidInputs<T>& in) {
  return in.scene.scenes * in.scene.vertices * in.planes;
}

}  // namespace

template <class T>
int64_t rigid_system_bytes(const RigidInputs<T>& in, const PairRoom& room) {
  const int64_t scenes = in.scene.scenes, bodies = scenes * in.bodies(), rows = room.rows();
  int64_t bytes = aligned(2 * rows * sizeof(int32_t)) + aligned(room.listed * kPressDoubles * sizeof(double)) +
                  aligned(bodies * kUnknowns * sizeof(double));
  if (!in.together()) bytes += aligned(groups_bytes(scenes, in.bodies()));
  if (has_many(in)) {
    bytes += aligned(scenes * in.matrix_size() * sizeof(double)) + aligned(2 * rows * sizeof(int32_t)) +
             aligned(sizeof(int32_t)) + aligned(room.lagged * kRubScalars * sizeof(double)) +
             aligned(floors_of(in) * sizeof(int32_t));
  }
  return bytes;
}

template <class T>
cudaError_t rigid_system(const RigidInputs<T>& in, const PairRoom& room, bool again, double* center, double* motion,
                         double* factor, int32_t* groups, void* workspace, cudaStream_t stream) {
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
  if (rows > 0) press_kernel<T><<<blocks_for(rows), kOne, 0, stream>>>(in, room, memory.sides, memory.press);
  if (!in.together()) {
    void* work = take(groups_bytes(scenes, in.bodies()));
    if (auto error = find_groups(in, room, memory.sides, groups, work, stream)) return error;
  }
  if (auto error = solve_few(in, room, memory, again, center, motion, factor, stream)) return error;
  if (!has_many(in) || again) return cudaGetLastError();
  memory.bases = static_cast<double*>(take(scenes * in.matrix_size() * sizeof(double)));
  memory.rows = static_cast<int32_t*>(take(2 * rows * sizeof(int32_t)));
  memory.taken = static_cast<int32_t*>(take(sizeof(int32_t)));
  memory.rubbing = static_cast<double*>(take(room.lagged * kRubScalars * sizeof(double)));
  memory.floors = static_cast<int32_t*>(take(floors_of(in) * sizeof(int32_t)));
  return solve_groups_of_many(in, room, memory, groups, center, motion, factor, stream);
}

#define DIFFVBD_INSTANTIATE(T)                                                                                  \
  template int64_t rigid_system_bytes<T>(const RigidInputs<T>&, const PairRoom&);                               \
  template cudaError_t rigid_system<T>(const RigidInputs<T>&, const PairRoom&, bool, double*, double*, double*, \
                                       int32_t*, void*, cudaStream_t);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd::cuda
