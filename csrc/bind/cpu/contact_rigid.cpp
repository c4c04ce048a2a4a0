// CPU implementations of the rigid correction of bodies that touch.
#include "../contact_rigid.h"

#include <torch/csrc/stable/library.h>

#include <tuple>
#include <vector>

#include "../../cpu/contact_rigid.h"
#include "sweep.h"

namespace {

namespace contact = diffvbd::contact;
using diffvbd::data, diffvbd::dispatch_float, diffvbd::empty, diffvbd::zeros, diffvbd::TouchingFields;
using torch::headeronly::ScalarType;
using torch::stable::Tensor;

Tensor doubles(const std::vector<int64_t>& sizes) { return torch::stable::empty(sizes, ScalarType::Double); }

std::tuple<Tensor, Tensor, Tensor, Tensor> contact_rigid_system(
    DIFFVBD_PARAMETERS(TOUCHING) std::vector<int64_t> data_count, double time_step, double friction_eps,
    const Tensor& moving, bool alone) {
  const TouchingFields f{DIFFVBD_ITEMS(TOUCHING)};
  diffvbd::require_positions(x);
  const int64_t b = x.size(0), n = ptr.numel() - 1;
  Tensor groups = torch::stable::empty(diffvbd::groups_shape(b, n), ScalarType::Int);
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto all = diffvbd::touching_inputs<T>(f, data_count, time_step, friction_eps, empty(x, {0}), groups);
    const auto in = diffvbd::moving_inputs(all, moving, alone, x);
    Tensor centers = doubles({b, n, 3}), motion = doubles({b, n, contact::kUnknowns});
    Tensor factor = doubles(diffvbd::matrix_shape(b, n, alone));
    diffvbd::rigid_system<T>(in, data<double>(centers), data<double>(motion), data<double>(factor),
                             in.groups ? data<int32_t>(groups) : nullptr);
    return std::make_tuple(centers, motion, factor, groups);
  });
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> contact_rigid_move(DIFFVBD_PARAMETERS(TOUCHING)
                                                                          const Tensor& centers,
                                                                      const Tensor& motion,
                                                                      std::vector<int64_t> data_count, double time_step,
                                                                      double friction_eps, const Tensor& moving) {
  const TouchingFields f{DIFFVBD_ITEMS(TOUCHING)};
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    diffvbd::require_positions(x);
    const Tensor way = empty(x, {x.size(0), x.size(1), 3});
    const auto all = diffvbd::touching_inputs<T>(f, data_count, time_step, friction_eps, way, empty(x, {0}));
    const auto in = diffvbd::moving_inputs(all, moving, false, x);
    diffvbd::require_motion(in, centers, motion, x);
    const auto make = [&](const std::vector<int64_t>& sizes, ScalarType dtype) {
      return torch::stable::empty(sizes, dtype);
    };
    const diffvbd::RigidOutcomeTensors out(in, x, make);
    diffvbd::rigid_move<T>(in, data<const double>(centers), data<const double>(motion), data<T>(way), out.view<T>(),
                           data<T>(out.x));
    return out.all();
  });
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> contact_rigid_backward(
    DIFFVBD_PARAMETERS(TOUCHING) const Tensor& p, const Tensor& q, const Tensor& groups,
    std::vector<int64_t> data_count, double time_step, double friction_eps) {
  const TouchingFields f{DIFFVBD_ITEMS(TOUCHING)};
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::touching_inputs<T>(f, data_count, time_step, friction_eps, empty(x, {0}), groups);
    const auto make = [&](const std::vector<int64_t>& sizes, bool zeroed) {
      return zeroed ? zeros(x, sizes) : empty(x, sizes);
    };
    const diffvbd::RigidWorkTensors out(f, torch::stable::empty({f.pairs.size(0)}, ScalarType::Byte), make);
    diffvbd::rigid_backward<T>(in, diffvbd::virtual_motions(in, p, q, x), out.view<T>(), out.sums<T>());
    return out.all();
  });
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor>
contact_rigid_reverse(DIFFVBD_PARAMETERS(TOUCHING) std::vector<Tensor> at, std::vector<Tensor> motion,
                      std::vector<Tensor> share, std::vector<Tensor> factor, std::vector<Tensor> groups,
                      const Tensor& x_bar, std::vector<int64_t> data_count, double time_step, double friction_eps,
                      bool wants_data) {
  const TouchingFields f{DIFFVBD_ITEMS(TOUCHING)};
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const diffvbd::Corrections all{at, motion, share, factor, groups};
    const auto inputs = all.inputs<T>(f, data_count, time_step, friction_eps, empty(x, {0}));
    const auto& last = inputs.back();
    diffvbd::require_like("x_bar", x_bar, x, 3 * last.scene.scenes * last.scene.vertices);
    const auto make = [&](const std::vector<int64_t>& sizes, bool zeroed) {
      return zeroed ? zeros(x, sizes) : empty(x, sizes);
    };
    const diffvbd::RigidReverseTensors t(f, last, data_count, wants_data,
                                         torch::stable::empty({f.pairs.size(0)}, ScalarType::Byte), make);
    const Tensor solution = doubles({last.scene.scenes, last.bodies(), contact::kUnknowns});
    auto* l = data<double>(solution);
    T *p = data<T>(t.p), *q = data<T>(t.q), *way = data<T>(t.way);
    const auto out = t.out<T>();
    const auto sums = t.pairs.sums<T>();
    const T* end_bar = data<const T>(x_bar);
    for (size_t k = inputs.size(); k-- > 0;) {
      const auto& in = inputs[k];
      const auto* motions = data<const double>(motion[k]);
      diffvbd::rigid_end_backward<T>(in, motions, data<const double>(share[k]), end_bar, l, way, out.vertices.mass);
      diffvbd::rigid_solve<T>(in, data<const double>(factor[k]), l);
      diffvbd::rigid_virtual_motions<T>(in, motions, l, p, q);
      diffvbd::rigid_backward<T>(in, {p, q}, t.pairs.view<T>(), sums);
      diffvbd::rigid_vertices_backward<T>(in, motions, l, way, sums, out);
      end_bar = out.vertices.x;
    }
    return t.all();
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CPU, m) {
  m.impl("contact_rigid_system", TORCH_BOX(&contact_rigid_system));
  m.impl("contact_rigid_move", TORCH_BOX(&contact_rigid_move));
  m.impl("contact_rigid_backward", TORCH_BOX(&contact_rigid_backward));
  m.impl("contact_rigid_reverse", TORCH_BOX(&contact_rigid_reverse));
}
