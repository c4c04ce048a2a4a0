// CPU implementations of the rigid correction: bodies side by side, or the vertices of a large one.
#include <torch/csrc/stable/library.h>

#include <algorithm>
#include <tuple>
#include <vector>

#include "../arguments_rigid.h"
#include "binding.h"
#include "grain.h"

namespace {

namespace rigid = diffvbd::rigid;
using diffvbd::data, diffvbd::dispatch_float, diffvbd::empty, diffvbd::kGrain, diffvbd::RigidTensors, diffvbd::zeros;
using torch::stable::Tensor;

// Sums go by chunks of a fixed size, so that they have the same bits for any number of threads.
class Threads {
 public:
  explicit Threads(bool many) : many_(many) {}

  bool leads() const { return true; }

  template <int n, class F>
  void sum(int32_t count, double* out, const F& f) const {
    std::fill_n(out, n, 0.0);
    if (count <= kChunk) {
      for (int32_t i = 0; i < count; ++i) f(i, out);
      return;
    }
    const int64_t chunks = (count + kChunk - 1) / kChunk;
    std::vector<double> part(chunks * n, 0.0);
    each_chunk(count, [&](int64_t chunk, int32_t i) { f(i, part.data() + chunk * n); });
    for (int64_t chunk = 0; chunk < chunks; ++chunk) {
      for (int k = 0; k < n; ++k) out[k] += part[chunk * n + k];
    }
  }

  template <class F>
  void each(int32_t count, const F& f) const {
    each_chunk(count, [&](int64_t, int32_t i) { f(i); });
  }

 private:
  static constexpr int32_t kChunk = 1024;

  template <class F>
  void each_chunk(int32_t count, const F& f) const {
    const int64_t chunks = (count + kChunk - 1) / kChunk;
    const auto run = [&](int64_t begin, int64_t end) {
      for (int64_t chunk = begin; chunk < end; ++chunk) {
        const int32_t last = static_cast<int32_t>(std::min<int64_t>(count, (chunk + 1) * kChunk));
        for (auto i = static_cast<int32_t>(chunk * kChunk); i < last; ++i) f(chunk, i);
      }
    };
    if (many_ && chunks > 1) {
      torch::stable::parallel_for(0, chunks, kGrain / kChunk, run);
    } else {
      run(0, chunks);
    }
  }

  bool many_;
};

// Calls f(body, team) for all bodies of all scenes.
template <class T, class F>
void for_bodies(const rigid::Inputs<T>& in, const F& f) {
  const int64_t items = in.scenes * in.bodies;
  if (items == 0) return;
  const int64_t vertices = std::max<int64_t>(1, in.ptr[in.bodies] / in.bodies);
  const auto one = [&](int64_t item, bool many) {
    f(rigid::Body<T>{in, item / in.bodies, static_cast<int32_t>(item % in.bodies)}, Threads(many));
  };
  if (items < static_cast<int64_t>(torch::stable::get_num_threads())) {
    for (int64_t i = 0; i < items; ++i) one(i, true);
  } else {
    torch::stable::parallel_for(0, items, diffvbd::pieces_per_thread(vertices), [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) one(i, false);
    });
  }
}

template <class T>
bool has_energies(const rigid::Inputs<T>& in) {
  return in.data.data != nullptr;
}

Tensor correct(const Tensor& x, const Tensor& x_prev, const Tensor& y, const Tensor& mass, const Tensor& energy_data,
               const Tensor& origin, const Tensor& order, const Tensor& ptr, const Tensor& spread,
               std::vector<int64_t> /*groups*/, std::vector<int64_t> data_count, double time_step) {
  const RigidTensors given{x, x_prev, y, mass, energy_data, origin, order, ptr, spread};
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::rigid_inputs<T>(given, data_count, time_step);
    Tensor out = empty(x, {in.scenes, in.vertices, 3});
    T* to = data<T>(out);
    if (order.numel() < in.vertices) std::copy_n(in.x, x.numel(), to);
    for_bodies(in, [&](const rigid::Body<T>& body, const Threads& team) {
      rigid::Iteration record[rigid::kMaxIterations];
      if (has_energies(in)) {
        rigid::correct<true>(body, team, record, to);
      } else {
        rigid::correct<false>(body, team, record, to);
      }
    });
    return out;
  });
}

std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor, Tensor> correct_backward(
    const Tensor& x_bar, const Tensor& x, const Tensor& x_prev, const Tensor& y, const Tensor& mass,
    const Tensor& energy_data, const Tensor& origin, const Tensor& order, const Tensor& ptr, const Tensor& spread,
    std::vector<int64_t> /*groups*/, std::vector<int64_t> data_count, double time_step, bool wants_data) {
  const RigidTensors given{x, x_prev, y, mass, energy_data, origin, order, ptr, spread};
  return dispatch_float(x, [&](auto scalar) {
    using T = decltype(scalar);
    const auto in = diffvbd::rigid_inputs<T>(given, data_count, time_step);
    const diffvbd::RigidBars bars(
        given, in, data_count, wants_data,
        [&](const std::vector<int64_t>& shape, bool zeroed) { return zeroed ? zeros(x, shape) : empty(x, shape); });
    const auto a = bars.pointers<T>(x_bar);
    if (!bars.all) std::copy_n(a.end, x.numel(), a.x);
    for_bodies(in, [&](const rigid::Body<T>& body, const Threads& team) {
      rigid::Iteration record[rigid::kMaxIterations];
      if (has_energies(in)) {
        rigid::reverse<true>(body, team, record, a);
      } else {
        rigid::reverse<false>(body, team, record, a);
      }
    });
    return bars.tensors();
  });
}

}  // namespace

STABLE_TORCH_LIBRARY_IMPL(diffvbd, CPU, m) {
  m.impl("rigid", TORCH_BOX(&correct));
  m.impl("rigid_backward", TORCH_BOX(&correct_backward));
}
