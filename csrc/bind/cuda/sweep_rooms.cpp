// CUDA implementation of the rooms of sweeps.
#include "../sweep_rooms.h"

#include <torch/csrc/stable/accelerator.h>
#include <torch/csrc/stable/library.h>

#include "../../cuda/contact.h"
#include "binding.h"

namespace {

namespace cuda = diffvbd::cuda;
using cuda::check, cuda::current_stream, cuda::empty;
using diffvbd::data, diffvbd::dispatch_float;
using torch::stable::Tensor;
using torch::stable::accelerator::DeviceGuard;

Tensor contact_sweep_rooms(const Tensor& x, const Tensor& start, const Tensor& begin, const Tensor& move,
                           const Tensor& fall, const Tensor& apart, const Tensor& stretched, const Tensor& center,
                           const Tensor& room, const Tensor& own_center, const Tensor& own_room, const Tensor& held,
                           const Tensor& body_order, const Tensor& body_ptr, double more, double least) {
  const DeviceGuard guard(x.get_device_index());
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::sweep_room_inputs<T>(
        {x, start, begin, move, fall, apart, stretched, center, room, own_center, own_room, held, body_order, body_ptr},
        more, least);
    Tensor out = empty(x, {in.scenes, in.vertices});
    const Tensor wishes = empty(x, {in.scenes, in.bodies}), most = empty(x, {in.scenes});
    check(cuda::sweep_radii<T>(in, data<T>(wishes), data<T>(most), data<T>(out), current_stream(x)),
          "the rooms of sweeps");
    return out;
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CUDA, m) { m.impl("contact_sweep_rooms", TORCH_BOX(&contact_sweep_rooms)); }
