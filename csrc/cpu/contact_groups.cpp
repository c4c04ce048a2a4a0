#include <algorithm>
#include <bitset>
#include <numeric>
#include <utility>
#include <vector>

#include "contact_rigid.h"

namespace diffvbd {

using namespace contact;

namespace {

// The order in which the bodies of a group are eliminated: always next the one that touches the fewest of those left,
// and then these touch one another. touching [count]: a bit for each other body; left as it is then.
std::vector<int32_t> elimination_order(std::vector<uint64_t>& touching) {
  const auto count = static_cast<int32_t>(touching.size());
  uint64_t left = count < 64 ? (uint64_t{1} << count) - 1 : ~uint64_t{0};
  std::vector<int32_t> order;
  while (left != 0) {
    int32_t next = -1, fewest = 65;
    for (int32_t k = 0; k < count; ++k) {
      const auto degree = static_cast<int32_t>(std::bitset<64>(touching[k] & left).count());
      if ((left >> k & 1) && degree < fewest) next = k, fewest = degree;
    }
    order.push_back(next);
    left &= ~(uint64_t{1} << next);
    const uint64_t rest = touching[next] & left;
    for (int32_t k = 0; k < count; ++k) {
      if (rest >> k & 1) touching[k] |= rest & ~(uint64_t{1} << k);
    }
  }
  return order;
}

}  // namespace

template <class T>
void find_groups(const RigidInputs<T>& in, int64_t scene, const std::vector<PairPress>& presses, int32_t* rows) {
  const int32_t n = in.bodies();
  std::vector<std::pair<int32_t, int32_t>> touching;
  each_touching(in, scene, presses, [&](int32_t a, int32_t b) { touching.emplace_back(a, b); });
  std::vector<int32_t> root(n), size(n, 0);
  std::iota(root.begin(), root.end(), 0);
  const auto root_of = [&](int32_t body) {
    while (root[body] != body) body = root[body] = root[root[body]];
    return body;
  };
  for (auto [a, b] : touching) {
    a = root_of(a), b = root_of(b);
    root[std::max(a, b)] = std::min(a, b);
  }
  for (int32_t k = 0; k < n; ++k) ++size[root_of(k)];
  int32_t *member = rows, *first = rows + n, *rank = rows + 2 * n, *count = rows + 3 * n, place = 0;
  std::fill_n(count, n, 0);
  for (int32_t k = 0; k < n; ++k) {
    const int32_t own = root_of(k);
    const bool fits = size[own] <= most_grouped(n);
    const int32_t lead = fits ? own : k;
    if (lead == k) {
      first[k] = place;
      place += fits ? size[own] : 1;
    }
    first[k] = first[lead];
    rank[k] = fits ? count[first[k]]++ : 0;
    if (!fits) count[first[k]] = kLeft;
    member[first[k] + rank[k]] = k;
  }
  std::vector<uint64_t> masks(n, 0);
  for (const auto& [a, b] : touching) {
    if (first[a] != first[b]) continue;
    masks[first[a] + rank[a]] |= uint64_t{1} << rank[b];
    masks[first[b] + rank[b]] |= uint64_t{1} << rank[a];
  }
  for (place = 0; place < n; ++place) {
    if (count[place] <= kFew) continue;
    std::vector<uint64_t> own(masks.begin() + place, masks.begin() + place + count[place]);
    const std::vector<int32_t> before(member + place, member + place + count[place]), order = elimination_order(own);
    for (int32_t i = 0; i < count[place]; ++i) {
      member[place + i] = before[order[i]];
      rank[member[place + i]] = i;
    }
  }
}

#define DIFFVBD_INSTANTIATE(T) \
  template void find_groups<T>(const RigidInputs<T>&, int64_t, const std::vector<PairPress>&, int32_t*);
DIFFVBD_INSTANTIATE(float)
DIFFVBD_INSTANTIATE(double)
#undef DIFFVBD_INSTANTIATE

}  // namespace diffvbd
