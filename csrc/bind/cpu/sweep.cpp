// CPU implementations of the sweeps: tensors in, raw pointers on.
#include "sweep.h"

#include <torch/csrc/stable/library.h>

#include <cstring>
#include <tuple>
#include <vector>

namespace {

namespace contact = diffvbd::contact;
using diffvbd::data, diffvbd::dispatch_float, diffvbd::empty, diffvbd::plan_of, diffvbd::require, diffvbd::zeros;
using diffvbd::SweepFields, diffvbd::SweepSettings;
using torch::headeronly::ScalarType;
using torch::stable::Tensor;

// The arrays of a step, and what they point into. x: where the sweeps start or end.
template <class T>
struct Given {
  diffvbd::StepInputs<T> in{};
  contact::ContactInputs<T> pairs{};
  diffvbd::coarse::Inputs<T> coarse{};

  Given(const diffvbd::Plan& plan, const SweepFields& f, const Tensor& x, const SweepSettings& q, int64_t debug_step) {
    const int64_t packed = int64_t{plan.slots} * diffvbd::kPairRest * diffvbd::kLanes;
    diffvbd::set_fields(in, f, x, q, plan.num_vertices, plan.num_tets, packed);
    in.debug_step = debug_step;
    if (f.coarse_plan.numel() > 0) {
      coarse = diffvbd::coarse_inputs<T>(f, x, q, in, int64_t{plan.blocks} * diffvbd::kLanes);
      in.coarse = &coarse;
    }
    if (!diffvbd::has_contact(q, f)) return;
    pairs = diffvbd::contact_inputs<T>(f, x, in.x_prev, in.origin, q.numbers[diffvbd::kFrictionEps]);
    in.contact = &pairs;
  }
  Given(const Given&) = delete;  // in points into itself
};

template <class T>
std::vector<int64_t> corrections_shape(const diffvbd::coarse::Inputs<T>& c, const diffvbd::StepInputs<T>& in) {
  if (!in.coarse) return {0};
  return {in.scenes, c.corrections, c.tape_size()};
}

std::tuple<Tensor, Tensor, Tensor, Tensor> sweep(DIFFVBD_PARAMETERS(SWEEP) const Tensor& plan_buffer,
                                                 std::vector<int64_t> sizes, int64_t energies,
                                                 std::vector<int64_t> data_count, std::vector<double> numbers,
                                                 int64_t sweeps, std::vector<int64_t> launch,
                                                 std::vector<int64_t> coarse, int64_t tape_policy, int64_t debug_step,
                                                 bool checked) {
  const diffvbd::Plan plan = plan_of(plan_buffer, sizes);
  const SweepFields f{DIFFVBD_ITEMS(SWEEP)};
  const SweepSettings q{sizes, energies, data_count, numbers, sweeps, launch, coarse, tape_policy};
  return dispatch_float(f.x_start, [&](auto scalar) {
    using T = decltype(scalar);
    Given<T> given(plan, f, f.x_start, q, debug_step);
    const auto& in = given.in;
    if (checked) diffvbd::check_values(plan, in);
    Tensor x = empty(f.x_start, {in.scenes, plan.num_vertices, 3}),
           tape = empty(f.x_start, diffvbd::tape_shape(plan, in));
    const Tensor cut = torch::stable::empty(diffvbd::cut_shape(in, plan.num_vertices), ScalarType::Byte);
    if (cut.numel() > 0) std::memset(cut.data_ptr(), 0, cut.numel());
    Tensor corrections = empty(f.x_start, corrections_shape(given.coarse, in));
    given.coarse.tape = data<T>(corrections);
    diffvbd::run_forward<T>(plan, in, data<T>(x), data<T>(tape), data<uint8_t>(cut));
    return std::make_tuple(x, tape, cut, corrections);
  });
}

// What the reverse of contact adds up pair by pair and corner by corner, and where it ends.
template <class T>
struct ContactSlots {
  const contact::ContactInputs<T>& in;
  int64_t scenes, listed, lagged;
  diffvbd::Buffer<T> rows, lag_rows, kappa, lag, prev;
  diffvbd::Buffer<uint8_t> sent;

  ContactSlots(const contact::ContactInputs<T>& pairs, int64_t scenes)
      : in(pairs),
        scenes(scenes),
        listed(pairs.listed.ptr[scenes * pairs.corners] / 4),
        lagged(pairs.lag ? pairs.lagged.ptr[scenes * pairs.corners] / 4 : 0),
        rows(48 * listed),
        lag_rows(48 * lagged, true),
        kappa(4 * listed, true),
        lag(4 * lagged * contact::kLagScalars, true),
        prev(3 * scenes * pairs.corners, true),
        sent(16 * listed, true) {}

  contact::ContactAdjoints<T> pointers(T* floor_lag) const {
    return {rows.get(), lag_rows.get(), kappa.get(), lag.get(), floor_lag, prev.get(), sent.get()};
  }
  // in a fixed order
  void sum(const diffvbd::SweepBars& bars) const {
    for (int64_t entry = 0; entry < 4 * listed; ++entry) {
      data<T>(bars.kappa)[in.listed.pairs[contact::kPairRow * (entry / 4) + 5]] += kappa.get()[entry];
    }
    for (int64_t i = 0; i < 4 * lagged * contact::kLagScalars; ++i) {
      const int64_t entry = i / contact::kLagScalars, scalar = i % contact::kLagScalars;
      data<T>(bars.lag)[entry / 4 * contact::kLagScalars + scalar] += lag.get()[i];
    }
    const int64_t corners = in.corners, v = in.num_vertices;
    for (int64_t at = 0; at < scenes * corners; ++at) {
      const int64_t scene = at / corners, corner = at % corners;
      T* to = corner < v ? data<T>(bars.x_prev) + 3 * (scene * v + corner)
                         : data<T>(bars.collider_prev) + 3 * (scene * (corners - v) + corner - v);
      diffvbd::add_to(to, diffvbd::vector_at(prev.get() + 3 * at));
    }
  }
};

diffvbd::SweepAdjoints sweep_backward(DIFFVBD_PARAMETERS(SWEEP) const Tensor& x_bar, const Tensor& x,
                                      const Tensor& tape, const Tensor& corrections, const Tensor& cut,
                                      const Tensor& plan_buffer, std::vector<int64_t> sizes, int64_t energies,
                                      std::vector<int64_t> data_count, std::vector<double> numbers, int64_t sweeps,
                                      std::vector<int64_t> launch, std::vector<int64_t> coarse, int64_t tape_policy,
                                      std::vector<bool> wants) {
  const diffvbd::Plan plan = plan_of(plan_buffer, sizes);
  const SweepFields f{DIFFVBD_ITEMS(SWEEP)};
  const SweepSettings q{sizes, energies, data_count, numbers, sweeps, launch, coarse, tape_policy};
  require(tape_policy != diffvbd::kNoTape, "diffvbd::sweep_backward: expected a tape_policy with a tape");
  diffvbd::require_like("x_bar", x_bar, x, x.numel());
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    Given<T> given(plan, f, x, q, -1);
    const auto& in = given.in;
    diffvbd::check_tape(tape, x, plan, in);
    const uint8_t* limits = diffvbd::limits_of(cut, x, in, plan.num_vertices);
    const auto make = [&](const std::vector<int64_t>& shape, bool zeroed) {
      return zeroed ? zeros(x, shape) : empty(x, shape);
    };
    diffvbd::SweepBars bars = make_bars(x, f, in, plan.num_vertices, plan.num_tets, plan.num_tets, true, wants, make);
    diffvbd::StepAdjoints<T> out{};
    set_bars(out, bars, in);
    int64_t size = 1;
    for (const int64_t n : corrections_shape(given.coarse, in)) size *= n;
    diffvbd::require_like("corrections", corrections, x, size);
    given.coarse.tape = data<T>(corrections);
    given.coarse.matrix_bar = bars.coarse_factor.numel() > 0 ? data<T>(bars.coarse_factor) : nullptr;
    if (!in.contact) {
      diffvbd::run_reverse<T>(plan, in, data<const T>(x), data<const T>(x_bar), data<const T>(tape), limits, out);
      return bars.tensors();
    }
    const ContactSlots<T> slots(given.pairs, in.scenes);
    make_contact_bars(bars, given.pairs, in.scenes, plan.num_vertices, f.lag_pairs.numel() / contact::kPairRow, make);
    const auto pointers = slots.pointers(data<T>(bars.floor_lag));
    out.contact = &pointers;
    out.collider = data<T>(bars.collider);
    diffvbd::run_reverse<T>(plan, in, data<const T>(x), data<const T>(x_bar), data<const T>(tape), limits, out);
    slots.sum(bars);
    return bars.tensors();
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CPU, m) {
  m.impl("sweep", TORCH_BOX(&sweep));
  m.impl("sweep_backward", TORCH_BOX(&sweep_backward));
}
