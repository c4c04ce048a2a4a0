#include "motion.h"

#include "bodies.h"
#include "islands.h"

namespace diffvbd {

using namespace contact;

template <class T>
void find_motion(const MotionInputs<T>& in, T* rigid, T* ways, T* sums) {
  for_bodies<MovingBody>(
      in, [&](const MovingBody<T>& b, const Threads& team) { contact::find_motion(b, team, rigid, ways, sums); });
}

template <class T>
void reverse_motion(const MotionInputs<T>& in, const MotionAdjoints<T>& a) {
  for_bodies<MovingBody>(in, [&](const MovingBody<T>& b, const Threads& team) { contact::reverse_motion(b, team, a); });
}

template <class T>
void coast(const MotionInputs<T>& in, double chord, T* coasted) {
  for_bodies<MovingBody>(in,
                         [&](const MovingBody<T>& b, const Threads& team) { contact::coast(b, team, chord, coasted); });
}

template <class T>
void reverse_coast(const MotionInputs<T>& in, double chord, const MotionAdjoints<T>& a) {
  for_bodies<MovingBody>(
      in, [&](const MovingBody<T>& b, const Threads& team) { contact::reverse_coast(b, team, chord, a); });
}

template <class T>
void find_trust_radii(RoomInputs<T> in, const RoomWork<T>& work) {
  const int64_t scenes = in.motion.scenes;
  const auto each = [&](const auto& f) {
    for (int64_t i = 0; i < scenes * in.motion.bodies; ++i) {
      f(i / in.motion.bodies, static_cast<int32_t>(i % in.motion.bodies));
    }
  };
  const Threads one(false);
  in.islands.room = work.room;
  for (int64_t scene = 0; scene < scenes; ++scene) prepare_scene(in, scene, one, work);
  for_bodies<MovingBody>(in.motion,
                         [&](const MovingBody<T>& b, const Threads& team) { wish_of_body(in, b, team, work); });
  bool looks = false;
  each([&](int64_t scene, int32_t body) { looks = looks || asks_more(in, work, scene, body); });
  if (looks) find_islands(in.islands, work.island);
  each([&](int64_t scene, int32_t body) { room_among_others(in, work, scene, body, looks); });
  find_islands(in.islands, work.island);
  for (int round = 0; round < kRoomRounds; ++round) {
    for_bodies<MovingBody>(in.motion,
                           [&](const MovingBody<T>& b, const Threads& team) { room_beside_island(in, b, team, work); });
    find_islands(in.islands, work.island);
  }
  for (int64_t scene = 0; scene < scenes; ++scene) end_rooms(in, scene, one, work);
}

#define DIFFVBD_INSTANTIATE(T)                                                              \
  template void find_motion<T>(const MotionInputs<T>&, T*, T*, T*);                         \
  template void reverse_motion<T>(const MotionInputs<T>&, const MotionAdjoints<T>&);        \
  template void coast<T>(const MotionInputs<T>&, double, T*);                               \
  template void reverse_coast<T>(const MotionInputs<T>&, double, const MotionAdjoints<T>&); \
  template void find_trust_radii<T>(RoomInputs<T>, const RoomWork<T>&);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd
