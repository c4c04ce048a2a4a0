// CUDA implementations of the operators: tensors in, raw pointers on, on the tensors' device and its current stream.
#include "sweep.h"

#include <torch/csrc/stable/accelerator.h>
#include <torch/csrc/stable/library.h>

#include <algorithm>
#include <tuple>
#include <vector>

#include "../../cuda/reductions.h"
#include "../arguments.h"

namespace {

namespace cuda = diffvbd::cuda;
using cuda::check, cuda::check_tape, cuda::choose, cuda::current_stream, cuda::empty, cuda::inputs, cuda::plan_of;
using cuda::tape_shape, cuda::wishes, cuda::workspace;
using diffvbd::batched, diffvbd::data, diffvbd::dispatch_float, diffvbd::require;
using torch::headeronly::ScalarType;
using torch::stable::Tensor;
using torch::stable::accelerator::DeviceGuard;

std::tuple<Tensor, Tensor> sweep(const Tensor& x_start, const Tensor& x_prev, const Tensor& y, const Tensor& mu,
                                 const Tensor& lam, const Tensor& mass, const Tensor& rest, const Tensor& energy_data,
                                 const Tensor& origin, const Tensor& plan, std::vector<int64_t> sizes, int64_t energies,
                                 std::vector<int64_t> data_count, std::vector<double> numbers, int64_t sweeps,
                                 std::vector<int64_t> launch, int64_t tape_policy, int64_t /*debug_step*/,
                                 bool /*checked*/) {
  const DeviceGuard guard(x_start.get_device_index());
  const cuda::HostPlan host = plan_of(plan, sizes);
  return dispatch_float(x_start, [&](auto scalar) {
    using T = decltype(scalar);
    auto in = inputs<T>(host, x_start, mu, lam, mass, rest, energies, data_count, numbers, sweeps, tape_policy);
    const int64_t v3 = int64_t{host.plan.num_vertices} * 3;
    in.x_start = batched<T>(x_start, x_start, in.scenes, v3);
    in.x_prev = batched<T>(x_prev, x_start, in.scenes, v3);
    in.y = batched<T>(y, x_start, in.scenes, v3);
    in.origin = batched<T>(origin, x_start, in.scenes, v3);
    in.data = batched<T>(energy_data, x_start, in.scenes, in.data_size);
    cuda::Choice choice = choose(x_start, launch, false);
    Tensor x = empty(x_start, {in.scenes, host.plan.num_vertices, 3}),
           tape = empty(x_start, tape_shape(host, in, launch));
    const Tensor work = workspace<T>(x_start, host, in, nullptr, choice);
    check(cuda::run_forward<T>(host, in, {data<T>(x), nullptr, data<T>(tape)}, choice, work.data_ptr(),
                               current_stream(x_start)),
          "the forward sweep");
    return std::make_tuple(x, tape);
  });
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> sweep_backward(
    const Tensor& x_bar, const Tensor& x, const Tensor& x_prev, const Tensor& y, const Tensor& mu, const Tensor& lam,
    const Tensor& mass, const Tensor& rest, const Tensor& energy_data, const Tensor& origin, const Tensor& tape,
    const Tensor& plan, std::vector<int64_t> sizes, int64_t energies, std::vector<int64_t> data_count,
    std::vector<double> numbers, int64_t sweeps, std::vector<int64_t> launch, int64_t tape_policy,
    std::vector<bool> wants) {
  const DeviceGuard guard(x.get_device_index());
  const cuda::HostPlan host = plan_of(plan, sizes);
  require(tape_policy != diffvbd::kNoTape, "diffvbd::sweep_backward: bad arguments");
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    auto in = inputs<T>(host, x, mu, lam, mass, rest, energies, data_count, numbers, sweeps, tape_policy);
    const int64_t b = in.scenes, v3 = int64_t{host.plan.num_vertices} * 3;
    in.x_prev = batched<T>(x_prev, x, b, v3);
    in.y = batched<T>(y, x, b, v3);
    in.origin = batched<T>(origin, x, b, v3);
    in.data = batched<T>(energy_data, x, b, in.data_size);
    check_tape(tape, host, in, launch);
    const cuda::Bars<T> bars(x, in, host, wants);
    cuda::StepAdjoints<T> out = bars.pointers(x_bar);
    cuda::Choice choice = choose(x, launch, true, wishes(out));
    const Tensor work = workspace<T>(x, host, in, &out, choice);
    check(cuda::run_reverse<T>(host, in, data<const T>(x), data<const T>(tape), out, choice, work.data_ptr(),
                               current_stream(x)),
          "the reverse sweep");
    return bars.tensors();
  });
}

// The state of a fused step.
template <class T>
void set_state(cuda::StepInputs<T>& in, const Tensor& x, const Tensor& v, const Tensor& acceleration,
               const Tensor& held) {
  const int64_t v3 = x.size(1) * 3;
  require((in.energies >> 2) == 0, "diffvbd::fused_step: expected no energies of single vertices");
  in.fused = true;
  in.x_prev = batched<T>(x, x, in.scenes, v3);
  in.v = batched<T>(v, x, in.scenes, v3);
  in.acceleration = batched<T>(acceleration, x, in.scenes, v3, 3);
  in.held = batched<T>(held, x, in.scenes, v3);
}

std::tuple<Tensor, Tensor, Tensor> fused_step(const Tensor& x, const Tensor& v, const Tensor& acceleration,
                                              const Tensor& held, const Tensor& mu, const Tensor& lam,
                                              const Tensor& mass, const Tensor& rest, const Tensor& plan,
                                              std::vector<int64_t> sizes, int64_t energies,
                                              std::vector<int64_t> data_count, std::vector<double> numbers,
                                              int64_t sweeps, std::vector<int64_t> launch, int64_t tape_policy) {
  const DeviceGuard guard(x.get_device_index());
  const cuda::HostPlan host = plan_of(plan, sizes);
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    auto in = inputs<T>(host, x, mu, lam, mass, rest, energies, data_count, numbers, sweeps, tape_policy);
    set_state(in, x, v, acceleration, held);
    cuda::Choice choice = choose(x, launch, false);
    Tensor x_end = empty(x, {in.scenes, host.plan.num_vertices, 3}), v_end = empty(x, {in.scenes, x.size(1), 3});
    Tensor tape = empty(x, tape_shape(host, in, launch));
    const Tensor work = workspace<T>(x, host, in, nullptr, choice);
    check(cuda::run_forward<T>(host, in, {data<T>(x_end), data<T>(v_end), data<T>(tape)}, choice, work.data_ptr(),
                               current_stream(x)),
          "the forward step");
    return std::make_tuple(x_end, v_end, tape);
  });
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> fused_step_backward(
    const Tensor& x_bar, const Tensor& v_bar, const Tensor& x_end, const Tensor& x, const Tensor& v,
    const Tensor& acceleration, const Tensor& held, const Tensor& mu, const Tensor& lam, const Tensor& mass,
    const Tensor& rest, const Tensor& tape, const Tensor& plan, std::vector<int64_t> sizes, int64_t energies,
    std::vector<int64_t> data_count, std::vector<double> numbers, int64_t sweeps, std::vector<int64_t> launch,
    int64_t tape_policy, std::vector<bool> wants) {
  const DeviceGuard guard(x.get_device_index());
  const cuda::HostPlan host = plan_of(plan, sizes);
  require(wants.size() == 7 && tape_policy != diffvbd::kNoTape, "diffvbd::fused_step_backward: bad arguments");
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    auto in = inputs<T>(host, x, mu, lam, mass, rest, energies, data_count, numbers, sweeps, tape_policy);
    set_state(in, x, v, acceleration, held);
    for (const Tensor* bar : {&x_bar, &v_bar}) {
      require(bar->numel() == 0 || (bar->is_contiguous() && bar->numel() == x.numel()),
              "diffvbd::fused_step_backward: expected adjoints like x");
    }
    check_tape(tape, host, in, launch);
    const int64_t b = in.scenes, n = host.plan.num_vertices, t = host.plan.num_tets;
    const bool elastic = in.energies != 0;
    const int64_t materials = in.mu.item == 0 && in.lam.item == 0 ? 1 : t;
    const auto wanted = [&](bool flag, const std::vector<int64_t>& shape, bool zeroed) {
      Tensor out = empty(x, flag ? shape : std::vector<int64_t>{0});
      if (flag && zeroed)
        check(cudaMemsetAsync(out.data_ptr(), 0, out.numel() * sizeof(T), current_stream(x)), "memset");
      return out;
    };
    const auto pointer = [&](bool flag, const Tensor& a) { return flag ? data<T>(a) : nullptr; };
    const std::vector<int64_t> state = {b, n, 3};
    Tensor x_in = wanted(wants[0], state, false), v_in = wanted(wants[1], state, false);
    Tensor a_in = wanted(wants[2], state, false), held_in = wanted(wants[3], state, false);
    Tensor mu_bar = wanted(wants[4], {b, materials}, !elastic), lam_bar = wanted(wants[4], {b, materials}, !elastic);
    Tensor mass_bar = wanted(wants[5], {b, n}, false), rest_bar = wanted(wants[6], {b, t, 7}, !elastic);
    cuda::StepAdjoints<T> out{};
    out.x_bar = x_bar.numel() == 0 ? nullptr : data<const T>(x_bar);
    out.v_bar = v_bar.numel() == 0 ? nullptr : data<const T>(v_bar);
    out.x = pointer(wants[0], x_in), out.v = pointer(wants[1], v_in);
    out.acceleration = pointer(wants[2], a_in), out.held = pointer(wants[3], held_in);
    out.mu = pointer(wants[4] && elastic, mu_bar), out.lam = pointer(wants[4] && elastic, lam_bar);
    out.mass = pointer(wants[5], mass_bar), out.rest = pointer(wants[6] && elastic, rest_bar);
    cuda::Choice choice = choose(x, launch, true, wishes(out));
    const Tensor work = workspace<T>(x, host, in, &out, choice);
    check(cuda::run_reverse<T>(host, in, data<const T>(x_end), data<const T>(tape), out, choice, work.data_ptr(),
                               current_stream(x)),
          "the reverse step");
    return std::make_tuple(x_in, v_in, a_in, held_in, mu_bar, lam_bar, mass_bar, rest_bar);
  });
}

Tensor pack_rest(const Tensor& rest, const Tensor& plan, std::vector<int64_t> sizes) {
  const DeviceGuard guard(rest.get_device_index());
  const cuda::HostPlan host = plan_of(plan, sizes);
  require(rest.dim() == 3 && rest.size(1) == host.plan.num_tets && rest.size(2) == 7 && rest.is_contiguous(),
          "diffvbd::pack_rest: expected contiguous rest of shape [scenes, tets, 7]");
  return dispatch_float(rest, [&](auto scalar) {
    using T = decltype(scalar);
    Tensor out = empty(rest, {rest.size(0), host.plan.slots, 4, diffvbd::kSlice});
    check(cuda::pack_rest<T>(host.plan, rest.size(0), data<const T>(rest), data<T>(out), current_stream(rest)),
          "pack_rest");
    return out;
  });
}

Tensor tet_gather(const Tensor& values, const Tensor& tets) {
  const DeviceGuard guard(values.get_device_index());
  require(values.dim() == 3 && values.is_contiguous() && tets.is_contiguous() && tets.is_cuda() &&
              tets.scalar_type() == ScalarType::Long,
          "diffvbd::tet_gather: expected values [scenes, vertices, C] and tets [T, 4] int64");
  return dispatch_float(values, [&](auto scalar) {
    using T = decltype(scalar);
    Tensor out = empty(values, {values.size(0), tets.size(0), 4, values.size(2)});
    check(cuda::gather_rows<T>(data<const T>(values), data<const int64_t>(tets), values.size(0), values.size(1),
                               tets.numel(), values.size(2), data<T>(out), current_stream(values)),
          "tet_gather");
    return out;
  });
}

// Masses are not looked at here: that would wait for the device.
Tensor star_sum(const Tensor& values, const Tensor& star_ptr, const Tensor& star, bool /*positive*/) {
  const DeviceGuard guard(values.get_device_index());
  require(values.dim() == 4 && values.is_contiguous() && star.is_cuda() && star.scalar_type() == ScalarType::Int,
          "diffvbd::star_sum: expected values [scenes, tets, 4, C]");
  return dispatch_float(values, [&](auto scalar) {
    using T = decltype(scalar);
    const int64_t b = values.size(0), n = values.size(1) * 4, c = values.size(3), v = star_ptr.size(0) - 1;
    Tensor out = empty(values, {b, v, c});
    check(cuda::sum_segments<T>(data<const T>(values), data<const int64_t>(star_ptr), data<const int32_t>(star), b, n,
                                v, c, data<T>(out), current_stream(values)),
          "star_sum");
    return out;
  });
}

Tensor row_sum(const Tensor& values) {
  const DeviceGuard guard(values.get_device_index());
  require(values.dim() == 2 && values.is_contiguous(), "diffvbd::row_sum: expected a contiguous matrix");
  return dispatch_float(values, [&](auto scalar) {
    using T = decltype(scalar);
    const int64_t rows = values.size(0), columns = values.size(1);
    Tensor out = empty(values, {rows}), partial = empty(values, {cuda::partial_sums(rows, columns)});
    check(
        cuda::sum_rows<T>(data<const T>(values), rows, columns, data<T>(partial), data<T>(out), current_stream(values)),
        "row_sum");
    return out;
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CUDA, m) {
  m.impl("sweep", TORCH_BOX(&sweep));
  m.impl("sweep_backward", TORCH_BOX(&sweep_backward));
  m.impl("fused_step", TORCH_BOX(&fused_step));
  m.impl("fused_step_backward", TORCH_BOX(&fused_step_backward));
  m.impl("pack_rest", TORCH_BOX(&pack_rest));
  m.impl("tet_gather", TORCH_BOX(&tet_gather));
  m.impl("star_sum", TORCH_BOX(&star_sum));
  m.impl("row_sum", TORCH_BOX(&row_sum));
}
