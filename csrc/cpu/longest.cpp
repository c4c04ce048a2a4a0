#include "longest.h"

#include <torch/csrc/stable/ops.h>

#include "grain.h"

namespace diffvbd {

template <class T>
void longest_ways(const contact::LongestInputs<T>& in, T* out) {
  const int64_t grain = pieces_per_thread(in.bodies > 0 ? in.vertices / in.bodies : 0);
  torch::stable::parallel_for(0, in.scenes * in.bodies, grain, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      contact::store_longest(in, contact::longest_of_body(in, i / in.bodies, i % in.bodies, 0, 1), i, out);
    }
  });
}

template void longest_ways<float>(const contact::LongestInputs<float>&, float*);
template void longest_ways<double>(const contact::LongestInputs<double>&, double*);

}  // namespace diffvbd
