// CUDA implementations of the sweeps: tensors in, raw pointers on, on the tensors' device and its current stream.
#include "sweep.h"

#include <torch/csrc/stable/library.h>

#include <tuple>
#include <vector>

#include "../../cuda/contact.h"

namespace {

namespace coarse = diffvbd::coarse;
namespace contact = diffvbd::contact;
namespace cuda = diffvbd::cuda;
using cuda::check, cuda::current_stream, cuda::DeviceGuard, cuda::empty, cuda::plan_of, cuda::Zeroed;
using diffvbd::data, diffvbd::dispatch_float, diffvbd::require;
using diffvbd::StepFields, diffvbd::SweepFields, diffvbd::SweepSettings;
using torch::headeronly::ScalarType;
using torch::stable::Tensor;

int64_t packed_size(const cuda::HostPlan& host) { return int64_t{host.plan.slots} * cuda::kRestRow * diffvbd::kSlice; }

// The arrays of a step, and what they point into. x: where the sweeps start or end.
template <class T>
struct Given {
  cuda::StepInputs<T> in{};
  contact::ContactInputs<T> pairs{};
  coarse::Inputs<T> coarse{};

  Given(const cuda::HostPlan& host, const SweepFields& f, const Tensor& x, const SweepSettings& q) {
    diffvbd::set_fields(in, f, x, q, host.plan.num_vertices, host.plan.num_tets, packed_size(host));
    if (f.coarse_plan.numel() > 0) {
      const int64_t positions = int64_t{host.plan.blocks} * diffvbd::kSlice;
      coarse = diffvbd::coarse_inputs<T>(f, x, q, in, positions);
      if (coarse.plan.bodies > 0) in.coarse = &coarse;
    }
    if (!diffvbd::has_contact(q, f)) return;
    pairs = diffvbd::contact_inputs<T>(f, x, in.x_prev, in.origin, q.numbers[diffvbd::kFrictionEps]);
    in.contact = &pairs;
  }
  // A whole step: the predictor is made of the state.
  Given(const cuda::HostPlan& host, const StepFields& f, const SweepSettings& q) {
    diffvbd::set_body(in, f, f.x, q, host.plan.num_vertices, host.plan.num_tets, packed_size(host));
    require((in.energies & ~diffvbd::kElastic) == 0, "diffvbd::fused_step: expected no energies of single vertices");
    const int64_t v3 = f.x.size(1) * 3;
    in.fused = true;
    in.x_prev = diffvbd::batched<T>("x", f.x, f.x, in.scenes, v3);
    in.v = diffvbd::batched<T>("v", f.v, f.x, in.scenes, v3);
    in.acceleration = diffvbd::batched<T>("acceleration", f.acceleration, f.x, in.scenes, v3, 3);
    in.prescribed = diffvbd::batched_or_null<T>("prescribed", f.prescribed, f.x, in.scenes, v3);
  }
  Given(const Given&) = delete;  // in points into itself
};

// What corrections do is recorded here.
template <class T>
std::vector<int64_t> corrections_shape(const Given<T>& given) {
  if (given.coarse.corrections == 0) return {0};
  return {given.in.scenes, given.coarse.corrections, given.coarse.tape_size()};
}

template <class T>
cuda::Choice choose(const cuda::StepInputs<T>& in, const Tensor& x, const SweepSettings& q, bool reverse,
                    int wanted = 0) {
  cuda::Choice out = cuda::choose(x, q.launch, reverse, wanted);
  if (in.contact) out.by_pairs = cuda::kPairBytes;
  require(!in.contact || (out.regime == cuda::kColor && out.lanes != cuda::kFewLanes) ||
              (out.regime == cuda::kGrid && out.lanes == cuda::kManyLanes),
          "diffvbd::sweep: bad launch for contact");
  require(!in.coarse || out.regime != cuda::kThread, "diffvbd::sweep: bad launch for coarse corrections");
  return out;
}

std::tuple<Tensor, Tensor, Tensor, Tensor> sweep(DIFFVBD_PARAMETERS(SWEEP) const Tensor& plan,
                                                 std::vector<int64_t> sizes, int64_t energies,
                                                 std::vector<int64_t> data_count, std::vector<double> numbers,
                                                 int64_t sweeps, std::vector<int64_t> launch,
                                                 std::vector<int64_t> coarse, int64_t tape_policy,
                                                 int64_t /*debug_step*/, bool /*checked*/) {
  const SweepFields f{DIFFVBD_ITEMS(SWEEP)};
  const SweepSettings q{sizes, energies, data_count, numbers, sweeps, launch, coarse, tape_policy};
  const Tensor& from = f.x_start;
  const DeviceGuard guard(from.get_device_index());
  const cuda::HostPlan host = plan_of(plan, from, sizes);
  return dispatch_float(from, [&](auto scalar) {
    using T = decltype(scalar);
    Given<T> given(host, f, from, q);
    const auto& in = given.in;
    cuda::Choice choice = choose(in, from, q, false);
    const int64_t v = host.plan.num_vertices;
    const cudaStream_t stream = current_stream(from);
    Tensor x = empty(from, {in.scenes, v, 3}), tape = empty(from, cuda::tape_shape(host, in, launch));
    const Tensor cut = empty(from, diffvbd::cut_shape(in, v), ScalarType::Byte);
    check(cuda::clear({{cut.data_ptr(), cut.numel()}}, stream), "memory");
    const Tensor corrections = empty(from, corrections_shape(given));
    given.coarse.tape = data<T>(corrections);
    const Tensor work = cuda::workspace<T>(from, host, in, nullptr, choice);
    check(cuda::run_forward<T>(host, in, {data<T>(x), nullptr, data<T>(tape), data<uint8_t>(cut)}, choice,
                               work.data_ptr(), stream),
          "the forward sweep");
    return std::make_tuple(x, tape, cut, corrections);
  });
}

// What the reverse of contact adds up pair by pair and corner by corner.
template <class T>
struct ContactSlots {
  Tensor rows, lag_rows, kappa, lag, prev, sent;
  ContactSlots(const Tensor& x, const contact::ContactInputs<T>& in, int64_t listed, int64_t lagged, Zeroed& zeros)
      : rows(empty(x, {listed, 48})),
        lag_rows(zeros.rows(lagged, 48, in.lag ? in.lagged.ptr + x.size(0) * in.corners : nullptr)),
        kappa(zeros.rows(listed, 4, in.listed.ptr + x.size(0) * in.corners)),
        lag(zeros.rows(lagged, 4 * contact::kLagScalars, in.lag ? in.lagged.ptr + x.size(0) * in.corners : nullptr)),
        prev(zeros({x.size(0), in.corners, 3})),
        sent(zeros.bytes(listed, 16, in.listed.ptr + x.size(0) * in.corners)) {}
  contact::ContactAdjoints<T> pointers(const Tensor& floor_lag) const {
    return {data<T>(rows),      data<T>(lag_rows), data<T>(kappa),     data<T>(lag),
            data<T>(floor_lag), data<T>(prev),     data<uint8_t>(sent)};
  }
};

diffvbd::SweepAdjoints sweep_backward(DIFFVBD_PARAMETERS(SWEEP) const Tensor& x_bar, const Tensor& x,
                                      const Tensor& tape, const Tensor& corrections, const Tensor& cut,
                                      const Tensor& plan, std::vector<int64_t> sizes, int64_t energies,
                                      std::vector<int64_t> data_count, std::vector<double> numbers, int64_t sweeps,
                                      std::vector<int64_t> launch, std::vector<int64_t> coarse, int64_t tape_policy,
                                      std::vector<bool> wants) {
  const SweepFields f{DIFFVBD_ITEMS(SWEEP)};
  const SweepSettings q{sizes, energies, data_count, numbers, sweeps, launch, coarse, tape_policy};
  const DeviceGuard guard(x.get_device_index());
  const cuda::HostPlan host = plan_of(plan, x, sizes);
  require(tape_policy != diffvbd::kNoTape, "diffvbd::sweep_backward: expected a tape_policy with a tape");
  diffvbd::require_like("x_bar", x_bar, x, x.numel());
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    Given<T> given(host, f, x, q);
    const auto& in = given.in;
    cuda::check_tape(tape, x, host, in, launch);
    int64_t recorded = 1;
    for (const int64_t n : corrections_shape(given)) recorded *= n;
    diffvbd::require_like("corrections", corrections, x, recorded);
    Zeroed zeros(x);
    const auto make = [&](const std::vector<int64_t>& shape, bool zeroed) {
      return zeroed ? zeros(shape) : empty(x, shape);
    };
    const int64_t v = host.plan.num_vertices, t = host.plan.num_tets;
    const int64_t materials = diffvbd::one_for_items(in.material) ? 1 : t;
    diffvbd::SweepBars bars = diffvbd::make_bars(x, f, in, v, t, materials, false, wants, make);
    cuda::StepAdjoints<T> out{};
    diffvbd::set_bars(out, bars, in);
    out.x_bar = data<const T>(x_bar);
    out.limits = diffvbd::limits_of(cut, x, in, v);
    given.coarse.tape = data<T>(corrections);
    given.coarse.matrix_bar = bars.coarse_factor.numel() > 0 ? data<T>(bars.coarse_factor) : nullptr;
    const cudaStream_t stream = current_stream(x);
    const auto run = [&] {
      zeros.clear();
      cuda::Choice choice = choose(in, x, q, true, cuda::wishes(out));
      const Tensor work = cuda::workspace<T>(x, host, in, &out, choice);
      check(cuda::run_reverse<T>(host, in, data<const T>(x), data<const T>(tape), out, choice, work.data_ptr(), stream),
            "the reverse sweep");
    };
    if (!in.contact) {
      run();
      return bars.tensors();
    }
    const int64_t lagged = given.pairs.lag ? f.lag_pairs.size(0) : 0;
    const ContactSlots<T> slots(x, given.pairs, f.pairs.size(0), lagged, zeros);
    diffvbd::make_contact_bars(bars, given.pairs, in.scenes, v, lagged, make);
    const auto pointers = slots.pointers(bars.floor_lag);
    out.contact = &pointers;
    out.collider = data<T>(bars.collider);
    out.collider_prev = data<T>(bars.collider_prev), out.kappa = data<T>(bars.kappa);
    run();
    check(cuda::sum_lag<T>(given.pairs, in.scenes, pointers, lagged, data<T>(bars.lag), stream), "the reverse sweep");
    return bars.tensors();
  });
}

std::tuple<Tensor, Tensor, Tensor> fused_step(DIFFVBD_PARAMETERS(STEP) const Tensor& plan, std::vector<int64_t> sizes,
                                              int64_t energies, std::vector<int64_t> data_count,
                                              std::vector<double> numbers, int64_t sweeps, std::vector<int64_t> launch,
                                              std::vector<int64_t> coarse, int64_t tape_policy) {
  const StepFields f{DIFFVBD_ITEMS(STEP)};
  const SweepSettings q{sizes, energies, data_count, numbers, sweeps, launch, coarse, tape_policy};
  const DeviceGuard guard(f.x.get_device_index());
  const cuda::HostPlan host = plan_of(plan, f.x, sizes);
  return dispatch_float(f.x, [&](auto scalar) {
    using T = decltype(scalar);
    const Given<T> given(host, f, q);
    const auto& in = given.in;
    cuda::Choice choice = choose(in, f.x, q, false);
    const std::vector<int64_t> state{in.scenes, host.plan.num_vertices, 3};
    Tensor x = empty(f.x, state), v = empty(f.x, state), tape = empty(f.x, cuda::tape_shape(host, in, launch));
    const Tensor work = cuda::workspace<T>(f.x, host, in, nullptr, choice);
    check(cuda::run_forward<T>(host, in, {data<T>(x), data<T>(v), data<T>(tape)}, choice, work.data_ptr(),
                               current_stream(f.x)),
          "the forward step");
    return std::make_tuple(x, v, tape);
  });
}

diffvbd::FusedAdjoints fused_step_backward(DIFFVBD_PARAMETERS(STEP) const Tensor& x_bar, const Tensor& v_bar,
                                           const Tensor& x_end, const Tensor& tape, const Tensor& plan,
                                           std::vector<int64_t> sizes, int64_t energies,
                                           std::vector<int64_t> data_count, std::vector<double> numbers, int64_t sweeps,
                                           std::vector<int64_t> launch, std::vector<int64_t> coarse,
                                           int64_t tape_policy, std::vector<bool> wants) {
  const StepFields f{DIFFVBD_ITEMS(STEP)};
  const SweepSettings q{sizes, energies, data_count, numbers, sweeps, launch, coarse, tape_policy};
  const DeviceGuard guard(x.get_device_index());
  const cuda::HostPlan host = plan_of(plan, f.x, sizes);
  require(wants.size() == 7 && tape_policy != diffvbd::kNoTape, "diffvbd::fused_step_backward: bad arguments");
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    if (x_bar.numel() > 0) diffvbd::require_like("x_bar", x_bar, x, x.numel());
    if (v_bar.numel() > 0) diffvbd::require_like("v_bar", v_bar, x, x.numel());
    diffvbd::require_like("x_end", x_end, x, x.numel());
    const Given<T> given(host, f, q);
    const auto& in = given.in;
    cuda::check_tape(tape, x, host, in, launch);
    Zeroed zeros(x);
    const auto make = [&](const std::vector<int64_t>& shape, bool zeroed) {
      return zeroed ? zeros(shape) : empty(x, shape);
    };
    const int64_t n = host.plan.num_vertices, t = host.plan.num_tets;
    const auto state = [&](int i) {
      return empty(x, wants[i] ? std::vector<int64_t>{in.scenes, n, 3} : std::vector<int64_t>{0});
    };
    const auto none = [&] { return empty(x, {0}); };
    diffvbd::StepBars bars{state(0), state(1), state(2), state(3), none(), none(), none(), none()};
    diffvbd::make_body_bars(bars, in, n, t, diffvbd::one_for_items(in.material) ? 1 : t, false,
                            {wants[4], wants[5], wants[6]}, make);
    cuda::StepAdjoints<T> out{};
    diffvbd::set_body_bars(out, bars, in);
    const auto pointer = [](const Tensor& a) { return a.numel() > 0 ? data<T>(a) : nullptr; };
    out.x_bar = pointer(x_bar), out.v_bar = pointer(v_bar);
    out.x = pointer(bars.x), out.v = pointer(bars.v);
    out.acceleration = pointer(bars.acceleration), out.prescribed = pointer(bars.prescribed);
    cuda::Choice choice = choose(in, x, q, true, cuda::wishes(out));
    const Tensor work = cuda::workspace<T>(x, host, in, &out, choice);
    zeros.clear();
    check(cuda::run_reverse<T>(host, in, data<const T>(x_end), data<const T>(tape), out, choice, work.data_ptr(),
                               current_stream(x)),
          "the reverse step");
    return bars.tensors();
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CUDA, m) {
  m.impl("sweep", TORCH_BOX(&sweep));
  m.impl("sweep_backward", TORCH_BOX(&sweep_backward));
  m.impl("fused_step", TORCH_BOX(&fused_step));
  m.impl("fused_step_backward", TORCH_BOX(&fused_step_backward));
}
