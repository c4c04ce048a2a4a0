// What the CUDA registrations share: errors, memory and the stream of torch.
#pragma once

#include <cuda_runtime.h>
#include <torch/csrc/inductor/aoti_torch/c/shim.h>

#include <algorithm>
#include <stdexcept>
#include <string>
#include <vector>

#include "../../cuda/arrays.h"
#include "../arguments.h"

namespace diffvbd::cuda {

inline void check(cudaError_t error, const char* what) {
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
inline Tensor empty(const Tensor& like, const std::vector<int64_t>& sizes, ScalarType dtype) {
  std::vector<int64_t> strides(sizes.size(), 1);
  for (size_t i = sizes.size(); i-- > 1;) strides[i - 1] = strides[i] * std::max<int64_t>(1, sizes[i]);
  int32_t code = 0;
  int64_t bytes = 0;
  switch (dtype) {
    case ScalarType::Double:
      code = aoti_torch_dtype_float64(), bytes = 8;
      break;
    case ScalarType::Float:
      code = aoti_torch_dtype_float32(), bytes = 4;
      break;
    case ScalarType::Long:
      code = aoti_torch_dtype_int64(), bytes = 8;
      break;
    case ScalarType::Int:
      code = aoti_torch_dtype_int32(), bytes = 4;
      break;
    case ScalarType::Byte:
      code = aoti_torch_dtype_uint8(), bytes = 1;
      break;
    case ScalarType::Bool:
      code = aoti_torch_dtype_bool(), bytes = 1;
      break;
    default:
      throw std::invalid_argument("diffvbd: no tensors of this dtype");
  }
  AtenTensorHandle handle = nullptr;
  const auto status = aoti_torch_empty_strided(static_cast<int64_t>(sizes.size()), sizes.data(), strides.data(), code,
                                               aoti_torch_device_type_cuda(), like.get_device_index(), &handle);
  if (status != AOTI_TORCH_SUCCESS) {
    const cudaError_t last = cudaPeekAtLastError();
    if (last != cudaSuccess && last != cudaErrorMemoryAllocation) check(last, "an allocation");
    for (const int64_t n : sizes) bytes *= n;
    throw std::runtime_error("diffvbd: CUDA out of memory, wanted " + std::to_string(bytes) + " bytes more");
  }
  return Tensor(handle);
}

inline Tensor empty(const Tensor& like, const std::vector<int64_t>& sizes) {
  return empty(like, sizes, like.scalar_type());
}

inline cudaStream_t current_stream(const Tensor& t) {
  void* stream = nullptr;
  require(aoti_torch_get_current_cuda_stream(t.get_device_index(), &stream) == AOTI_TORCH_SUCCESS,
          "diffvbd: no current CUDA stream");
  return static_cast<cudaStream_t>(stream);
}

// Tensors that are zero at first: several of them for one launch.
class Zeroed {
 public:
  explicit Zeroed(const Tensor& like) : like_(like) {}
  Tensor operator()(const std::vector<int64_t>& sizes) {
    Tensor out = empty(like_, sizes);
    spans_.push_back({out.data_ptr(), out.numel() * scalar()});
    return out;
  }
  // Rows of pairs [pairs, each], zero as far as the list has pairs; entries: four times their number, on the device.
  Tensor rows(int64_t pairs, int64_t each, const int32_t* entries) {
    Tensor out = empty(like_, {pairs, each});
    spans_.push_back({out.data_ptr(), out.numel() * scalar(), entries, each * scalar()});
    return out;
  }
  // The same of bytes.
  Tensor bytes(int64_t pairs, int64_t each, const int32_t* entries) {
    Tensor out = empty(like_, {pairs, each}, ScalarType::Byte);
    spans_.push_back({out.data_ptr(), out.numel(), entries, each});
    return out;
  }
  void clear() const { check(cuda::clear(spans_, current_stream(like_)), "memory"); }

 private:
  int64_t scalar() const { return like_.scalar_type() == ScalarType::Double ? sizeof(double) : sizeof(float); }

  const Tensor& like_;
  std::vector<Span> spans_;
};

}  // namespace diffvbd::cuda
