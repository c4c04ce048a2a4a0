"""The gap at which a log barrier bears a force."""

import math


def bearing_gap(force: float, kappa: float, dhat: float) -> float:
    """d* [m] with |b'(d*)| = force [N], by bisection."""
    low, high = 0.0, dhat
    for _ in range(200):
        d = (low + high) / 2
        borne = kappa * (2 * (d - dhat) * math.log(d / dhat) + (d - dhat) ** 2 / d)
        low, high = (d, high) if borne > force else (low, d)
    return low
