// CUDA implementations of the operators: tensors in, raw pointers on, on the tensors' device and its current stream.
#include <torch/csrc/inductor/aoti_torch/c/shim.h>
#include <torch/csrc/stable/accelerator.h>
#include <torch/csrc/stable/library.h>

#include <algorithm>
#include <string>
#include <tuple>
#include <vector>

#include "arguments.h"
#include "cuda/reductions.h"
#include "cuda/step.h"

namespace {

namespace cuda = diffvbd::cuda;
using diffvbd::batched, diffvbd::data, diffvbd::dispatch_float, diffvbd::require;
using torch::headeronly::ScalarType;
using torch::stable::Tensor;
using torch::stable::accelerator::DeviceGuard;

constexpr int64_t kWorkspaceBudget = int64_t{2} << 30;  // bytes; a batch that needs more is worked on in chunks
constexpr int kHostSizes = diffvbd::kPlanHeader;        // a plan's header, but active, tets and slots come first

void check(cudaError_t error, const char* what) {
  if (error == cudaSuccess) return;
  if (error == cudaErrorInvalidConfiguration) {
    cudaGetLastError();
    throw std::invalid_argument("regime: this mesh does not fit the shared memory of a thread block of this device");
  }
  cudaGetLastError();  // an error that does not poison the context must not come up again in somebody else's call
  throw std::runtime_error(std::string("diffvbd: ") + what + " failed: " + cudaGetErrorString(error));
}

// Through torch's C interface, whose failure is a number: its C++ wrapper formats a message with streams, which two
// copies of the standard library in one process do not survive.
Tensor empty(const Tensor& like, const std::vector<int64_t>& sizes) {
  std::vector<int64_t> strides(sizes.size(), 1);
  for (size_t i = sizes.size(); i-- > 1;) strides[i - 1] = strides[i] * std::max<int64_t>(1, sizes[i]);
  const bool wide = like.scalar_type() == ScalarType::Double;
  AtenTensorHandle handle = nullptr;
  const auto status = aoti_torch_empty_strided(static_cast<int64_t>(sizes.size()), sizes.data(), strides.data(),
                                               wide ? aoti_torch_dtype_float64() : aoti_torch_dtype_float32(),
                                               aoti_torch_device_type_cuda(), like.get_device_index(), &handle);
  if (status != AOTI_TORCH_SUCCESS) {
    const cudaError_t last = cudaPeekAtLastError();
    if (last != cudaSuccess && last != cudaErrorMemoryAllocation) check(last, "an allocation");
    int64_t bytes = wide ? 8 : 4;
    for (const int64_t n : sizes) bytes *= n;
    throw std::runtime_error("diffvbd: CUDA out of memory, wanted " + std::to_string(bytes) + " bytes more");
  }
  return Tensor(handle);
}

cudaStream_t current_stream(const Tensor& t) {
  void* stream = nullptr;
  require(aoti_torch_get_current_cuda_stream(t.get_device_index(), &stream) == AOTI_TORCH_SUCCESS,
          "diffvbd: no current CUDA stream");
  return static_cast<cudaStream_t>(stream);
}

cuda::HostPlan plan_of(const Tensor& buffer, const std::vector<int64_t>& sizes) {
  require(buffer.scalar_type() == ScalarType::Int && buffer.is_contiguous() && buffer.is_cuda() &&
              sizes.size() > kHostSizes && static_cast<int64_t>(sizes.size()) == kHostSizes + sizes[4] + 1,
          "diffvbd: expected a plan made for CUDA by build_plan, and its sizes");
  const int order[diffvbd::kPlanHeader] = {3, 1, 0, 4, 5, 2, 6, 7, 8, 9, 10};
  int32_t header[diffvbd::kPlanHeader];
  for (int i = 0; i < diffvbd::kPlanHeader; ++i) header[i] = static_cast<int32_t>(sizes[order[i]]);
  return {diffvbd::view_group_plan(header, data<const int32_t>(buffer)), sizes.data() + kHostSizes,
          static_cast<int>(sizes[9]), static_cast<int>(sizes[10])};
}

// What all four sweep operators have in common.
template <class T>
cuda::StepInputs<T> inputs(const cuda::HostPlan& host, const Tensor& x, const Tensor& mu, const Tensor& lam,
                           const Tensor& mass, const Tensor& rest, int64_t energies,
                           const std::vector<int64_t>& data_count, const std::vector<double>& numbers, int64_t sweeps,
                           int64_t tape_policy) {
  const diffvbd::GroupPlan& plan = host.plan;
  require(x.dim() == 3 && x.size(1) == plan.num_vertices && x.size(2) == 3,
          "diffvbd::sweep: expected x of shape [scenes, vertices, 3]");
  const int64_t b = x.size(0);
  cuda::StepInputs<T> in{};
  in.scenes = b;
  in.mu = batched<T>(mu, x, b, plan.num_tets);
  in.lam = batched<T>(lam, x, b, plan.num_tets);
  in.mass = batched<T>(mass, x, b, plan.num_vertices);
  in.rest = batched<T>(rest, x, b, int64_t{plan.slots} * 4 * diffvbd::kSlice);
  constexpr int elastic = diffvbd::kExactBlock | diffvbd::kPaperBlock;
  in.energies = static_cast<int>(plan.num_tets > 0 ? energies : energies & ~elastic);
  in.data_size = diffvbd::energy_data_size(data_count, plan.num_vertices);
  for (int k = 0; k < diffvbd::kVertexEnergies; ++k) in.data_count[k] = static_cast<int>(data_count[k]);
  in.parameters = diffvbd::step_parameters<T>(numbers);
  in.sweeps = diffvbd::count_of(sweeps);
  in.tape_policy = static_cast<int>(tape_policy);
  return in;
}

// The regime and threads per vertex that Python chose, and what the device adds.
cuda::Choice choose(const Tensor& x, const std::vector<int64_t>& launch, bool reverse, int wanted = 0) {
  require(launch.size() == 3 && launch[0] >= cuda::kThread && launch[0] <= cuda::kColor, "diffvbd: bad launch");
  const int64_t lanes = launch[reverse ? 2 : 1];
  require(lanes == cuda::kFewLanes || lanes == cuda::kSomeLanes || lanes == cuda::kManyLanes, "diffvbd: bad launch");
  cuda::Choice out{};
  out.regime = static_cast<int>(launch[0]);
  out.lanes = static_cast<int>(lanes);
  out.wanted = wanted;
  int shared = 0;
  const int device = x.get_device_index();
  check(cudaDeviceGetAttribute(&out.multiprocessors, cudaDevAttrMultiProcessorCount, device), "a device query");
  check(cudaDeviceGetAttribute(&shared, cudaDevAttrMaxSharedMemoryPerBlockOptin, device), "a device query");
  out.shared = shared;
  return out;
}

// Memory for the kernels, and the number of scenes that it serves at once. Chunks of a whole number of waves.
template <class T>
Tensor workspace(const Tensor& x, const cuda::HostPlan& host, const cuda::StepInputs<T>& in,
                 const cuda::StepAdjoints<T>* adjoints, cuda::Choice& choice) {
  if (choice.regime == cuda::kThread) return empty(x, {0});
  choice.chunk = 1;
  const int64_t one = static_cast<int64_t>(cuda::workspace_bytes(host, in, adjoints, choice));
  const int64_t wave = choice.multiprocessors;
  choice.chunk = std::max<int64_t>(1, kWorkspaceBudget / one);
  if (choice.chunk > wave) choice.chunk -= choice.chunk % wave;
  choice.chunk = std::min(choice.chunk, std::max<int64_t>(1, in.scenes));
  const auto bytes = static_cast<int64_t>(cuda::workspace_bytes(host, in, adjoints, choice));
  return empty(x, {(bytes + static_cast<int64_t>(sizeof(T)) - 1) / static_cast<int64_t>(sizeof(T))});
}

// Scenes first, but last where each thread has a scene: who mixes up the two is told so by the shape.
template <class T>
std::vector<int64_t> tape_shape(const cuda::HostPlan& host, const cuda::StepInputs<T>& in,
                                const std::vector<int64_t>& launch) {
  const int64_t rows = diffvbd::tape_rows(in.tape_policy, any_filter(in.energies, diffvbd::VertexEnergies{}));
  const int64_t active = host.plan.num_active;
  if (launch[0] == cuda::kThread) return {in.sweeps, rows, active, in.scenes};
  return {in.scenes, in.sweeps, rows, active};
}

template <class T>
void check_tape(const Tensor& tape, const cuda::HostPlan& host, const cuda::StepInputs<T>& in,
                const std::vector<int64_t>& launch) {
  const std::vector<int64_t> shape = tape_shape(host, in, launch);
  bool same = tape.is_contiguous() && tape.dim() == 4;
  for (int i = 0; same && i < 4; ++i) same = tape.size(i) == shape[i];
  require(same, "diffvbd: the tape does not belong to this step");
}

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
  require(wants.size() == 4 && tape_policy != diffvbd::kNoTape, "diffvbd::sweep_backward: bad arguments");
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    auto in = inputs<T>(host, x, mu, lam, mass, rest, energies, data_count, numbers, sweeps, tape_policy);
    const int64_t b = in.scenes, v = host.plan.num_vertices, t = host.plan.num_tets, v3 = v * 3;
    in.x_prev = batched<T>(x_prev, x, b, v3);
    in.y = batched<T>(y, x, b, v3);
    in.origin = batched<T>(origin, x, b, v3);
    in.data = batched<T>(energy_data, x, b, in.data_size);
    require(x_bar.is_contiguous() && x_bar.numel() == x.numel(), "diffvbd::sweep_backward: x_bar must be like x");
    check_tape(tape, host, in, launch);
    const bool material = wants[0], of_mass = wants[1], of_rest = wants[2], of_data = wants[3];
    const bool elastic = (in.energies & (diffvbd::kExactBlock | diffvbd::kPaperBlock)) != 0;
    const int64_t materials = in.mu.item == 0 && in.lam.item == 0 ? 1 : t;
    const auto wanted = [&](bool flag, const std::vector<int64_t>& shape, bool zeroed) {
      Tensor out = empty(x, flag ? shape : std::vector<int64_t>{0});
      if (flag && zeroed)
        check(cudaMemsetAsync(out.data_ptr(), 0, out.numel() * sizeof(T), current_stream(x)), "memset");
      return out;
    };
    Tensor x_start_bar = empty(x, {b, v, 3}), x_prev_bar = empty(x, {b, v, 3}), y_bar = empty(x, {b, v, 3});
    Tensor mu_bar = wanted(material, {b, materials}, !elastic), lam_bar = wanted(material, {b, materials}, !elastic);
    Tensor mass_bar = wanted(of_mass, {b, v}, false), rest_bar = wanted(of_rest, {b, t, 7}, !elastic);
    Tensor data_bar = wanted(of_data, {b, in.data_size}, false);
    const auto pointer = [&](bool flag, const Tensor& a) { return flag ? data<T>(a) : nullptr; };
    cuda::StepAdjoints<T> out{};
    out.x_bar = data<const T>(x_bar);
    out.x_start = data<T>(x_start_bar), out.x_prev = data<T>(x_prev_bar), out.y = data<T>(y_bar);
    out.mu = pointer(material && elastic, mu_bar), out.lam = pointer(material && elastic, lam_bar);
    out.mass = pointer(of_mass, mass_bar), out.rest = pointer(of_rest && elastic, rest_bar);
    out.data = pointer(of_data && in.data_size > 0, data_bar);
    const int kinds = (out.mu ? diffvbd::kMaterial : 0) | (out.rest ? diffvbd::kMaterial | diffvbd::kRest : 0);
    cuda::Choice choice = choose(x, launch, true, kinds);
    const Tensor work = workspace<T>(x, host, in, &out, choice);
    check(cuda::run_reverse<T>(host, in, data<const T>(x), data<const T>(tape), out, choice, work.data_ptr(),
                               current_stream(x)),
          "the reverse sweep");
    return std::make_tuple(x_start_bar, x_prev_bar, y_bar, mu_bar, lam_bar, mass_bar, rest_bar, data_bar);
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
    const int kinds = (out.mu ? diffvbd::kMaterial : 0) | (out.rest ? diffvbd::kMaterial | diffvbd::kRest : 0);
    cuda::Choice choice = choose(x, launch, true, kinds);
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
