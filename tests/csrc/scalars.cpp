// A formula as an author of an energy may write it: in numbers, in a pack of lanes, and in Dual with its derivative.
#include <iostream>

#include "core/dual.h"
#include "cpu/lanes.h"

using namespace diffvbd;

namespace {

// larger(a, b)^2 + a - b
template <class R>
R formula(const R& a, const R& b) {
  R out = select(a > b, a, b);
  out *= out;
  out += a;
  out -= b;
  return out;
}

void print(double a, double b) {
  const Dual<double> by_a = formula(Dual<double>(a, 1.0), Dual<double>(b));
  const Lanes<double> lanes = formula(Lanes<double>(a), Lanes<double>(b));
  std::cout << formula(a, b) << ' ' << lanes.v[0] << ' ' << lanes.v[kLanes - 1] << ' ' << by_a.value << ' '
            << by_a.derivative << '\n';
}

}  // namespace

int main() {
  print(3, 2);
  print(2, 3);
}
