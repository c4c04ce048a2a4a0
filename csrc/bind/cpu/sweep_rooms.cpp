// CPU implementation of the rooms of sweeps.
#include "../sweep_rooms.h"

#include <torch/csrc/stable/library.h>

#include <vector>

#include "../../cpu/threads.h"
#include "sweep.h"

namespace {

namespace contact = diffvbd::contact;
using diffvbd::data, diffvbd::dispatch_float, diffvbd::empty, diffvbd::kGrain;
using torch::stable::parallel_for, torch::stable::Tensor;

Tensor contact_sweep_rooms(const Tensor& x, const Tensor& start, const Tensor& begin, const Tensor& move,
                           const Tensor& fall, const Tensor& apart, const Tensor& stretched, const Tensor& center,
                           const Tensor& room, const Tensor& own_center, const Tensor& own_room, const Tensor& held,
                           const Tensor& body_order, const Tensor& body_ptr, double more, double least) {
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::sweep_room_inputs<T>(
        {x, start, begin, move, fall, apart, stretched, center, room, own_center, own_room, held, body_order, body_ptr},
        more, least);
    Tensor out = empty(x, {in.scenes, in.vertices});
    T* rooms = data<T>(out);
    std::vector<T> wishes(in.scenes * in.bodies), most(in.scenes);
    const int64_t grain = diffvbd::pieces_per_thread(in.bodies > 0 ? in.vertices / in.bodies : 0);
    parallel_for(0, in.scenes * in.bodies, grain, [&](int64_t first, int64_t last) {
      for (int64_t i = first; i < last; ++i) {
        wishes[i] = contact::wish_of_body(in, contact::displacements_of_body(in, i / in.bodies, i % in.bodies, 0, 1), i);
      }
    });
    for (int64_t s = 0; s < in.scenes; ++s) most[s] = contact::most_of_scene(in, wishes.data(), s, 0, 1);
    parallel_for(0, in.scenes * in.vertices, kGrain, [&](int64_t first, int64_t last) {
      for (int64_t i = first; i < last; ++i) {
        rooms[i] = contact::sweep_radius(in, most[i / in.vertices], i / in.vertices, i % in.vertices);
      }
    });
    return out;
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CPU, m) { m.impl("contact_sweep_rooms", TORCH_BOX(&contact_sweep_rooms)); }
