// CUDA implementations of the operators of sweeps with contact.
#include <torch/csrc/stable/library.h>

#include <tuple>
#include <vector>

#include "../../cuda/contact.h"
#include "../../cuda/lowest.h"
#include "../contact.h"
#include "sweep.h"

namespace {

namespace contact = diffvbd::contact;
namespace cuda = diffvbd::cuda;
using cuda::check, cuda::current_stream, cuda::DeviceGuard, cuda::empty, cuda::zeros;
using diffvbd::ContactTensors, diffvbd::batched, diffvbd::data, diffvbd::dispatch_float, diffvbd::require;
using torch::headeronly::ScalarType;
using torch::stable::Tensor;

// The step's own inputs; x is where the sweeps start or, in the reverse, end.
template <class T>
cuda::StepInputs<T> inputs(const cuda::HostPlan& host, const Tensor& x, const Tensor& x_prev, const Tensor& y,
                           const Tensor& mu, const Tensor& lam, const Tensor& mass, const Tensor& rest,
                           const Tensor& energy_data, const Tensor& origin, int64_t energies,
                           const std::vector<int64_t>& data_count, const std::vector<double>& numbers, int64_t sweeps,
                           int64_t tape_policy) {
  auto in = cuda::inputs<T>(host, x, mu, lam, mass, rest, energies, data_count, numbers, sweeps, tape_policy);
  require(energies & diffvbd::kContact, "diffvbd::contact_sweep: expected contact among the energies");
  const int64_t v3 = int64_t{host.plan.num_vertices} * 3;
  in.x_start = batched<T>(x, x, in.scenes, v3);
  in.x_prev = batched<T>(x_prev, x, in.scenes, v3);
  in.y = batched<T>(y, x, in.scenes, v3);
  in.origin = batched<T>(origin, x, in.scenes, v3);
  in.data = batched<T>(energy_data, x, in.scenes, in.data_size);
  return in;
}

cuda::Choice choose(const Tensor& x, const std::vector<int64_t>& launch, bool reverse, int wanted = 0) {
  cuda::Choice out = cuda::choose(x, launch, reverse, wanted);
  require(out.regime == cuda::kColor && out.lanes != cuda::kFewLanes, "diffvbd::contact_sweep: bad launch");
  return out;
}

std::tuple<Tensor, Tensor, Tensor> contact_sweep(
    const Tensor& x_start, const Tensor& x_prev, const Tensor& y, const Tensor& mu, const Tensor& lam,
    const Tensor& mass, const Tensor& rest, const Tensor& energy_data, const Tensor& origin, const Tensor& bounds,
    const Tensor& collider, const Tensor& collider_prev, const Tensor& kappa, const Tensor& pairs,
    const Tensor& constants, const Tensor& ptr, const Tensor& entry, const Tensor& lag, const Tensor& lag_pairs,
    const Tensor& lag_ptr, const Tensor& lag_entry, const Tensor& floor_lag, double friction_eps, const Tensor& plan,
    std::vector<int64_t> sizes, int64_t energies, std::vector<int64_t> data_count, std::vector<double> numbers,
    int64_t sweeps, std::vector<int64_t> launch, int64_t tape_policy, int64_t /*debug_step*/, bool /*checked*/) {
  const DeviceGuard guard(x_start.get_device_index());
  const cuda::HostPlan host = cuda::plan_of(plan, sizes);
  const ContactTensors given{bounds, collider, collider_prev, kappa,   pairs,     constants, ptr,
                             entry,  lag,      lag_pairs,     lag_ptr, lag_entry, floor_lag};
  return dispatch_float(x_start, [&](auto scalar) {
    using T = decltype(scalar);
    auto in = inputs<T>(host, x_start, x_prev, y, mu, lam, mass, rest, energy_data, origin, energies, data_count,
                        numbers, sweeps, tape_policy);
    const auto pairs_in = diffvbd::contact_inputs<T>(given, x_start, in.x_prev, in.origin, friction_eps);
    in.contact = &pairs_in;
    cuda::Choice choice = choose(x_start, launch, false);
    const int64_t v = host.plan.num_vertices;
    Tensor x = empty(x_start, {in.scenes, v, 3}), tape = empty(x_start, cuda::tape_shape(host, in, launch));
    Tensor cut = empty(x_start, {in.scenes, v}, ScalarType::Byte);
    const cudaStream_t stream = current_stream(x_start);
    if (cut.numel()) check(cudaMemsetAsync(cut.data_ptr(), 0, cut.numel(), stream), "memset");
    const Tensor work = cuda::workspace<T>(x_start, host, in, nullptr, choice);
    check(cuda::run_forward<T>(host, in, {data<T>(x), nullptr, data<T>(tape), data<uint8_t>(cut)}, choice,
                               work.data_ptr(), stream),
          "the forward sweep");
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
                                       double friction_eps, const Tensor& tape, const Tensor& plan,
                                       std::vector<int64_t> sizes, int64_t energies, std::vector<int64_t> data_count,
                                       std::vector<double> numbers, int64_t sweeps, std::vector<int64_t> launch,
                                       int64_t tape_policy, std::vector<bool> wants) {
  const DeviceGuard guard(x.get_device_index());
  const cuda::HostPlan host = cuda::plan_of(plan, sizes);
  const ContactTensors given{bounds, collider, collider_prev, kappa,   pairs,     constants, ptr,
                             entry,  lag,      lag_pairs,     lag_ptr, lag_entry, floor_lag};
  require(tape_policy != diffvbd::kNoTape, "diffvbd::contact_sweep_backward: bad arguments");
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    auto in = inputs<T>(host, x, x_prev, y, mu, lam, mass, rest, energy_data, origin, energies, data_count, numbers,
                        sweeps, tape_policy);
    cuda::check_tape(tape, host, in, launch);
    const auto pairs_in = diffvbd::contact_inputs<T>(given, x, in.x_prev, in.origin, friction_eps);
    in.contact = &pairs_in;
    const int64_t b = in.scenes, v = host.plan.num_vertices, corners = pairs_in.corners;
    const int64_t listed = pairs.size(0), lagged = pairs_in.lag ? lag_pairs.size(0) : 0;
    const Tensor rows = zeros(x, {listed, 48}), lag_rows = zeros(x, {lagged, 48}), kappa_slots = zeros(x, {listed, 4}),
                 prev = zeros(x, {b, corners, 3}), lag_slots = zeros(x, {lagged, 4 * contact::kLagScalars});
    Tensor floor_bar = zeros(x, {b, v, pairs_in.planes, contact::kFloorLag});
    const contact::ContactAdjoints<T> slots{data<T>(rows),      data<T>(lag_rows),  data<T>(kappa_slots),
                                            data<T>(lag_slots), data<T>(floor_bar), data<T>(prev)};
    // Without a vertex nothing runs that would write them.
    Tensor bounds_bar = zeros(x, {b, v, 4}), collider_bar = zeros(x, {b, corners - v, 3}),
           collider_prev_bar = zeros(x, {b, corners - v, 3}), kappa_bar = zeros(x, {b}),
           lag_bar = empty(x, {lagged, contact::kLagScalars});
    const cuda::Bars<T> bars(x, in, host, wants);
    cuda::StepAdjoints<T> out = bars.pointers(x_bar);
    out.contact = &slots;
    out.bounds = data<T>(bounds_bar), out.collider = data<T>(collider_bar);
    out.collider_prev = data<T>(collider_prev_bar), out.kappa = data<T>(kappa_bar);
    cuda::Choice choice = choose(x, launch, true, cuda::wishes(out));
    const Tensor work = cuda::workspace<T>(x, host, in, &out, choice);
    const cudaStream_t stream = current_stream(x);
    check(cuda::run_reverse<T>(host, in, data<const T>(x), data<const T>(tape), out, choice, work.data_ptr(), stream),
          "the reverse sweep");
    check(cuda::sum_lag<T>(slots, lagged, data<T>(lag_bar), stream), "the reverse sweep");
    return std::tuple_cat(bars.tensors(),
                          std::make_tuple(bounds_bar, collider_bar, collider_prev_bar, kappa_bar, lag_bar, floor_bar));
  });
}

// The arrays of contact_lag: corner points and pairs.
template <class T>
contact::ContactInputs<T> lag_inputs(const Tensor& x, const Tensor& origin, const Tensor& collider, const Tensor& kappa,
                                     const Tensor& pairs, const Tensor& constants, const Tensor& ptr,
                                     const Tensor& entry) {
  contact::ContactInputs<T> in{};
  const int64_t b = x.size(0), v = x.size(1), colliders = collider.dim() == 3 ? collider.size(1) : 0;
  in.num_vertices = static_cast<int32_t>(v);
  in.corners = v + colliders;
  in.collider = batched<T>(collider, x, b, 3 * colliders);
  in.origin = batched<T>(origin, x, b, 3 * v);
  in.kappa = batched<T>(kappa, x, b, 1);
  in.listed = diffvbd::pair_list(pairs, ptr, entry, b, in.corners);
  in.constants = data<const T>(constants);
  return in;
}

Tensor contact_lag(const Tensor& x, const Tensor& origin, const Tensor& collider, const Tensor& kappa,
                   const Tensor& pairs, const Tensor& constants, const Tensor& ptr, const Tensor& entry) {
  const DeviceGuard guard(x.get_device_index());
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = lag_inputs<T>(x, origin, collider, kappa, pairs, constants, ptr, entry);
    Tensor out = empty(x, {pairs.size(0), contact::kLagScalars});
    check(cuda::pair_lag<T>(in, data<const T>(x), x.size(0), pairs.size(0), data<T>(out), current_stream(x)),
          "the lag of pairs");
    return out;
  });
}

std::tuple<Tensor, Tensor, Tensor> contact_lag_backward(const Tensor& bar, const Tensor& x, const Tensor& origin,
                                                        const Tensor& collider, const Tensor& kappa,
                                                        const Tensor& pairs, const Tensor& constants, const Tensor& ptr,
                                                        const Tensor& entry) {
  const DeviceGuard guard(x.get_device_index());
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = lag_inputs<T>(x, origin, collider, kappa, pairs, constants, ptr, entry);
    const int64_t b = x.size(0), v = x.size(1);
    Tensor x_bar = empty(x, {b, v, 3}), collider_bar = empty(x, {b, in.corners - v, 3}), kappa_bar = empty(x, {b});
    const Tensor slots = empty(x, {pairs.size(0), 16});
    check(cuda::pair_lag_backward<T>(in, data<const T>(x), b, pairs.size(0), data<const T>(bar), data<T>(slots),
                                     data<T>(x_bar), data<T>(collider_bar), data<T>(kappa_bar), current_stream(x)),
          "the lag of pairs");
    return std::make_tuple(x_bar, collider_bar, kappa_bar);
  });
}

Tensor contact_lowest(const Tensor& x, const Tensor& origin, const Tensor& planes, const Tensor& body_order,
                      const Tensor& body_ptr, const Tensor& island) {
  const DeviceGuard guard(x.get_device_index());
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::lowest_inputs<T>(x, origin, planes, body_order, body_ptr, island);
    const std::vector<int64_t> shape{in.scenes, in.bodies, in.num_planes};
    const Tensor own = empty(x, shape, ScalarType::Int);
    Tensor out = empty(x, shape, ScalarType::Int);
    check(cuda::lowest_vertices<T>(in, data<int32_t>(own), data<int32_t>(out), current_stream(x)),
          "the search for the lowest vertices");
    return out;
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CUDA, m) {
  m.impl("contact_sweep", TORCH_BOX(&contact_sweep));
  m.impl("contact_sweep_backward", TORCH_BOX(&contact_sweep_backward));
  m.impl("contact_lag", TORCH_BOX(&contact_lag));
  m.impl("contact_lag_backward", TORCH_BOX(&contact_lag_backward));
  m.impl("contact_lowest", TORCH_BOX(&contact_lowest));
}
