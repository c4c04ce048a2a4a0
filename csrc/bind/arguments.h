// From tensors to raw pointers, checked: what all entries share.
#pragma once

#include <torch/csrc/stable/ops.h>
#include <torch/headeronly/core/ScalarType.h>

#include <array>
#include <limits>
#include <stdexcept>
#include <string>
#include <vector>

#include "../core/views.h"
#include "../energies/energies.h"
#include "fields.h"

namespace diffvbd {

using torch::headeronly::ScalarType;

constexpr int64_t kWorkspaceBudget = int64_t{2} << 30;  // bytes on CUDA; a batch that needs more is worked on in chunks

inline void require(bool condition, const char* message) {
  if (!condition) throw std::invalid_argument(message);
}

// f(double{}) or f(float{}), whichever t has.
template <class F>
auto dispatch_float(const Tensor& t, F&& f) {
  require(t.scalar_type() == ScalarType::Double || t.scalar_type() == ScalarType::Float,
          "diffvbd: expected float64 or float32 tensors");
#ifdef DIFFVBD_SCALAR  // of a generated law
  require((t.scalar_type() == ScalarType::Double) == (sizeof(DIFFVBD_SCALAR) == sizeof(double)),
          "diffvbd: expected tensors of the dtype that the law was compiled for");
  return f(DIFFVBD_SCALAR{});
#else
  return t.scalar_type() == ScalarType::Double ? f(double{}) : f(float{});
#endif
}

template <class T>
T* data(const Tensor& t) {
  return static_cast<T*>(t.data_ptr());
}
template <class T>
T* data_or_null(const Tensor& t) {
  return t.numel() > 0 ? data<T>(t) : nullptr;
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

// Text only: streams are left out for the reason that cuda.h gives.
[[noreturn]] inline void refuse(const char* name, const std::string& expected, const Tensor& t) {
  std::string got = std::string(torch::headeronly::toString(t.scalar_type())) + " [";
  for (int64_t k = 0; k < t.dim(); ++k) got += (k > 0 ? ", " : "") + std::to_string(t.size(k));
  got += t.is_cuda() ? "] on cuda:" + std::to_string(t.get_device_index()) : "] on the CPU";
  throw std::invalid_argument("diffvbd: " + std::string(name) + ": expected " + expected + ", got " + got +
                              (t.is_contiguous() ? "" : ", not contiguous"));
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

// Contiguous scalars of a dtype on the device of `like`, so many or `more`.
template <class D>
const D* array(const char* name, const Tensor& t, const Tensor& like, ScalarType dtype, int64_t numel,
               bool more = false) {
  if (!is_beside(t, like, dtype) || (more ? t.numel() < numel : t.numel() != numel)) {
    const std::string kind = dtype == like.scalar_type() ? "scalars of the dtype" : torch::headeronly::toString(dtype);
    refuse(name, std::to_string(numel) + (more ? " or more" : "") + " contiguous " + kind + " and on the device of x",
           t);
  }
  return data<const D>(t);
}
inline void require_like(const char* name, const Tensor& t, const Tensor& like, int64_t numel) {
  array<char>(name, t, like, like.scalar_type(), numel);
}

// Reads the tensors that stand with positions x [B, V, 3].
template <class T>
struct __attribute__((visibility("hidden"))) Reader {  // as Tensor is
  const Tensor& x;
  int64_t b, v;

  explicit Reader(const Tensor& positions) : x((require_positions(positions), positions)), b(x.size(0)), v(x.size(1)) {}
  const T* positions() const { return data<const T>(x); }
  const T* like(const char* name, const Tensor& t, int64_t numel) const {
    return array<T>(name, t, x, x.scalar_type(), numel);
  }
  const T* vectors(const char* name, const Tensor& t) const { return like(name, t, 3 * b * v); }
  const T* vectors_or_null(const char* name, const Tensor& t) const {
    return t.numel() > 0 ? vectors(name, t) : nullptr;
  }
  const T* of_vertices(const char* name, const Tensor& t) const { return like(name, t, b * v); }
  Batched<const T> batch(const char* name, const Tensor& t, int64_t items, int64_t own = 0) const {
    return batched<T>(name, t, x, b, items, own);
  }
  Batched<const T> batch_or_null(const char* name, const Tensor& t, int64_t items, int64_t own = 0) const {
    return batched_or_null<T>(name, t, x, b, items, own);
  }
  const int32_t* index(const char* name, const Tensor& t, int64_t numel, bool more = false) const {
    return array<int32_t>(name, t, x, ScalarType::Int, numel, more);
  }
  const bool* flags(const char* name, const Tensor& t, int64_t numel, bool more = false) const {
    return array<bool>(name, t, x, ScalarType::Bool, numel, more);
  }
  const double* doubles(const char* name, const Tensor& t, int64_t numel) const {
    return array<double>(name, t, x, ScalarType::Double, numel);
  }
  const uint8_t* bytes(const char* name, const Tensor& t, int64_t numel) const {
    return array<uint8_t>(name, t, x, ScalarType::Byte, numel);
  }
  // Collider points [B, Vc, 3], or anything else where there are none.
  int64_t colliders(const Tensor& t) const { return t.dim() == 3 ? t.size(1) : 0; }
  // In the first of these lists by body: their vertices and the first of each [bodies + 1].
  template <class In>
  void by_body(In& in, const Tensor& order, const Tensor& ptr) const {
    in.order = index("body_order", order, v), in.ptr = index("body_ptr", ptr, 1, true);
    in.scenes = b, in.vertices = static_cast<int32_t>(v), in.bodies = static_cast<int32_t>(ptr.numel() - 1);
  }
};

// Where the names of a material meet its number of scalars: the elastic law's (energies/tet.h).
constexpr const char* kMaterialNames[kMaterialScalars] = {"mu", "lam"};
template <class Fields>
std::array<const Tensor*, kMaterialScalars> material_of(const Fields& f) {
  static_assert(kMaterialScalars == 2, "name the scalars of the law's material here");
  return {&f.mu, &f.lam};
}

// Scalars of the energies' data for a scene.
inline int64_t energy_data_size(Ints data_count, int64_t num_vertices) {
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
// Those that a scene has, and that each vertex has.
template <class Counts>
std::array<int64_t, 2> scalars_of_data(const Counts& data_count) {
  std::array<int64_t, 2> out{};
  for (int k = 0; k < kVertexEnergies; ++k) out[is_per_vertex(k, VertexEnergies{})] += data_count[k];
  return out;
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
