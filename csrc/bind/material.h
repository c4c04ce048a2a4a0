// Where the names of a material meet its number of scalars: the elastic law's (energies/tet.h).
#pragma once

#include <array>

#include "arguments.h"

namespace diffvbd {

constexpr const char* kMaterialNames[kMaterialScalars] = {"mu", "lam"};

// Of any list with these fields.
template <class Fields>
std::array<const Tensor*, kMaterialScalars> material_of(const Fields& f) {
  static_assert(kMaterialScalars == 2, "name the scalars of the law's material here");
  return {&f.mu, &f.lam};
}

}  // namespace diffvbd
