// CUDA implementations of the operators of csrc/bind/contact_part.h.
#include "../contact_part.h"

#include <torch/csrc/stable/accelerator.h>
#include <torch/csrc/stable/library.h>

#include "../../cuda/contact.h"
#include "binding.h"

namespace {

namespace cuda = diffvbd::cuda;
using torch::headeronly::ScalarType;
using torch::stable::Tensor;

class Place {
 public:
  explicit Place(const Tensor& x) : guard_(x.get_device_index()), x_(x) {}
  Tensor like_x() const { return make({x_.size(0), x_.size(1), x_.size(2)}); }
  Tensor make(const std::vector<int64_t>& sizes) const { return cuda::empty(x_, sizes); }
  Tensor make(const std::vector<int64_t>& sizes, ScalarType dtype) const { return cuda::empty(x_, sizes, dtype); }
  Tensor zeros(const std::vector<int64_t>& sizes) const {
    cuda::Zeroed zeros(x_);
    const Tensor out = zeros(sizes);
    zeros.clear();
    return out;
  }
  template <class Act>
  void bodies(const Act& act) const {
    cuda::check(cuda::act_on_bodies(act, cuda::current_stream(x_)), "the start of a part");
  }
  template <class Act>
  void vertices(const Act& act) const {
    cuda::check(cuda::act_on_vertices(act, cuda::current_stream(x_)), "the start of a part");
  }

 private:
  torch::stable::accelerator::DeviceGuard guard_;
  const Tensor& x_;
};
using Operators = diffvbd::PartOperators<Place>;

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CUDA, m) {
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
