// CPU implementations of the operators of csrc/bind/contact_part.h.
#include "../contact_part.h"

#include <torch/csrc/stable/library.h>

#include "../../cpu/threads.h"
#include "sweep.h"

namespace {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;

class Place {
 public:
  explicit Place(const Tensor& x) : x_(x) {}
  Tensor like_x() const { return torch::stable::empty_like(x_); }
  Tensor make(const std::vector<int64_t>& sizes) const { return diffvbd::empty(x_, sizes); }
  Tensor make(const std::vector<int64_t>& sizes, ScalarType dtype) const { return torch::stable::empty(sizes, dtype); }
  Tensor zeros(const std::vector<int64_t>& sizes) const { return diffvbd::zeros(x_, sizes); }
  template <class Act>
  void bodies(const Act& act) const {
    diffvbd::for_bodies(act.in.scene, act);
  }
  template <class Act>
  void vertices(const Act& act) const {
    diffvbd::for_vertices(act.in.scene, act);
  }

 private:
  const Tensor& x_;
};
using Operators = diffvbd::PartOperators<Place>;

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CPU, m) {
  m.impl("contact_above_floor", TORCH_BOX(&Operators::above_floor));
  m.impl("contact_above_floor_backward", TORCH_BOX(&Operators::above_floor_backward));
  m.impl("contact_frames", TORCH_BOX(&Operators::frames));
  m.impl("contact_bends", TORCH_BOX(&Operators::bends));
  m.impl("contact_hold", TORCH_BOX(&Operators::hold));
  m.impl("contact_held_up", TORCH_BOX(&Operators::held_up));
  m.impl("contact_falls", TORCH_BOX(&Operators::falls));
  m.impl("contact_start", TORCH_BOX(&Operators::start));
  m.impl("contact_start_backward", TORCH_BOX(&Operators::start_backward));
}
