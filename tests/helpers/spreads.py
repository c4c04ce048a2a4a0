"""How near a result must come to the reference, and to one with the same corrections or combinations.

The bar of an error is a floor, or ten times what rounding makes of the reference if that is more. A sample of rounding
is one more execution of the reference, so it is taken only where an error lies above its floor.
"""

from collections.abc import Callable, Iterable
from typing import Any

from torch import Tensor

from diffvbd import testing
from diffvbd.testing import relative_error, tolerance

Sample = Callable[[], dict[str, float]]  # how far rounding moves each entry

# Some edges of this scene are almost parallel: their closest points round by eps / sin^2, which no order of sums shows.
# One unit in the last place of x moves its gradients by up to 2e-10.
PARALLEL = {"folded": 20.0}


def beyond(errors: dict[str, float], floors: dict[str, float], samples: Iterable[Sample]) -> dict[str, str]:
    """Entries whose error is above its bar, with both. Samples are taken one after another, up to the first with which
    all errors are within their bars."""
    bars = dict(floors)
    for sample in samples:
        if all(error <= bars[name] for name, error in errors.items()):
            break
        spreads = sample()
        bars = {name: max(bar, tolerance("spread_factor") * spreads[name]) for name, bar in bars.items()}
    return {n: f"error {e:.1e} > bar {bars[n]:.1e}" for n, e in errors.items() if not e <= bars[n]}


def errors_between(result: dict[str, Tensor], expected: dict[str, Tensor]) -> dict[str, float]:
    return {name: relative_error(result[name], value) for name, value in expected.items()}


def assert_near_contact(result: dict[str, Tensor], expected: dict[str, Tensor], forward: float, adjoint: float,
                        time_step: float, others: Iterable[Callable[[], dict[str, Tensor]]]) -> None:  # fmt: skip
    """Every entry of steps with contact within its bar. forward, adjoint: floors of positions and of gradients.
    others: the reference once more, with other roundings."""
    floors = {name: adjoint for name in expected} | {"x": forward, "v": forward / time_step}
    samples = [lambda other=other: errors_between(other(), expected) for other in others]
    failures = beyond(errors_between(result, expected), floors, samples)
    assert not failures, failures


def assert_near_reference(model: Any, inputs: dict, solver: Any, steps: int, result: dict[str, Tensor],
                          *decisions: Any) -> dict[str, Tensor]:  # fmt: skip
    """Every entry of `result` within what rounding makes of the reference; returns the reference's. decisions: lengths
    of the corrections, and what was combined, as testing.reference_result takes them."""
    expected = testing.reference_result(model, inputs, solver, steps, None, *decisions)
    floors = {name: tolerance("adjoint") for name in expected}
    floors |= {"x": tolerance("coarse_forward"), "v": tolerance("cancelling")}
    # one permutation is one sample: the second asks what an ulp in the inputs does to this scene
    samples = [
        lambda sample=sample: sample(model, inputs, solver, steps, expected, *decisions)
        for sample in (testing.spread, testing.sensitivity)
    ]
    failures = beyond(errors_between(result, expected), floors, samples)
    assert not failures, failures
    return expected
