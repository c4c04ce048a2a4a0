"""How near a step with corrections or combinations must come to the reference with the same decisions."""

from typing import Any

from torch import Tensor

from diffvbd import testing
from diffvbd.testing import relative_error, tolerance


def assert_near_reference(model: Any, inputs: dict, sweeps: int, steps: int, result: dict[str, Tensor],
                          *decisions: Any) -> dict[str, Tensor]:  # fmt: skip
    """Every entry of `result` within what rounding makes of the reference; returns the reference's. decisions: lengths
    of the corrections, and what was combined, as testing.reference_result takes them."""
    expected = testing.reference_result(model, inputs, sweeps, steps, None, *decisions)
    spreads = testing.spread(model, inputs, sweeps, steps, expected, *decisions)
    for name, value in expected.items():
        error = relative_error(result[name], value)
        bar = testing.bar(spreads[name])
        if name in ("x", "v"):
            least = tolerance("coarse_forward" if name == "x" else "cancelling")
            bar = max(least, tolerance("spread_factor") * spreads[name])
        if error > bar:  # one permutation is one sample: ask also what an ulp in the inputs does to this scene
            moved = testing.sensitivity(model, inputs, sweeps, steps, expected, *decisions)[name]
            bar = max(bar, tolerance("spread_factor") * moved)
        assert error <= bar, f"{name}: error {error:.1e}, spread {spreads[name]:.1e}"
    return expected
