// Values that a step cannot work with, found before any work is done.
#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <vector>

#include "message.h"
#include "run.h"

namespace diffvbd {
namespace {

template <class Law, class T>
void check_material(const StepInputs<T>& in, int64_t tets) {
  const int64_t distinct = one_for_scenes(in.material) ? std::min<int64_t>(in.scenes, 1) : in.scenes;
  const int64_t count = one_for_items(in.material) ? std::min<int64_t>(tets, 1) : tets;
  for (int64_t b = 0; b < distinct; ++b) {
    for (int64_t i = 0; i < count; ++i) {
      T material[kMaterialScalars];  // x_prev has been looked at
      for (int m = 0; m < kMaterialScalars; ++m) {
        material[m] = in.material[m].data[b * in.material[m].scene + i * in.material[m].item];
      }
      for (int m = 0; m < kMaterialScalars; ++m) {
        const char* message = Law::invalid(material, m);
        if (!message) continue;
        Message out;
        out << message << ", got " << material[m];
        for (int other = 0; other < m; ++other) out << " with " << Law::material_names[other] << " " << material[other];
        out << " at tet " << i << " of scene " << b;
        throw std::invalid_argument(out.text);
      }
    }
  }
}

template <class T>
void check_vectors(const char* name, const Batched<const T>& t, int64_t scenes, int64_t vertices) {
  const int64_t distinct = t.scene == 0 ? std::min<int64_t>(scenes, 1) : scenes;
  for (int64_t b = 0; b < distinct; ++b) {
    for (int64_t i = 0; i < 3 * vertices; ++i) {
      const T value = t.data[b * t.scene + i];
      if (std::isfinite(value)) continue;
      Message out;
      out << name << ": expected finite values, got " << value << " at vertex " << i / 3 << " of scene " << b;
      throw std::invalid_argument(out.text);
    }
  }
}

template <class T>
void check_energy_data(const Plan& plan, const StepInputs<T>& in) {
  for (int64_t b = 0; b < (in.data.scene == 0 ? std::min<int64_t>(in.scenes, 1) : in.scenes); ++b) {
    const T* at = in.data.data + b * in.data.scene;
    for (int k = 0; k < kVertexEnergies; ++k) {
      const int64_t size = int64_t{in.data_count[k]} * (is_per_vertex(k, VertexEnergies{}) ? plan.num_vertices : 1);
      const int stride = data_stride(k, VertexEnergies{});
      for (int64_t i = 0; i < size; i += stride) {
        const char* message = invalid_data(k, at + i, VertexEnergies{});
        for (int64_t c = i; !message && c < i + stride; ++c) {
          if (!std::isfinite(at[c])) message = "parameters: expected finite values";
        }
        if (!message) continue;
        Message out;
        out << message << ", got (";
        for (int64_t c = i; c < i + stride; ++c) out << (c > i ? ", " : "") << at[c];
        out << ") in record " << i / stride << " of scene " << b;
        throw std::invalid_argument(out.text);
      }
      at += size;
    }
  }
}

// The step filter needs a positive gap to start from.
template <class T>
void check_above_planes(const Plan& plan, const StepInputs<T>& in) {
  for (int64_t b = 0; b < in.scenes; ++b) {
    const T* planes = in.data.data + b * in.data.scene;
    for (int k = 0; k < in.data_count[0]; k += FloorBarrier::stride) {
      std::vector<int32_t> below;
      for (int64_t i = 0; i < int64_t{plan.color_block[plan.colors]} * kLanes; ++i) {
        const int32_t v = plan.order[i];
        if (v < 0) continue;
        const auto at = [&](const Batched<const T>& t) {
          const T* a = t.data + b * t.scene + 3 * int64_t{v};
          return vector_at(a);
        };
        VertexState<T> state{at(in.x_prev), zero3<T>(), zero3<T>(), T(0)};
        if (in.origin.data) state.origin = at(in.origin);
        const FloorBarrier::Plane<T> plane(planes + k, state);
        if (T(0) < plane.gap(state.x)) continue;
        below.push_back(v);
      }
      if (below.empty()) continue;
      std::sort(below.begin(), below.end());
      Message out;
      out << "x: expected every unpinned vertex above floor plane " << k / FloorBarrier::stride << ", got "
          << below.size() << " on or below it in scene " << b << ": vertices ";
      for (size_t i = 0; i < std::min<size_t>(below.size(), 5); ++i) out << (i > 0 ? ", " : "") << below[i];
      if (below.size() > 5) out << ", ...";
      throw std::invalid_argument(out.text);
    }
  }
}

}  // namespace

template <class T>
void check_values(const Plan& plan, const StepInputs<T>& in) {
  const int64_t n = plan.num_vertices;
  check_vectors("x", in.x_prev, in.scenes, n);
  check_vectors("predictor (x, v, force, gravity, prescribed)", in.y, in.scenes, n);
  check_vectors("start (x, v, force, gravity, prescribed)", in.x_start, in.scenes, n);
  if (in.energies & kExactBlock) check_material<StableNeoHookean<true>>(in, plan.num_tets);
  if (in.energies & kPaperBlock) check_material<StableNeoHookean<false>>(in, plan.num_tets);
  // What a sweep does not move needs no mass: an isolated vertex has none.
  for (int64_t b = 0; b < (in.mass.scene == 0 ? std::min<int64_t>(in.scenes, 1) : in.scenes); ++b) {
    for (int64_t i = 0; i < int64_t{plan.color_block[plan.colors]} * kLanes; ++i) {
      const int32_t v = plan.order[i];
      if (v < 0) continue;
      const T m = in.mass.data[b * in.mass.scene + v];
      if (m > 0 && std::isfinite(m)) continue;
      Message out;
      out << "density or rest_points: expected a finite mass > 0 kg, got " << m << " at vertex " << v << " of scene "
          << b;
      throw std::invalid_argument(out.text);
    }
  }
  check_energy_data(plan, in);
  if (any_filter(in.energies, VertexEnergies{})) check_above_planes(plan, in);
}

template <class T>
void check_masses(const T* fractions, int64_t scenes, int64_t tets, int64_t stride) {
  for (int64_t i = 0; i < scenes * tets; ++i) {
    const T mass = 4 * fractions[i * stride];
    if (mass > 0 && std::isfinite(mass)) continue;
    Message out;
    out << "density or rest_points: expected density > 0 kg/m^3 and positive volume, got a mass of " << mass
        << " kg at tet " << i % tets << " of scene " << i / tets;
    throw std::invalid_argument(out.text);
  }
}

template void check_masses<float>(const float*, int64_t, int64_t, int64_t);
template void check_masses<double>(const double*, int64_t, int64_t, int64_t);
template void check_values<float>(const Plan&, const StepInputs<float>&);
template void check_values<double>(const Plan&, const StepInputs<double>&);

}  // namespace diffvbd
