"""Claim: accelerated steps, and their gradients, equal autograd through an independent execution of the same steps with
the same decisions."""

import itertools
from typing import Any

import pytest
import torch
from helpers.spreads import assert_near_reference
from torch import Tensor

import diffvbd as dv
from diffvbd import testing
from diffvbd.testing import CASES, build_scene, evaluate

EXACT = [name for name, case in CASES.items() if case.block == "exact" and case.saturation is None]
SPACES = (None, dv.CoarseSpace(functions=10, groups=3, every=1), None, dv.CoarseSpace(functions=4, every=2))
SWEEPS = (0, 1, 3, 5, 20)


def check(case: str, kind: str, space: int, window: int, sweeps: int, steps: int, tape: str) -> list[Tensor]:
    scene = build_scene(case, kind, "small")
    model, inputs = scene.model(coarse=SPACES[space], acceleration=dv.Anderson(window)), scene.inputs()
    lengths, taken, adjoint = [], [], dv.ReverseSweep(tape=tape)

    def run(**options: Any) -> tuple[Tensor, Tensor]:
        nonlocal lengths, taken
        with dv.coarse.record() as lengths, dv.acceleration.record() as taken:
            end = dv.rollout(model, steps=steps, sweeps=sweeps, adjoint=adjoint, save="last", **options)
        return end.x[-1], end.v[-1]

    result = evaluate(run, inputs)
    lead = inputs["x"].shape[:-2]
    given, decided = (
        [t.transpose(0, 1).reshape(t.shape[1], *lead, t.shape[2]) for t in found] for found in (lengths, taken)
    )
    given = given or None
    expected = assert_near_reference(model, inputs, sweeps, steps, result, given, decided)
    for name, value in expected.items():
        if name in ("grad_x", "grad_v") or (name in ("grad_mu", "grad_density") and sweeps):
            assert value.abs().max() > 0, name
    return taken


def rows() -> list[Any]:
    """Each case once, with space, window, sweeps, mesh and tape in turn; the others are run before a release."""
    out = []
    for i, (case, (j, sweeps)) in enumerate(itertools.product(EXACT, enumerate(SWEEPS))):
        at = (case, testing.KINDS[(i + j) % 3], (i + j) % len(SPACES), 1 + i % 3, sweeps, (1, 2)[i % 2],
              ("full", "compact", "recompute")[(i // 2) % 3])  # fmt: skip
        quick = j == 3 + (EXACT.index(case) % 4 == 1) or case in ("plain", "free")  # twenty sweeps of every fourth
        out.append(at if quick else pytest.param(*at, marks=pytest.mark.hours))
    return out


@pytest.mark.parametrize(("case", "kind", "space", "window", "sweeps", "steps", "tape"), rows())
def test_step_and_rollout(case: str, kind: str, space: int, window: int, sweeps: int, steps: int, tape: str) -> None:
    check(case, kind, space, window, sweeps, steps, tape)


def test_combinations_that_are_taken_and_that_are_not_occur() -> None:
    """What the comparison above is worth: both are among its steps."""
    found = [check("inverted", "structured", 1, 2, 5, 1, "full"), check("violent", "structured", 0, 2, 5, 1, "full"),
             check("floor_filtered", "structured", 0, 3, 8, 1, "full")]  # fmt: skip
    found = torch.cat([t.reshape(-1) for taken in found for t in taken])
    assert found.any() and not found.all(), found
