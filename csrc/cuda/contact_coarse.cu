#include "atomics.cuh"
#include "bodies.cuh"
#include "common.cuh"
#include "contact_coarse.h"

namespace diffvbd::cuda {

using namespace contact;

namespace {

constexpr int kItems = 128;  // threads of a block with one item each

template <class F>
__global__ void __launch_bounds__(kItems) each_kernel(int64_t n, const __grid_constant__ F f) {
  const int64_t i = own_item(kItems);
  if (i < n) f(i);
}

// A warp that shares the items of one.
struct Warp {
  int lane;
  __device__ bool leads() const { return lane == 0; }
  __device__ void meet() const { __syncwarp(); }
  template <class F>
  __device__ void each(int64_t count, const F& f) const {
    for (int64_t i = lane; i < count; i += 32) f(i);
  }
};
template <class F>
__global__ void __launch_bounds__(kItems) lanes_kernel(int64_t n, const __grid_constant__ F f) {
  const int64_t i = own_item(kItems) / 32;
  if (i < n) f(i, Warp{static_cast<int>(threadIdx.x % 32)});
}

template <class F>
__global__ void __launch_bounds__(kThreads) teams_kernel(const __grid_constant__ F f) {
  __shared__ double part[kWarps][kMostSums];
  f(int64_t{blockIdx.x}, BlockTeam{part});
}

// A Run of subspace/contact_coarse.h.
struct Launches {
  using Team = BlockTeam;
  using Lane = Warp;
  cudaStream_t stream;

  template <class F>
  void each(int64_t n, const F& f) const {
    if (n > 0) each_kernel<<<blocks_for(n, kItems), kItems, 0, stream>>>(n, f);
  }
  template <class F>
  void lanes(int64_t n, const F& f) const {
    if (n > 0) lanes_kernel<<<blocks_for(32 * n, kItems), kItems, 0, stream>>>(n, f);
  }
  template <class F>
  void teams(int64_t n, const F& f) const {
    if (n > 0) teams_kernel<<<static_cast<unsigned>(n), kThreads, 0, stream>>>(f);
  }
  bool is_done(const uint8_t*, int64_t) const { return false; }  // the host would wait
  __device__ static int32_t root_of(const int32_t* lead, int32_t i) { return cuda::root_of(lead, i); }
  __device__ static void unite(int32_t* lead, int32_t a, int32_t b) { cuda::unite(lead, a, b); }
};

}  // namespace

template <class T>
cudaError_t contact_coarse_system(const CoarseInputs<T>& c, const Batched<const T>& packed, const SystemMemory& memory,
                                  double* r, double* matrix, cudaStream_t stream) {
  coarse_system(Launches{stream}, c, packed, memory, r, matrix);
  return cudaGetLastError();
}
template <class T>
cudaError_t contact_coarse_move(const CoarseInputs<T>& c, const double* a, const double* r, const int32_t* info,
                                const TrialMemory<T>& memory, T* x, cudaStream_t stream) {
  coarse_move(Launches{stream}, c, a, r, info, memory, x);
  return cudaGetLastError();
}
template <class T>
cudaError_t contact_coarse_restrict(const CoarseInputs<T>& c, const T* x_bar, const double* fraction, double* to,
                                    cudaStream_t stream) {
  coarse_restrict(Launches{stream}, c, x_bar, fraction, to);
  return cudaGetLastError();
}
template <class T>
cudaError_t contact_coarse_motions(const CoarseInputs<T>& c, const double* a, const double* l, const double* fraction,
                                   T* p, T* q, cudaStream_t stream) {
  coarse_motions(Launches{stream}, c, a, l, fraction, p, q);
  return cudaGetLastError();
}
template <class T>
cudaError_t contact_coarse_reverse(const CoarseInputs<T>& c, const double* a, const double* l, const double* fraction,
                                   const T* x_bar, const VirtualMotions<T>& given, const PointWork<T>& scattered,
                                   const CoarseAdjoints<T>& out, cudaStream_t stream) {
  coarse_reverse(Launches{stream}, c, a, l, fraction, x_bar, given, scattered, out);
  return cudaGetLastError();
}

DIFFVBD_INSTANTIATE(contact_coarse_system)
DIFFVBD_INSTANTIATE(contact_coarse_move)
DIFFVBD_INSTANTIATE(contact_coarse_restrict)
DIFFVBD_INSTANTIATE(contact_coarse_motions)
DIFFVBD_INSTANTIATE(contact_coarse_reverse)

}  // namespace diffvbd::cuda
