// Work beside that of a stream, where two kernels need nothing of each other and neither fills the device.
#pragma once

#include <cuda_runtime_api.h>

#include <map>

namespace diffvbd::cuda {

// A second stream of a device, of the calling thread. In the capture of a graph it is captured as well, until that
// ends.
class Beside {
 public:
  Beside() = default;
  Beside(const Beside&) = delete;
  Beside& operator=(const Beside&) = delete;
  ~Beside() {  // at the end of the thread
    if (begun_) cudaEventDestroy(begun_);
    if (ended_) cudaEventDestroy(ended_);
    if (stream_) cudaStreamDestroy(stream_);
  }

  // That of the current device.
  static cudaError_t of_device(Beside** out) {
    thread_local std::map<int, Beside> all;
    int device = 0;
    if (auto error = cudaGetDevice(&device)) return error;
    *out = &all[device];
    return (*out)->make();
  }
  cudaStream_t stream() const { return stream_; }
  // What this stream is given from now on waits for what `main` has been given,
  cudaError_t fork(cudaStream_t main) const {
    if (auto error = cudaEventRecord(begun_, main)) return error;
    return cudaStreamWaitEvent(stream_, begun_, 0);
  }
  // and what `main` is given from now on for what this one has.
  cudaError_t join(cudaStream_t main) const {
    if (auto error = cudaEventRecord(ended_, stream_)) return error;
    return cudaStreamWaitEvent(main, ended_, 0);
  }

 private:
  cudaError_t make() {
    if (ended_) return cudaSuccess;
    if (!stream_) {
      if (auto error = cudaStreamCreateWithFlags(&stream_, cudaStreamNonBlocking)) return error;
    }
    if (!begun_) {
      if (auto error = cudaEventCreateWithFlags(&begun_, cudaEventDisableTiming)) return error;
    }
    return cudaEventCreateWithFlags(&ended_, cudaEventDisableTiming);
  }

  cudaStream_t stream_ = nullptr;
  cudaEvent_t begun_ = nullptr, ended_ = nullptr;
};

}  // namespace diffvbd::cuda
