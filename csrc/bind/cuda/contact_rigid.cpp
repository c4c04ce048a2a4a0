// CUDA implementations of the rigid correction of bodies that touch.
#include "../contact_rigid.h"

#include <torch/csrc/stable/accelerator.h>
#include <torch/csrc/stable/library.h>

#include <tuple>
#include <vector>

#include "../../cuda/contact_rigid.h"
#include "binding.h"

namespace {

namespace contact = diffvbd::contact;
namespace cuda = diffvbd::cuda;
using cuda::check, cuda::current_stream, cuda::empty, cuda::Zeroed;
using diffvbd::data, diffvbd::dispatch_float, diffvbd::TouchingFields;
using torch::headeronly::ScalarType;
using torch::stable::Tensor;
using torch::stable::accelerator::DeviceGuard;

cuda::PairRoom room_of(const TouchingFields& f) {
  return {f.pairs.size(0), f.lag.numel() > 0 ? f.lag_pairs.size(0) : 0};
}

std::tuple<Tensor, Tensor, Tensor, Tensor> contact_rigid_system(
    DIFFVBD_PARAMETERS(TOUCHING) std::vector<int64_t> data_count, double time_step, double friction_eps,
    const Tensor& moving, bool alone) {
  const TouchingFields f{DIFFVBD_ITEMS(TOUCHING)};
  const DeviceGuard guard(x.get_device_index());
  diffvbd::require_positions(x);
  const int64_t b = x.size(0), n = ptr.numel() - 1;
  Tensor groups = empty(x, diffvbd::groups_shape(b, n), ScalarType::Int);
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto all = diffvbd::touching_inputs<T>(f, data_count, time_step, friction_eps, empty(x, {0}), groups);
    const auto in = diffvbd::moving_inputs(all, moving, alone, x);
    const auto doubles = [&](const std::vector<int64_t>& sizes) { return empty(x, sizes, ScalarType::Double); };
    Tensor centers = doubles({b, n, 3}), motion = doubles({b, n, contact::kUnknowns});
    Tensor factor = doubles(diffvbd::matrix_shape(b, n, alone));
    const Tensor work = empty(x, {cuda::rigid_system_bytes(in, room_of(f))}, ScalarType::Byte);
    check(cuda::rigid_system<T>(in, room_of(f), data<double>(centers), data<double>(motion), data<double>(factor),
                                in.groups ? data<int32_t>(groups) : nullptr, work.data_ptr(), current_stream(x)),
          "the rigid correction of bodies that touch");
    return std::make_tuple(centers, motion, factor, groups);
  });
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> contact_rigid_move(DIFFVBD_PARAMETERS(TOUCHING)
                                                                          const Tensor& centers,
                                                                      const Tensor& motion,
                                                                      std::vector<int64_t> data_count, double time_step,
                                                                      double friction_eps, const Tensor& moving) {
  const TouchingFields f{DIFFVBD_ITEMS(TOUCHING)};
  const DeviceGuard guard(x.get_device_index());
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    diffvbd::require_positions(x);
    const Tensor way = empty(x, {x.size(0), x.size(1), 3});
    const auto all = diffvbd::touching_inputs<T>(f, data_count, time_step, friction_eps, way, empty(x, {0}));
    const auto in = diffvbd::moving_inputs(all, moving, false, x);
    diffvbd::require_motion(in, centers, motion, x);
    const auto make = [&](const std::vector<int64_t>& sizes, ScalarType dtype) { return empty(x, sizes, dtype); };
    const diffvbd::RigidOutcomeTensors out(in, x, make);
    const Tensor work = empty(x, {cuda::rigid_move_bytes(in, room_of(f))}, ScalarType::Byte);
    check(cuda::rigid_move<T>(in, room_of(f), data<const double>(centers), data<const double>(motion), data<T>(way),
                              out.view<T>(), data<T>(out.x), work.data_ptr(), current_stream(x)),
          "the rigid correction of bodies that touch");
    return out.all();
  });
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> contact_rigid_backward(
    DIFFVBD_PARAMETERS(TOUCHING) const Tensor& p, const Tensor& q, const Tensor& groups,
    std::vector<int64_t> data_count, double time_step, double friction_eps) {
  const TouchingFields f{DIFFVBD_ITEMS(TOUCHING)};
  const DeviceGuard guard(x.get_device_index());
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::touching_inputs<T>(f, data_count, time_step, friction_eps, empty(x, {0}), groups);
    Zeroed zeros(x);
    const auto make = [&](const std::vector<int64_t>& sizes, bool zeroed) {
      return zeroed ? zeros(sizes) : empty(x, sizes);
    };
    const diffvbd::RigidWorkTensors out(f, empty(x, {f.pairs.size(0)}, ScalarType::Byte), make);
    zeros.clear();
    const Tensor pushing = empty(x, {1 + f.pairs.size(0)}, ScalarType::Int);
    check(cuda::rigid_backward<T>(in, diffvbd::virtual_motions(in, p, q, x), out.view<T>(), out.sums<T>(),
                                  data<int32_t>(pushing), current_stream(x)),
          "the adjoint of rigid motions");
    return out.all();
  });
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>
contact_rigid_reverse(DIFFVBD_PARAMETERS(TOUCHING) std::vector<Tensor> at, std::vector<Tensor> motion,
                      std::vector<Tensor> share, std::vector<Tensor> factor, std::vector<Tensor> groups,
                      const Tensor& x_bar, std::vector<int64_t> data_count, double time_step, double friction_eps,
                      bool wants_data) {
  const TouchingFields f{DIFFVBD_ITEMS(TOUCHING)};
  const DeviceGuard guard(x.get_device_index());
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const diffvbd::Corrections all{at, motion, share, factor, groups};
    const auto inputs = all.inputs<T>(f, data_count, time_step, friction_eps, empty(x, {0}));
    const auto& last = inputs.back();
    const int64_t scenes = last.scene.scenes;
    diffvbd::require_like("x_bar", x_bar, x, 3 * scenes * last.scene.vertices);
    Zeroed zeros(x);
    const auto make = [&](const std::vector<int64_t>& sizes, bool zeroed) {
      return zeroed ? zeros(sizes) : empty(x, sizes);
    };
    const diffvbd::RigidReverseTensors t(f, last, data_count, wants_data, empty(x, {f.pairs.size(0)}, ScalarType::Byte),
                                         make);
    zeros.clear();
    const Tensor solution = empty(x, {scenes, last.bodies(), contact::kUnknowns}, ScalarType::Double);
    const Tensor pushing = empty(x, {scenes + f.pairs.size(0)}, ScalarType::Int);
    const T* end_bar = data<const T>(x_bar);
    for (size_t k = inputs.size(); k-- > 0;) {
      const cuda::RigidReverse<T> own{data<const double>(motion[k]),
                                      data<const double>(share[k]),
                                      data<const double>(factor[k]),
                                      end_bar,
                                      data<double>(solution),
                                      data<T>(t.p),
                                      data<T>(t.q),
                                      data<T>(t.way),
                                      t.pairs.view<T>(),
                                      t.pairs.sums<T>(),
                                      data<int32_t>(pushing),
                                      t.out<T>()};
      check(cuda::rigid_reverse<T>(inputs[k], own, current_stream(x)), "the adjoint of rigid motions");
      end_bar = own.out.vertices.x;
    }
    return t.all();
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CUDA, m) {
  m.impl("contact_rigid_system", TORCH_BOX(&contact_rigid_system));
  m.impl("contact_rigid_move", TORCH_BOX(&contact_rigid_move));
  m.impl("contact_rigid_backward", TORCH_BOX(&contact_rigid_backward));
  m.impl("contact_rigid_reverse", TORCH_BOX(&contact_rigid_reverse));
}
