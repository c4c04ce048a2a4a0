// The sweeps of a step and, on CUDA, whole steps: tensors in, raw pointers on.
#include "coarse.h"
#include "contact.h"
#include "plan.h"

namespace diffvbd {
namespace {

// numbers: time_step, regularization, relaxation, saturation (< 0: none), saturation_eps, filter_eta, relaxation of the
// last sweep, motion within a step below which friction is smoothed
// sizes: active vertices, tets, slots of the plan; on CUDA also the rest of its header and color_block (plan_sizes in
// diffvbd/ops/fields.py)
// data_count: scalars per scene, or per vertex, of each energy of one vertex
// launch: on CUDA the regime of the sweeps, that of their reverse, the threads per vertex of both; else empty
// coarse: sizes of the plan of a coarse space, and 1 where the first sweep of the step comes before these; else empty
#define DIFFVBD_SETTINGS                                                                                             \
  In plan, Ints sizes, int64_t energies, Ints data_count, Numbers numbers, int64_t sweeps, Ints launch, Ints coarse, \
      int64_t tape_policy
struct SweepSettings {
  Ints sizes;
  int64_t energies;
  Ints data_count;
  Numbers numbers;
  int64_t sweeps;
  Ints launch, coarse;
  int64_t tape_policy;
};
#define DIFFVBD_SETTINGS_ITEMS {sizes, energies, data_count, numbers, sweeps, launch, coarse, tape_policy}
constexpr size_t kNumbers = 8, kFrictionEps = 7;

#ifdef USE_CUDA
using cuda::StepAdjoints, cuda::StepInputs;
#endif

template <class T>
StepParameters<T> step_parameters(Numbers numbers) {
  require(numbers.size() == kNumbers, "diffvbd: expected 8 numbers");
  const auto at = [&](int i) { return static_cast<T>(numbers[i]); };
  return {at(0), at(1), at(2), at(3), at(4), at(5), at(6), numbers[3] >= 0};
}

// x: where the sweeps start or end. Empty: collider where there is none, lag and the lists after it where nothing is
// lagged, floor_lag without friction on a floor.
template <class T>
contact::ContactInputs<T> contact_inputs(const SweepFields& t, const Tensor& x, const StepInputs<T>& step,
                                         double friction_eps) {
  auto in = lag_inputs<T>(x, t.origin, t.collider, t.kappa, t.pairs, t.constants, t.ptr, t.entry);
  const Reader<T> read(x);
  if (t.lag.numel() > 0) {
    in.lagged = pair_list(t.lag_pairs, t.lag_ptr, t.lag_entry, x, read.b * in.corners);
    in.lag = read.like("lag", t.lag, t.lag_pairs.size(0) * contact::kLagScalars);
  }
  in.collider_prev = read.batch("collider_prev", t.collider_prev, 3 * (in.corners - read.v));
  if (t.floor_lag.numel() > 0) {
    require(read.v > 0, "diffvbd: expected no floor_lag without vertices");
    in.planes = static_cast<int>(t.floor_lag.numel() / t.floor_lag.size(0) / (read.v * contact::kFloorLag));
    in.floor_lag = read.batch("floor_lag", t.floor_lag, read.v * in.planes * contact::kFloorLag);
  }
  in.center = read.vectors("center", t.center), in.trust_radius = read.of_vertices("trust_radius", t.trust_radius);
  in.x_prev = step.x_prev;
  in.friction_eps = static_cast<T>(friction_eps);
  return in;
}

template <class T>
coarse::Inputs<T> coarse_inputs(const SweepFields& f, const Tensor& x, const SweepSettings& q,
                                const StepInputs<T>& step, int64_t positions) {
  require((step.energies & (kContact | kPaperBlock)) == 0 && !step.parameters.saturates,
          "diffvbd::sweep: coarse corrections take no contact, no paper block and no saturation");
  const Reader<T> read(x);
  coarse::Inputs<T> in{};
  in.plan = coarse_plan(f.coarse_plan, x, q.coarse);
  const coarse::Plan& p = in.plan;
  require(p.positions == positions && p.vertices == read.v, "coarse_plan: expected one of this Model's sweeps");
  in.weight = read.like("coarse_weights", f.coarse_weights, 2 * int64_t{p.entries});
  in.row_weight = in.weight + p.entries;
  in.rest = read.batch("coarse_rest", f.coarse_rest, int64_t{p.tet_blocks} * kRestScalars * kLanes);
  in.factor = {read.like("coarse_factor", f.coarse_factor, 9 * int64_t{p.cells} * read.b), 9 * int64_t{p.cells}, 1};
  in.mass = read.batch("coarse_mass", f.coarse_mass, p.cells);
  in.keeps_positions = keeps_positions(step.energies);
  in.has_vertex_blocks = has_vertex_energy(step.energies);
  in.corrections = coarse::corrections_of(step.sweeps, p.every, p.begun);
  return in;
}

// The arrays of a step, and what they point into. x: where the sweeps start or end.
template <class T>
struct Given {
  StepInputs<T> in{};
  contact::ContactInputs<T> pairs{};
  coarse::Inputs<T> coarse{};

  Given(const HostPlan& host, const SweepFields& f, const Tensor& x, const SweepSettings& q) {
    set_body(host, f, x, q);
    const Reader<T> read(x);
    const int64_t v = read.v;
    in.x_start = read.batch("x", x, 3 * v);
    in.x_prev = read.batch("x_prev", f.x_prev, 3 * v);
    in.y = read.batch("y", f.y, 3 * v);
    in.origin = read.batch_or_null("origin", f.origin, 3 * v);
    in.data = read.batch("energy_data", f.energy_data, in.data_size);
    if (f.coarse_plan.numel() > 0) {
      coarse = coarse_inputs<T>(f, x, q, in, int64_t{view_of(host).blocks} * kLanesOfPlan);
      if (!kOnCuda || coarse.plan.bodies > 0) in.coarse = &coarse;
    }
    const bool touches = f.ptr.numel() > 0;
    require(touches == ((q.energies & kContact) != 0),
            "diffvbd::sweep: expected pairs where contact is among the energies");
    if (!touches) return;
    pairs = contact_inputs<T>(f, x, in, q.numbers[kFrictionEps]);
    in.contact = &pairs;
  }
#ifdef USE_CUDA
  // A whole step: the predictor is made of the state.
  Given(const HostPlan& host, const StepFields& f, const SweepSettings& q) {
    set_body(host, f, f.x, q);
    require((in.energies & ~kElastic) == 0, "diffvbd::fused_step: expected no energies of single vertices");
    const Reader<T> read(f.x);
    in.fused = true;
    in.x_prev = read.batch("x", f.x, 3 * read.v);
    in.v = read.batch("v", f.v, 3 * read.v);
    in.acceleration = read.batch("acceleration", f.acceleration, 3 * read.v, 3);
    in.prescribed = read.batch_or_null("prescribed", f.prescribed, 3 * read.v);
  }
#endif
  Given(const Given&) = delete;  // in points into itself

  // Of what is recorded of coarse corrections.
  std::vector<int64_t> corrections_shape() const {
    if (!in.coarse && coarse.corrections == 0) return {0};
    return {in.scenes, coarse.corrections, coarse.tape_size()};
  }
  // Scenes first, but last where each thread has a scene: who mixes up the two is told so by the shape.
  std::vector<int64_t> tape_shape(const HostPlan& host, Ints launch) const {
    const int64_t rows = tape_rows(in.tape_policy, kept_scalars(in.energies)), active = view_of(host).num_active;
    DIFFVBD_ON_CUDA(if (launch[0] == cuda::kThread) return {in.sweeps, rows, active, in.scenes};)
    return {in.scenes, in.sweeps, rows, active};
  }
  // Exponents of limits, of no scenes without contact.
  std::vector<int64_t> truncations_shape(int64_t vertices) const {
    return {in.contact ? in.scenes : 0, int64_t{in.sweeps}, vertices};
  }

 private:
  // What sweeps and whole steps have in common.
  template <class Fields>
  void set_body(const HostPlan& host, const Fields& f, const Tensor& x, const SweepSettings& q) {
    const auto& plan = view_of(host);
    const int64_t vertices = plan.num_vertices, tets = plan.num_tets;
    require(x.dim() == 3 && x.size(1) == vertices && x.size(2) == 3,
            "diffvbd::sweep: expected x of shape [scenes, vertices, 3]");
    constexpr int64_t known = int64_t{1} << (kFirstVertexBit + kVertexEnergies);
    require(q.energies >= 0 && q.energies < known && (q.energies & kElastic) != kElastic,
            "energies: expected a mask of known energies, at most one of them elastic");
    require(q.tape_policy >= kNoTape && q.tape_policy <= kFullTape, "tape_policy: expected 0, 1 or 2");
    const Reader<T> read(x);
    in.scenes = read.b;
    in.energies = static_cast<int>(tets > 0 ? q.energies : q.energies & ~kElastic);
    in.mass = read.batch("mass", f.mass, vertices);
    const bool elastic = (in.energies & kElastic) != 0;
    if (elastic) in.rest = read.batch("rest", f.rest, int64_t{plan.slots} * kRestRowOfPlan * kLanesOfPlan);
    const auto material = material_of(f);
    for (int m = 0; m < kMaterialScalars; ++m) {  // a scene without an elastic energy may have none
      in.material[m] = elastic ? read.batch(kMaterialNames[m], *material[m], tets, 1)
                               : read.batch_or_null(kMaterialNames[m], *material[m], tets, 1);
    }
    in.data_size = energy_data_size(q.data_count, vertices);
    for (int k = 0; k < kVertexEnergies; ++k) {
      in.data_count[k] = static_cast<int>(q.data_count[k]);
      require(!(q.energies >> (kFirstVertexBit + k) & 1) || in.data_count[k] > 0,
              "data_count: expected data of each energy of single vertices");
    }
    in.parameters = step_parameters<T>(q.numbers);
    in.sweeps = count_of(q.sweeps);
    in.tape_policy = static_cast<int>(q.tape_policy);
    DIFFVBD_ON_CUDA(require(q.launch.size() == 4, "diffvbd: bad launch");)
  }
};

int64_t product(Ints sizes) {
  int64_t out = 1;
  for (const int64_t n : sizes) out *= n;
  return out;
}

#ifdef USE_CUDA

// The regime and threads per vertex that Python chose for one direction, and what the device adds. A tape of one regime
// is that of any other, but for a scene per thread.
template <class T>
cuda::Choice choose(const StepInputs<T>& in, const Device& device, Ints launch, bool reverse, int wanted = 0) {
  require((launch[0] == cuda::kThread) == (launch[1] == cuda::kThread), "diffvbd: bad launch");
  const int64_t regime = launch[reverse ? 1 : 0], lanes = launch[reverse ? 3 : 2];
  const int some = reverse ? cuda::kSomeReverseLanes : cuda::kSomeLanes;
  require(regime >= cuda::kThread && regime <= cuda::kColor, "diffvbd: bad launch");
  require(lanes == cuda::kFewLanes || lanes == some || lanes == cuda::kManyLanes, "diffvbd: bad launch");
  cuda::Choice out{};
  out.regime = static_cast<int>(regime);
  out.lanes = static_cast<int>(lanes);
  out.wanted = wanted;
  out.multiprocessors = device.attribute(cudaDevAttrMultiProcessorCount);
  out.shared = device.attribute(cudaDevAttrMaxSharedMemoryPerBlockOptin);
  if (in.contact) out.by_pairs = cuda::kPairBytes;
  require(!in.contact || (out.regime == cuda::kColor && out.lanes != cuda::kFewLanes) ||
              (out.regime == cuda::kGrid && out.lanes == cuda::kManyLanes),
          "diffvbd::sweep: bad launch for contact");
  require(!in.coarse || out.regime != cuda::kThread, "diffvbd::sweep: bad launch for coarse corrections");
  return out;
}

// Memory for the kernels, and the number of scenes that it serves at once. Chunks of a whole number of waves.
template <class T>
Tensor workspace(const Device& device, const HostPlan& host, const StepInputs<T>& in, const StepAdjoints<T>* adjoints,
                 cuda::Choice& choice) {
  if (choice.regime == cuda::kThread) return device.bytes(in.scenes);  // which scenes are rare
  choice.chunk = 1;
  const int64_t one = static_cast<int64_t>(workspace_bytes(host, in, adjoints, choice));
  const int64_t wave = choice.multiprocessors;
  choice.chunk = std::max<int64_t>(1, kWorkspaceBudget / one);
  if (choice.chunk > wave) choice.chunk -= choice.chunk % wave;
  choice.chunk = std::min(choice.chunk, std::max<int64_t>(1, in.scenes));
  const auto bytes = static_cast<int64_t>(workspace_bytes(host, in, adjoints, choice)), size = int64_t{sizeof(T)};
  return device.empty({(bytes + size - 1) / size});
}

template <class T>
void run_reverse(const Device& device, const HostPlan& host, const StepInputs<T>& in, const T* x, const T* tape,
                 const StepAdjoints<T>& out, Ints launch) {
  // the kinds of adjoints that a reverse kernel is compiled for
  const int wanted = (out.material[0] ? kMaterial : 0) | (out.rest || kOwnLaw ? kAllAdjoints : 0);
  cuda::Choice choice = choose(in, device, launch, true, wanted);
  const Tensor work = workspace(device, host, in, &out, choice);
  DIFFVBD_RUN(device, run_reverse<T>, host, in, x, tape, out, choice, work.data_ptr());
}

#endif

// Where the sweeps end, the tape; truncations [scenes, sweeps, vertices]: exponents of limits (contact/limit.h), no
// scenes without contact; corrections [scenes, corrections, 3 functions + bodies]: what coarse corrections have done,
// empty without them.
DIFFVBD_OPERATOR(Out<4>, sweep, DIFFVBD_PARAMETERS(SWEEP) DIFFVBD_SETTINGS, int64_t debug_step, bool checked) {
  const SweepFields f{DIFFVBD_ITEMS(SWEEP)};
  const SweepSettings q DIFFVBD_SETTINGS_ITEMS;
  const Device device(x_start);
  const HostPlan host = plan_of(plan, x_start, sizes);
  return dispatch_float(x_start, [&]<class T>(T) {
    Given<T> given(host, f, x_start, q);
    auto& in = given.in;
#ifndef USE_CUDA
    in.debug_step = debug_step;
    if (checked) check_values(host, in);
#endif
    const int64_t v = view_of(host).num_vertices;
    Tensor x = device.empty({in.scenes, v, 3}), tape = device.empty(given.tape_shape(host, launch));
    const Tensor truncations = device.zeros(given.truncations_shape(v), ScalarType::Byte);
    Tensor corrections = device.empty(given.corrections_shape());
    given.coarse.tape = data<T>(corrections);
#ifdef USE_CUDA
    cuda::Choice choice = choose(in, device, launch, false);
    const Tensor work = workspace<T>(device, host, in, nullptr, choice);
    const cuda::StepOutputs<T> out{data<T>(x), nullptr, data<T>(tape), data<uint8_t>(truncations)};
    DIFFVBD_RUN(device, run_forward<T>, host, in, out, choice, work.data_ptr());
#else
    run_forward<T>(host, in, data<T>(x), data<T>(tape), data<uint8_t>(truncations));
#endif
    return Out<4>(x, tape, truncations, corrections);
  });
}

// Adjoints of the body. `materials`: values of a scene; wants: material, mass, rest.
template <class Bars, class In>
void make_body_bars(Bars& bars, const In& in, const HostPlan& host, const bool (&wants)[3], const Device& device) {
  const auto& plan = view_of(host);
  const int64_t b = in.scenes, vertices = plan.num_vertices, tets = plan.num_tets;
  DIFFVBD_ON_CUDA(const bool shared = one_for_items(in.material);)
  const int64_t materials = DIFFVBD_ON_CUDA(shared ? 1 :) tets;
  const bool clear = !kOnCuda || (in.energies & kElastic) == 0;  // nothing writes what no tet has
  const auto wanted = [&](bool wish, Ints shape, bool zero) { return wish ? device(shape, zero) : device.empty({0}); };
  bars.mu = wanted(wants[0], {b, materials}, clear), bars.lam = wanted(wants[0], {b, materials}, clear);
  bars.mass = wanted(wants[1], {b, vertices}, !kOnCuda);
  bars.rest = wanted(wants[2], {b, tets, kRestScalars}, clear);
}
// A wish for what a scene does not have is null, too.
template <class T, class Bars>
void set_body_bars(StepAdjoints<T>& out, const Bars& bars, const StepInputs<T>& in) {
  if (in.energies & kElastic) {
    const auto material = material_of(bars);
    for (int m = 0; m < kMaterialScalars; ++m) out.material[m] = data_or_null<T>(*material[m]);
    out.rest = data_or_null<T>(bars.rest);
  }
  out.mass = data_or_null<T>(bars.mass);
}

// What the reverse of contact adds up pair by pair and corner by corner.
template <class T>
struct ContactSlots {
  const contact::ContactInputs<T>& in;
  int64_t scenes, listed, lagged;
  Tensor rows, lag_rows, kappa, lag, prev, sent;

#ifdef USE_CUDA
  ContactSlots(const SweepFields& f, const contact::ContactInputs<T>& pairs, const Device& device)
      : in(pairs), scenes(f.x_prev.size(0)), listed(f.pairs.size(0)), lagged(in.lag ? f.lag_pairs.size(0) : 0) {
    const int32_t* entries = in.listed.ptr + scenes * in.corners;
    const int32_t* lag_entries = in.lag ? in.lagged.ptr + scenes * in.corners : nullptr;
    rows = device.empty({listed, 48}), lag_rows = device.rows(lagged, 48, lag_entries);
    kappa = device.rows(listed, 4, entries), lag = device.rows(lagged, 4 * contact::kLagScalars, lag_entries);
    prev = device.zeros({scenes, in.corners, 3}), sent = device.rows(listed, 16, entries, ScalarType::Byte);
  }
#else
  ContactSlots(const SweepFields& f, const contact::ContactInputs<T>& pairs, const Device& device)
      : in(pairs),
        scenes(f.x_prev.size(0)),
        listed(in.listed.ptr[scenes * in.corners] / 4),
        lagged(in.lag ? in.lagged.ptr[scenes * in.corners] / 4 : 0),
        rows(device.empty({48 * listed})),
        lag_rows(device.zeros({48 * lagged})),
        kappa(device.zeros({4 * listed})),
        lag(device.zeros({4 * lagged * contact::kLagScalars})),
        prev(device.zeros({3 * scenes * in.corners})),
        sent(device.zeros({16 * listed}, ScalarType::Byte)) {}
  // in a fixed order
  void sum(const SweepBars& bars) const {
    for (int64_t entry = 0; entry < 4 * listed; ++entry) {
      data<T>(bars.kappa)[in.listed.pairs[contact::kPairRow * (entry / 4) + 5]] += data<T>(kappa)[entry];
    }
    for (int64_t i = 0; i < 4 * lagged * contact::kLagScalars; ++i) {
      const int64_t entry = i / contact::kLagScalars, scalar = i % contact::kLagScalars;
      data<T>(bars.lag)[entry / 4 * contact::kLagScalars + scalar] += data<T>(lag)[i];
    }
    const int64_t corners = in.corners, v = in.num_vertices;
    for (int64_t at = 0; at < scenes * corners; ++at) {
      const int64_t scene = at / corners, corner = at % corners;
      T* to = corner < v ? data<T>(bars.x_prev) + 3 * (scene * v + corner)
                         : data<T>(bars.collider_prev) + 3 * (scene * (corners - v) + corner - v);
      diffvbd::add_to(to, diffvbd::vector_at(data<T>(prev) + 3 * at));
    }
  }
#endif
  contact::ContactAdjoints<T> pointers(const Tensor& floor_lag) const {
    return {data<T>(rows),      data<T>(lag_rows), data<T>(kappa),     data<T>(lag),
            data<T>(floor_lag), data<T>(prev),     data<uint8_t>(sent)};
  }
};

// x: the end of the sweeps; wants: material, mass, rest, energy_data, coarse_factor.
DIFFVBD_OPERATOR(decltype(std::declval<SweepBars>().tensors()), sweep_backward, DIFFVBD_PARAMETERS(SWEEP) In x_bar,
                 In x, In tape, In corrections, In truncations, DIFFVBD_SETTINGS, Flags wants) {
  const SweepFields f{DIFFVBD_ITEMS(SWEEP)};
  const SweepSettings q DIFFVBD_SETTINGS_ITEMS;
  const Device device(x);
  const HostPlan host = plan_of(plan, x, sizes);
  require(tape_policy != kNoTape, "diffvbd::sweep_backward: expected a tape_policy with a tape");
  require(wants.size() == 5, "diffvbd::sweep_backward: expected 5 wishes");
  return dispatch_float(x, [&]<class T>(T) {
    Given<T> given(host, f, x, q);
    auto& in = given.in;
    const Reader<T> read(x);
    const int64_t v = read.v, b = read.b;
    const T* x_bars = read.vectors("x_bar", x_bar);
    const T* taped = read.like("tape", tape, product(given.tape_shape(host, launch)));
    const uint8_t* limits = in.contact ? read.bytes("truncations", truncations, b * in.sweeps * v) : nullptr;
    read.like("corrections", corrections, product(given.corrections_shape()));
    DIFFVBD_ON_CUDA(require(tape.size(0) == given.tape_shape(host, launch)[0], "tape: expected that of this step");)
#ifndef USE_CUDA
    in.debug_step = -1;
#endif
    const auto none = [&] { return device.empty({0}); };
    SweepBars bars{none(), none(), none(), none(), none(), none(), none(),
                   none(), none(), none(), none(), none(), none(), none()};
    bars.x_start = device.empty({b, v, 3}), bars.x_prev = device({b, v, 3}, !kOnCuda), bars.y = device.empty({b, v, 3});
    make_body_bars(bars, in, host, {wants[0], wants[1], wants[2]}, device);
    if (wants[4] && f.coarse_plan.numel() > 0) {
      bars.coarse_factor = device.zeros({b, f.coarse_factor.numel() / std::max<int64_t>(1, b)});
    }
    if (wants[3]) bars.energy_data = device({b, in.data_size}, !kOnCuda);
    StepAdjoints<T> out{};
    set_body_bars(out, bars, in);
    out.x_start = data<T>(bars.x_start), out.x_prev = data<T>(bars.x_prev), out.y = data<T>(bars.y);
    out.data = data_or_null<T>(bars.energy_data);
    given.coarse.tape = data<T>(corrections);
    given.coarse.matrix_bar = data_or_null<T>(bars.coarse_factor);
    DIFFVBD_ON_CUDA(out.x_bar = x_bars, out.limits = limits;)
    const auto run = [&] {
#ifdef USE_CUDA
      run_reverse(device, host, in, data<const T>(x), taped, out, launch);
#else
      run_reverse<T>(host, in, data<const T>(x), x_bars, taped, limits, out);
#endif
    };
    if (!in.contact) {
      run();
      return bars.tensors();
    }
    const ContactSlots<T> slots(f, given.pairs, device);
    const int64_t colliders = given.pairs.corners - v;
    bars.collider = device.zeros({b, colliders, 3}), bars.collider_prev = device.zeros({b, colliders, 3});
    bars.kappa = device.zeros({b});
    bars.lag = device.zeros({kOnCuda ? slots.lagged : f.lag_pairs.numel() / contact::kPairRow, contact::kLagScalars});
    bars.floor_lag = device.zeros({b, v, given.pairs.planes, contact::kFloorLag});
    const auto pointers = slots.pointers(bars.floor_lag);
    out.contact = &pointers;
    out.collider = data<T>(bars.collider);
    DIFFVBD_ON_CUDA(out.collider_prev = data<T>(bars.collider_prev), out.kappa = data<T>(bars.kappa);)
    run();
#ifdef USE_CUDA
    DIFFVBD_RUN(device, sum_lag<T>, given.pairs, b, pointers, slots.lagged, data<T>(bars.lag));
#else
    slots.sum(bars);
#endif
    return bars.tensors();
  });
}

// CUDA only: predictor and velocity in the same launches, for scenes whose only energy is that of the tets. prescribed:
// where pinned vertices go, or empty. In the backward x_bar and v_bar are empty where there is none; wants: x, v,
// acceleration, prescribed, material, mass, rest.
#define DIFFVBD_FUSED_STEP Out<3>, fused_step, DIFFVBD_PARAMETERS(STEP) DIFFVBD_SETTINGS
#define DIFFVBD_FUSED_STEP_BACKWARD                                                                               \
  decltype(std::declval<StepBars>().tensors()), fused_step_backward, DIFFVBD_PARAMETERS(STEP) In x_bar, In v_bar, \
      In x_end, In tape, DIFFVBD_SETTINGS, Flags wants
#define DIFFVBD_EXPANDED(macro, ...) macro(__VA_ARGS__)

#ifndef USE_CUDA
DIFFVBD_EXPANDED(DIFFVBD_SCHEMA, DIFFVBD_FUSED_STEP)
DIFFVBD_EXPANDED(DIFFVBD_SCHEMA, DIFFVBD_FUSED_STEP_BACKWARD)
#else

DIFFVBD_EXPANDED(DIFFVBD_OPERATOR, DIFFVBD_FUSED_STEP) {
  const StepFields f{DIFFVBD_ITEMS(STEP)};
  const SweepSettings q DIFFVBD_SETTINGS_ITEMS;
  const Device device(f.x);
  const HostPlan host = plan_of(plan, f.x, sizes);
  return dispatch_float(f.x, [&]<class T>(T) {
    const Given<T> given(host, f, q);
    const auto& in = given.in;
    Tensor x_end = device.like_x(), v_end = device.like_x(), tape = device.empty(given.tape_shape(host, launch));
    cuda::Choice choice = choose(in, device, launch, false);
    const Tensor work = workspace<T>(device, host, in, nullptr, choice);
    const cuda::StepOutputs<T> out{data<T>(x_end), data<T>(v_end), data<T>(tape)};
    DIFFVBD_RUN(device, run_forward<T>, host, in, out, choice, work.data_ptr());
    return Out<3>(x_end, v_end, tape);
  });
}

DIFFVBD_EXPANDED(DIFFVBD_OPERATOR, DIFFVBD_FUSED_STEP_BACKWARD) {
  const StepFields f{DIFFVBD_ITEMS(STEP)};
  const SweepSettings q DIFFVBD_SETTINGS_ITEMS;
  const Device device(x);
  const HostPlan host = plan_of(plan, f.x, sizes);
  require(wants.size() == 7 && tape_policy != kNoTape, "diffvbd::fused_step_backward: bad arguments");
  return dispatch_float(x, [&]<class T>(T) {
    const Given<T> given(host, f, q);
    const auto& in = given.in;
    const Reader<T> read(x);
    const auto shape = given.tape_shape(host, launch);
    const T *end = read.vectors("x_end", x_end), *taped = read.like("tape", tape, product(shape));
    require(tape.size(0) == shape[0], "tape: expected that of this step");
    const auto state = [&](int i) { return wants[i] ? device.like_x() : device.empty({0}); };
    const auto none = [&] { return device.empty({0}); };
    StepBars bars{state(0), state(1), state(2), state(3), none(), none(), none(), none()};
    make_body_bars(bars, in, host, {wants[4], wants[5], wants[6]}, device);
    StepAdjoints<T> out{};
    set_body_bars(out, bars, in);
    out.x_bar = read.vectors_or_null("x_bar", x_bar), out.v_bar = read.vectors_or_null("v_bar", v_bar);
    out.x = data_or_null<T>(bars.x), out.v = data_or_null<T>(bars.v);
    out.acceleration = data_or_null<T>(bars.acceleration), out.prescribed = data_or_null<T>(bars.prescribed);
    run_reverse(device, host, in, end, taped, out, launch);
    return bars.tensors();
  });
}

#endif

}  // namespace
}  // namespace diffvbd
