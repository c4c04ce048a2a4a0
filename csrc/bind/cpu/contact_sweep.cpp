// CPU implementations of the operators of sweeps with contact.
#include <torch/csrc/stable/library.h>

#include <tuple>
#include <vector>

#include "../../contact/lag.h"
#include "../contact.h"
#include "sweep.h"

namespace {

using diffvbd::Bars, diffvbd::ContactTensors, diffvbd::data, diffvbd::dispatch_float, diffvbd::empty, diffvbd::zeros;
using diffvbd::require;
using torch::headeronly::ScalarType;
using torch::stable::Tensor;
namespace contact = diffvbd::contact;

std::tuple<Tensor, Tensor, Tensor> contact_sweep(
    const Tensor& x_start, const Tensor& x_prev, const Tensor& y, const Tensor& mu, const Tensor& lam,
    const Tensor& mass, const Tensor& rest, const Tensor& energy_data, const Tensor& origin, const Tensor& bounds,
    const Tensor& collider, const Tensor& collider_prev, const Tensor& kappa, const Tensor& pairs,
    const Tensor& constants, const Tensor& ptr, const Tensor& entry, const Tensor& lag, const Tensor& lag_pairs,
    const Tensor& lag_ptr, const Tensor& lag_entry, const Tensor& floor_lag, double friction_eps,
    const Tensor& plan_buffer, std::vector<int64_t> sizes, int64_t energies, std::vector<int64_t> data_count,
    std::vector<double> numbers, int64_t sweeps, std::vector<int64_t> /*launch*/, int64_t tape_policy,
    int64_t debug_step, bool checked) {
  const diffvbd::Plan plan = diffvbd::plan_of(plan_buffer, sizes);
  const ContactTensors given{bounds, collider, collider_prev, kappa,   pairs,     constants, ptr,
                             entry,  lag,      lag_pairs,     lag_ptr, lag_entry, floor_lag};
  return dispatch_float(x_start, [&](auto scalar) {
    using T = decltype(scalar);
    auto in = diffvbd::inputs<T>(plan, x_start, x_prev, y, mu, lam, mass, rest, energy_data, origin, energies,
                                 data_count, numbers, sweeps, tape_policy, debug_step);
    require(energies & diffvbd::kContact, "diffvbd::contact_sweep: expected contact among the energies");
    if (checked) diffvbd::check_values(plan, in);
    const auto pairs_in = diffvbd::contact_inputs<T>(given, x_start, in.x_prev, in.origin, friction_eps);
    in.contact = &pairs_in;
    Tensor x = empty(x_start, {in.scenes, plan.num_vertices, 3}), tape = empty(x_start, diffvbd::tape_shape(plan, in));
    Tensor cut = torch::stable::empty({in.scenes, plan.num_vertices}, ScalarType::Byte);
    diffvbd::run_forward<T>(plan, in, data<T>(x), data<T>(tape), data<uint8_t>(cut));
    return std::make_tuple(x, tape, cut);
  });
}

using FourteenTensors = std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor,
                                   Tensor, Tensor, Tensor, Tensor>;

FourteenTensors contact_sweep_backward(const Tensor& x_bar, const Tensor& x, const Tensor& x_prev, const Tensor& y,
                                       const Tensor& mu, const Tensor& lam, const Tensor& mass, const Tensor& rest,
                                       const Tensor& energy_data, const Tensor& origin, const Tensor& bounds,
                                       const Tensor& collider, const Tensor& collider_prev, const Tensor& kappa,
                                       const Tensor& pairs, const Tensor& constants, const Tensor& ptr,
                                       const Tensor& entry, const Tensor& lag, const Tensor& lag_pairs,
                                       const Tensor& lag_ptr, const Tensor& lag_entry, const Tensor& floor_lag,
                                       double friction_eps, const Tensor& tape, const Tensor& plan_buffer,
                                       std::vector<int64_t> sizes, int64_t energies, std::vector<int64_t> data_count,
                                       std::vector<double> numbers, int64_t sweeps, std::vector<int64_t> /*launch*/,
                                       int64_t tape_policy, std::vector<bool> wants) {
  const diffvbd::Plan plan = diffvbd::plan_of(plan_buffer, sizes);
  const ContactTensors given{bounds, collider, collider_prev, kappa,   pairs,     constants, ptr,
                             entry,  lag,      lag_pairs,     lag_ptr, lag_entry, floor_lag};
  require(tape_policy != diffvbd::kNoTape, "diffvbd::contact_sweep_backward: bad arguments");
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    auto in = diffvbd::inputs<T>(plan, x, x_prev, y, mu, lam, mass, rest, energy_data, origin, energies, data_count,
                                 numbers, sweeps, tape_policy, -1);
    require(x_bar.is_contiguous() && x_bar.numel() == x.numel(), "diffvbd::sweep_backward: x_bar must be like x");
    diffvbd::check_tape(tape, plan, in);
    const auto pairs_in = diffvbd::contact_inputs<T>(given, x, in.x_prev, in.origin, friction_eps);
    in.contact = &pairs_in;
    const int64_t b = in.scenes, v = plan.num_vertices, corners = pairs_in.corners;
    const int64_t listed = pairs_in.listed.ptr[b * corners] / 4;
    const int64_t lagged = pairs_in.lag ? pairs_in.lagged.ptr[b * corners] / 4 : 0;
    const diffvbd::Buffer<T> rows(48 * listed, true), lag_rows(48 * lagged, true), kappa_slots(4 * listed, true),
        lag_slots(4 * lagged * contact::kLagScalars, true), prev(3 * b * corners, true);
    Tensor floor_bar = zeros(x, {b, v, pairs_in.planes, contact::kFloorLag});
    contact::ContactAdjoints<T> slots{rows.get(),      lag_rows.get(),     kappa_slots.get(),
                                      lag_slots.get(), data<T>(floor_bar), prev.get()};
    Tensor bounds_bar = empty(x, {b, v, 4}), collider_bar = zeros(x, {b, corners - v, 3}),
           collider_prev_bar = zeros(x, {b, corners - v, 3}), kappa_bar = zeros(x, {b}),
           lag_bar = zeros(x, {lag_pairs.numel() / contact::kPairRow, contact::kLagScalars});
    const Bars bars(x, plan, data_count, wants);
    diffvbd::StepAdjoints<T> out = bars.pointers<T>();
    out.contact = &slots;
    out.bounds = data<T>(bounds_bar);
    out.collider = data<T>(collider_bar);
    diffvbd::run_reverse<T>(plan, in, data<const T>(x), data<const T>(x_bar), data<const T>(tape), out);

    for (int64_t entry = 0; entry < 4 * listed; ++entry) {
      data<T>(kappa_bar)[pairs_in.listed.pairs[contact::kPairRow * (entry / 4) + 5]] += kappa_slots.get()[entry];
    }
    for (int64_t i = 0; i < 4 * lagged * contact::kLagScalars; ++i) {
      const int64_t entry = i / contact::kLagScalars, scalar = i % contact::kLagScalars;
      data<T>(lag_bar)[entry / 4 * contact::kLagScalars + scalar] += lag_slots.get()[i];
    }
    for (int64_t at = 0; at < b * corners; ++at) {
      const int64_t scene = at / corners, corner = at % corners;
      T* to = corner < v ? data<T>(bars.x_prev) + 3 * (scene * v + corner)
                         : data<T>(collider_prev_bar) + 3 * (scene * (corners - v) + corner - v);
      contact::add_at(to, contact::vector_at(prev.get() + 3 * at));
    }
    return std::tuple_cat(bars.tensors(),
                          std::make_tuple(bounds_bar, collider_bar, collider_prev_bar, kappa_bar, lag_bar, floor_bar));
  });
}

// Positions in the user's numbering.
template <class T>
struct UserPositions {
  const T* x;
  diffvbd::Vec3<T> operator()(int v) const { return contact::vector_at(x + int64_t{3} * v); }
};

template <class T>
contact::ContactInputs<T> lag_inputs(const Tensor& x, const Tensor& origin, const Tensor& collider) {
  contact::ContactInputs<T> in{};
  const int64_t b = x.size(0), v = x.size(1), colliders = collider.dim() == 3 ? collider.size(1) : 0;
  in.num_vertices = static_cast<int32_t>(v);
  in.corners = v + colliders;
  in.collider = diffvbd::batched<T>(collider, x, b, 3 * colliders);
  in.origin = diffvbd::batched<T>(origin, x, b, 3 * v);
  return in;
}

// Calls f(pair, kind, corners, constants, kappa) for each listed pair.
template <class T, class F>
void each_pair(const Tensor& x, const Tensor& origin, const Tensor& collider, const Tensor& kappa, const Tensor& pairs,
               const Tensor& constants, int64_t count, const F& f) {
  const auto in = lag_inputs<T>(x, origin, collider);
  const auto stiffness = diffvbd::batched<T>(kappa, x, x.size(0), 1);
  for (int64_t pair = 0; pair < count; ++pair) {
    const int32_t* record = data<const int32_t>(pairs) + contact::kPairRow * pair;
    const UserPositions<T> positions{data<const T>(x) + int64_t{record[5]} * 3 * in.num_vertices};
    const contact::Source<T, UserPositions<T>> source{in, record[5], positions};
    const contact::PairConstants<T> a(data<const T>(constants) + contact::kConstants * pair);
    f(pair, record, source.corners(record), a, stiffness.data[record[5] * stiffness.scene]);
  }
}

Tensor contact_lag(const Tensor& x, const Tensor& origin, const Tensor& collider, const Tensor& kappa,
                   const Tensor& pairs, const Tensor& constants, const Tensor& ptr, const Tensor& /*entry*/) {
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    Tensor out = zeros(x, {pairs.size(0), contact::kLagScalars});
    const int64_t count = data<const int32_t>(ptr)[ptr.numel() - 1] / 4;
    each_pair<T>(x, origin, collider, kappa, pairs, constants, count,
                 [&](int64_t pair, const int32_t* record, const auto& corners, const auto& a, T stiffness) {
                   contact::store_lag(contact::lag_state(record[4], corners, a, stiffness),
                                      data<T>(out) + contact::kLagScalars * pair);
                 });
    return out;
  });
}

std::tuple<Tensor, Tensor, Tensor> contact_lag_backward(const Tensor& bar, const Tensor& x, const Tensor& origin,
                                                        const Tensor& collider, const Tensor& kappa,
                                                        const Tensor& pairs, const Tensor& constants, const Tensor& ptr,
                                                        const Tensor& /*entry*/) {
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const int64_t b = x.size(0), v = x.size(1), colliders = collider.dim() == 3 ? collider.size(1) : 0;
    Tensor x_bar = zeros(x, {b, v, 3}), collider_bar = zeros(x, {b, colliders, 3}), kappa_bar = zeros(x, {b});
    const int64_t count = data<const int32_t>(ptr)[ptr.numel() - 1] / 4;
    each_pair<T>(x, origin, collider, kappa, pairs, constants, count,
                 [&](int64_t pair, const int32_t* record, const auto& corners, const auto& a, T stiffness) {
                   contact::PairAdjoint<T> out;
                   contact::reverse_lag(record[4], corners, a, stiffness,
                                        data<const T>(bar) + contact::kLagScalars * pair, out);
                   const int64_t scene = record[5];
                   for (int k = 0; k < 4; ++k) {
                     T* to = record[k] < v ? data<T>(x_bar) + 3 * (scene * v + record[k])
                                           : data<T>(collider_bar) + 3 * (scene * colliders + record[k] - v);
                     contact::add_at(to, out.x[k]);
                   }
                   data<T>(kappa_bar)[scene] += out.kappa;
                 });
    return std::make_tuple(x_bar, collider_bar, kappa_bar);
  });
}

Tensor contact_lowest(const Tensor& x, const Tensor& origin, const Tensor& planes, const Tensor& body_order,
                      const Tensor& body_ptr, const Tensor& island) {
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::lowest_inputs<T>(x, origin, planes, body_order, body_ptr, island);
    Tensor out = torch::stable::empty({in.scenes, in.bodies, in.num_planes}, ScalarType::Int);
    std::vector<int32_t> own(out.numel());
    const auto each = [&](auto&& f) {
      int64_t i = 0;
      for (int64_t b = 0; b < in.scenes; ++b) {
        for (int32_t body = 0; body < in.bodies; ++body) {
          for (int32_t plane = 0; plane < in.num_planes; ++plane) f(i++, b, body, plane);
        }
      }
    };
    each([&](int64_t i, int64_t b, int32_t body, int32_t plane) {
      own[i] = contact::lowest_of_body(in, b, body, plane, 0, 1).vertex;
    });
    each([&](int64_t i, int64_t b, int32_t body, int32_t plane) {
      const int32_t first = in.island[b * in.bodies + body];
      int32_t* to = data<int32_t>(out);
      to[i] = first >= 0 && first < body ? to[i - int64_t{body - first} * in.num_planes]  // that of its first body
                                         : contact::lowest_of_island(in, own.data(), b, body, plane);
    });
    return out;
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CPU, m) {
  m.impl("contact_sweep", TORCH_BOX(&contact_sweep));
  m.impl("contact_sweep_backward", TORCH_BOX(&contact_sweep_backward));
  m.impl("contact_lag", TORCH_BOX(&contact_lag));
  m.impl("contact_lag_backward", TORCH_BOX(&contact_lag_backward));
  m.impl("contact_lowest", TORCH_BOX(&contact_lowest));
}
