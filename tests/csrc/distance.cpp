// Derivatives of distances, chosen anew and by the feature that values have chosen: prints how many pairs have had each
// feature, and of how many the two differ.
#include <cstring>
#include <iostream>
#include <random>
#include <vector>

#include "contact/pairs.h"

using namespace diffvbd;
using namespace diffvbd::contact;

namespace {

std::vector<double> numbers(const Distance<Dual<double>>& a) {
  std::vector<double> out;
  const auto add = [&](const Dual<double>& b) { out.push_back(b.value), out.push_back(b.derivative); };
  add(a.d), add(a.n.x), add(a.n.y), add(a.n.z);
  for (const Dual<double>& w : a.w) add(w);
  return out;
}

}  // namespace

int main() {
  std::mt19937 random(1);
  std::normal_distribution<double> normal;
  const auto vector = [&] { return Vec3<double>{normal(random), normal(random), normal(random)}; };
  long features[3][5] = {}, different = 0, moving = 0;
  for (int i = 0; i < 60000; ++i) {
    const int kind = i % 3;
    Corners<double> c;
    for (auto& x : c.x) x = vector();
    if (i % 7 == 0) c.x[3] = c.x[2] + 1e-9 * vector();  // next to no length
    if (i % 11 == 0) {                                  // in a plane
      for (auto& x : c.x) x.z = 0.5;
    }
    int feature = -1;
    distance(kind, c, &feature);
    ++features[kind][feature];
    const Corners<Dual<double>> moved = moved_along(c, i / 3 % 4, vector());
    const auto anew = numbers(distance(kind, moved)), by = numbers(distance_by(kind, feature, moved));
    for (size_t k = 0; k < anew.size(); ++k) {
      const bool same = anew[k] == by[k] || (anew[k] != anew[k] && by[k] != by[k]);
      if (!same) {
        ++different;
        break;
      }
    }
    moving += by[1] != 0;
  }
  for (const auto& of : features) {
    for (const long count : of) std::cout << count << ' ';
  }
  std::cout << different << ' ' << moving << '\n';
}
