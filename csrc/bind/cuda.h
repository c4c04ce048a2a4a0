// Where entries run that are compiled for CUDA: errors, memory, and the stream of torch.
#pragma once

#include <cuda_runtime.h>
#include <torch/csrc/inductor/aoti_torch/c/shim.h>
#include <torch/csrc/stable/accelerator.h>

#include <algorithm>
#include <stdexcept>
#include <string>
#include <vector>

#include "../cuda/arrays.h"
#include "../cuda/bodies.h"
#include "../cuda/coarse.h"
#include "../cuda/contact.h"
#include "../cuda/contact_coarse.h"
#include "../cuda/contact_rigid.h"
#include "../cuda/neighbors.h"
#include "../cuda/step.h"
#include "arguments.h"

// A launch, checked, and what only launches take.
#define DIFFVBD_RUN(device, kernel, ...) \
  ::diffvbd::cuda::check(::diffvbd::cuda::kernel(__VA_ARGS__, (device).stream()), #kernel)
#define DIFFVBD_ON_CUDA(...) __VA_ARGS__

namespace diffvbd {
namespace cuda {

inline void check(cudaError_t error, const char* what) {
  if (error == cudaSuccess) return;
  if (error == cudaErrorInvalidConfiguration) {
    cudaGetLastError();
    throw std::invalid_argument("regime: this mesh does not fit the shared memory of a thread block of this device");
  }
  cudaGetLastError();  // an error that does not poison the context must not come up again in somebody else's call
  throw std::runtime_error(std::string("diffvbd: ") + what + " failed: " + cudaGetErrorString(error));
}

inline int64_t bytes_of(ScalarType dtype) {
  if (dtype == ScalarType::Double || dtype == ScalarType::Long) return 8;
  return dtype == ScalarType::Byte || dtype == ScalarType::Bool ? 1 : 4;
}

// Through torch's C interface, whose failure is a number: its C++ wrapper formats a message with streams, which two
// copies of the standard library in one process do not survive.
inline Tensor empty(const Tensor& like, Ints sizes, ScalarType dtype) {
  const std::pair<ScalarType, int32_t> codes[] = {
      {ScalarType::Double, aoti_torch_dtype_float64()}, {ScalarType::Float, aoti_torch_dtype_float32()},
      {ScalarType::Long, aoti_torch_dtype_int64()},     {ScalarType::Int, aoti_torch_dtype_int32()},
      {ScalarType::Byte, aoti_torch_dtype_uint8()},     {ScalarType::Bool, aoti_torch_dtype_bool()},
  };
  const auto* code = std::find_if(std::begin(codes), std::end(codes), [&](const auto& c) { return c.first == dtype; });
  require(code != std::end(codes), "diffvbd: no tensors of this dtype");
  std::vector<int64_t> strides(sizes.size(), 1);
  for (size_t i = sizes.size(); i-- > 1;) strides[i - 1] = strides[i] * std::max<int64_t>(1, sizes[i]);
  AtenTensorHandle handle = nullptr;
  const auto status =
      aoti_torch_empty_strided(static_cast<int64_t>(sizes.size()), sizes.data(), strides.data(), code->second,
                               aoti_torch_device_type_cuda(), like.get_device_index(), &handle);
  if (status != AOTI_TORCH_SUCCESS) {
    const cudaError_t last = cudaPeekAtLastError();
    if (last != cudaSuccess && last != cudaErrorMemoryAllocation) check(last, "an allocation");
    int64_t bytes = bytes_of(dtype);
    for (const int64_t n : sizes) bytes *= n;
    throw std::runtime_error("diffvbd: CUDA out of memory, wanted " + std::to_string(bytes) + " bytes more");
  }
  return Tensor(handle);
}

}  // namespace cuda

constexpr bool kOnCuda = true;

// The device of a tensor, current as long as this lives.
class Device {
 public:
  explicit Device(const Tensor& like) : guard_(like.get_device_index()), like_(like) {}

  Tensor empty(Ints sizes, ScalarType dtype) const { return cuda::empty(like_, sizes, dtype); }
  Tensor empty(Ints sizes) const { return empty(sizes, like_.scalar_type()); }
  Tensor bytes(int64_t count) const { return empty({count}, ScalarType::Byte); }
  // Zero at first: several of them for one launch, before the next.
  Tensor zeros(Ints sizes, ScalarType dtype) const {
    Tensor out = empty(sizes, dtype);
    zeroed_.push_back({out.data_ptr(), out.numel() * cuda::bytes_of(dtype)});
    return out;
  }
  Tensor zeros(Ints sizes) const { return zeros(sizes, like_.scalar_type()); }
  Tensor operator()(Ints sizes, bool zeroed) const { return zeroed ? zeros(sizes) : empty(sizes); }
  Tensor like_x() const { return empty({like_.size(0), like_.size(1), like_.size(2)}); }
  // Rows of pairs [pairs, each], zero as far as the list has pairs; entries: four times their number, on the device.
  Tensor rows(int64_t pairs, int64_t each, const int32_t* entries, ScalarType dtype) const {
    Tensor out = empty({pairs, each}, dtype);
    const int64_t row = each * cuda::bytes_of(dtype);
    zeroed_.push_back({out.data_ptr(), pairs * row, entries, row});
    return out;
  }
  Tensor rows(int64_t pairs, int64_t each, const int32_t* entries) const {
    return rows(pairs, each, entries, like_.scalar_type());
  }

  int index() const { return like_.get_device_index(); }
  cudaStream_t stream() const {
    void* found = nullptr;
    require(aoti_torch_get_current_cuda_stream(index(), &found) == AOTI_TORCH_SUCCESS,
            "diffvbd: no current CUDA stream");
    const auto stream = static_cast<cudaStream_t>(found);
    if (!zeroed_.empty()) cuda::check(cuda::clear(zeroed_, stream), "memory");
    zeroed_.clear();
    return stream;
  }
  int attribute(cudaDeviceAttr which) const {
    int value = 0;
    cuda::check(cudaDeviceGetAttribute(&value, which, index()), "a device query");
    return value;
  }

 private:
  torch::stable::accelerator::DeviceGuard guard_;
  const Tensor& like_;
  mutable std::vector<cuda::Span> zeroed_;
};

using start::StartChoice;

// Bodies by size, as the Model has counted them, and the memory of their sums.
struct Teams {
  cuda::BodyGroups groups;
  Tensor memory;

  Teams(Ints count, int64_t bodies, const Device& device, const Tensor& x)
      : groups{static_cast<int32_t>(count.at(0)), static_cast<int32_t>(count.at(1)), static_cast<int32_t>(count.at(2)),
               static_cast<int32_t>(count.at(3))},
        memory(device.empty({cuda::bodies_workspace(groups, x.size(0), x.size(1))}, ScalarType::Double)) {
    require(count.size() == 4 && *std::min_element(count.begin(), count.end()) >= 0 &&
                count[0] + count[1] + count[2] + count[3] == bodies,
            "diffvbd: expected four groups of bodies");
  }
  double* work() const { return data<double>(memory); }
};

}  // namespace diffvbd
