// From tensors to raw pointers: what the registrations of all backends share.
#pragma once

#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/core/ScalarType.h>

#include <limits>
#include <stdexcept>
#include <string>
#include <vector>

#include "../core/views.h"
#include "../energies/energies.h"

namespace diffvbd {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;

inline void require(bool condition, const char* message) {
  if (!condition) throw std::invalid_argument(message);
}

template <class F>
auto dispatch_float(const Tensor& t, F&& f) {
  require(t.scalar_type() == ScalarType::Double || t.scalar_type() == ScalarType::Float,
          "diffvbd: expected float64 or float32 tensors");
  return t.scalar_type() == ScalarType::Double ? f(double{}) : f(float{});
}

template <class T>
T* data(const Tensor& t) {
  return static_cast<T*>(t.data_ptr());
}

// A contiguous tensor of this dtype where `like` is. What indices hold is not looked at: on CUDA that would wait.
inline bool is_beside(const Tensor& t, const Tensor& like, ScalarType dtype) {
  return t.is_contiguous() && t.scalar_type() == dtype && t.is_cuda() == like.is_cuda() &&
         t.get_device_index() == like.get_device_index();
}
inline bool is_like(const Tensor& t, const Tensor& like) { return is_beside(t, like, like.scalar_type()); }
inline bool is_index(const Tensor& t, const Tensor& like) { return is_beside(t, like, ScalarType::Int); }

inline void require_positions(const Tensor& x) {
  require(x.dim() == 3 && x.size(2) == 3 && x.is_contiguous(),
          "diffvbd: expected contiguous x of shape [scenes, vertices, 3]");
}

// Text only: streams are left out for the reason that cuda/binding.h gives.
[[noreturn]] inline void refuse(const char* name, const std::string& expected, const Tensor& t) {
  std::string got = std::string(torch::headeronly::toString(t.scalar_type())) + " [";
  for (int64_t k = 0; k < t.dim(); ++k) got += (k > 0 ? ", " : "") + std::to_string(t.size(k));
  got += t.is_cuda() ? "] on cuda:" + std::to_string(t.get_device_index()) : "] on the CPU";
  throw std::invalid_argument("diffvbd: " + std::string(name) + ": expected " + expected + ", got " + got +
                              (t.is_contiguous() ? "" : ", not contiguous"));
}
inline void require_like(const char* name, const Tensor& t, const Tensor& like, int64_t numel) {
  if (is_like(t, like) && t.numel() == numel) return;
  refuse(name, std::to_string(numel) + " contiguous scalars of the dtype and on the device of x", t);
}

// [1 | B, ...] contiguous -> pointer and strides. `items` scalars for a scene, or one group of `own` that all share
// where the kernels know of that: 0 says that they do not.
template <class T>
Batched<const T> batched(const char* name, const Tensor& t, const Tensor& like, int64_t scenes, int64_t items,
                         int64_t own = 0) {
  if (t.numel() == 0 && scenes * items == 0) return {};
  const int64_t given = t.dim() > 0 ? t.size(0) : 0, per_scene = given > 0 ? t.numel() / given : 0;
  if (!is_like(t, like) || (given != 1 && given != scenes) || per_scene == 0 ||
      (per_scene != items && per_scene != own)) {
    const std::string shared = own > 0 && own != items ? " or " + std::to_string(own) : "";
    refuse(name,
           "[1 or " + std::to_string(scenes) + " scenes, ...] with " + std::to_string(items) + shared +
               " scalars each, contiguous, of the dtype and on the device of x",
           t);
  }
  return {data<const T>(t), given == 1 ? 0 : per_scene, per_scene == items ? 1 : 0};
}
// The same for what a scene may lack: an empty tensor gives null.
template <class T>
Batched<const T> batched_or_null(const char* name, const Tensor& t, const Tensor& like, int64_t scenes, int64_t items,
                                 int64_t own = 0) {
  return t.numel() == 0 ? Batched<const T>{} : batched<T>(name, t, like, scenes, items, own);
}

// Of SweepSettings: those of StepParameters, and the motion below which friction is smoothed [m].
constexpr int kNumbers = 8, kFrictionEps = 7;

template <class T>
StepParameters<T> step_parameters(const std::vector<double>& numbers) {
  require(numbers.size() == kNumbers, "diffvbd: expected 8 numbers");
  const auto at = [&](int i) { return static_cast<T>(numbers[i]); };
  return {at(0), at(1), at(2), at(3), at(4), at(5), at(6), numbers[3] >= 0};
}

// Scalars of the energies' data for a scene.
inline int64_t energy_data_size(const std::vector<int64_t>& data_count, int64_t num_vertices) {
  require(data_count.size() == kVertexEnergies, "data_count: expected a count for each energy of single vertices");
  int64_t total = 0, scalars = 0;
  for (int k = 0; k < kVertexEnergies; ++k) {
    const int64_t count = data_count[k], stride = data_stride(k, VertexEnergies{});
    // records of a scene, or one of each vertex; a large count must not overflow the sum
    require(count >= 0 && count <= kMaxEnergyData && count % stride == 0 &&
                (count <= stride || !is_per_vertex(k, VertexEnergies{})),
            "data_count: expected whole records of at most 64 scalars (7 a plane, 4 for anchors)");
    scalars += count;
    total += data_count[k] * (is_per_vertex(k, VertexEnergies{}) ? num_vertices : 1);
  }
  require(scalars <= kMaxEnergyData, "energies: expected at most 64 scalars of data (7 a plane, 4 for anchors)");
  return total;
}

// The header of a plan, on the host: sizes. They say how long the plan is.
inline void require_header(const int32_t* header) {
  for (int i = 0; i < kPlanHeader; ++i) require(header[i] >= 0, "diffvbd: expected a plan made by build_plan");
}

inline int count_of(int64_t sweeps) {
  require(sweeps >= 0 && sweeps <= std::numeric_limits<int32_t>::max(), "sweeps: expected an integer >= 0");
  return static_cast<int>(sweeps);
}

}  // namespace diffvbd
