// From tensors to raw pointers: what the registrations of all backends share.
#pragma once

#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/core/ScalarType.h>

#include <limits>
#include <stdexcept>
#include <vector>

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

// [1 | B, ...] contiguous -> pointer and strides; a missing (empty) tensor gives null. `items` scalars for a scene, or
// one group of `own` that all share.
template <class T>
Batched<const T> batched(const Tensor& t, const Tensor& like, int64_t scenes, int64_t items, int64_t own = 1) {
  if (t.numel() == 0) return {};
  require(t.is_cuda() == like.is_cuda() && t.get_device_index() == like.get_device_index() && t.is_contiguous() &&
              t.scalar_type() == like.scalar_type(),
          "diffvbd: expected contiguous tensors of one dtype on one device");
  require(t.size(0) == 1 || t.size(0) == scenes, "diffvbd: a scene dimension is neither 1 nor that of x");
  const int64_t per_scene = t.numel() / t.size(0);
  require(per_scene == items || per_scene == own, "diffvbd: a tensor has the wrong size");
  return {data<const T>(t), t.size(0) == 1 ? 0 : per_scene, per_scene == items ? 1 : 0};
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
  require(data_count.size() == kVertexEnergies, "diffvbd: bad data_count");
  int64_t total = 0, scalars = 0;
  for (int k = 0; k < kVertexEnergies; ++k) {
    scalars += data_count[k];
    total += data_count[k] * (is_per_vertex(k, VertexEnergies{}) ? num_vertices : 1);
  }
  require(scalars <= kMaxEnergyData, "energies: expected at most 64 scalars of data (7 a plane, 4 for anchors)");
  return total;
}

inline int count_of(int64_t sweeps) {
  require(sweeps >= 0 && sweeps <= std::numeric_limits<int32_t>::max(), "sweeps: expected an integer >= 0");
  return static_cast<int>(sweeps);
}

}  // namespace diffvbd
