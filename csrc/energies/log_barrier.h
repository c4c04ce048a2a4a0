// IPC log barrier (Li et al. 2020), shared by planes and pairs.
#pragma once

#include "../core/vec.h"

namespace diffvbd {

// Of kappa dhat: the normal force from which a contact has half of its damping. A function, as device code has no
// address of a constant.
DIFFVBD_FN constexpr double fade() {
  constexpr double kFade = 0.1;  // twin of FADE in diffvbd/energies.py
  return kFade;
}

// b(d) = -kappa (d - dhat)^2 log(d / dhat) and its derivatives, zero for d >= dhat
template <class R>
struct LogBarrier {
  R value, first, second, third;
  DIFFVBD_FN LogBarrier(const R& d, const R& dhat, const R& kappa) {
    const auto active = d < dhat;
    const R safe = select(active, d, dhat), gap = safe - dhat, inv = R(1) / safe;
    const R log_ratio = natural_log(safe / dhat), ratio = gap * inv;
    value = select(active, -kappa * gap * gap * log_ratio, R(0));
    first = select(active, -kappa * (R(2) * gap * log_ratio + gap * ratio), R(0));
    second = select(active, -kappa * (R(2) * log_ratio + R(4) * ratio - ratio * ratio), R(0));
    third = select(active, -kappa * inv * (R(6) - R(6) * ratio + R(2) * ratio * ratio), R(0));
  }
};

}  // namespace diffvbd
