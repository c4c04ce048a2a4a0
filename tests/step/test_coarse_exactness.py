"""Claim: steps with coarse corrections, and their gradients, equal autograd through an independent execution of the
same steps with the same lengths of the corrections."""

import itertools
from typing import Any

import pytest
import torch
from helpers.marks import slow
from helpers.spreads import assert_near_reference
from torch import Tensor

import diffvbd as dv
from diffvbd import testing
from diffvbd.testing import CASES, build_scene, evaluate

EXACT = [name for name, case in CASES.items() if case.block == "exact" and case.saturation is None]
SPACES = (dv.CoarseSpace(functions=10, groups=3), dv.CoarseSpace(functions=4, groups=1, every=2), dv.CoarseSpace())
SWEEPS = (0, 1, 3, 5, 20)


def compiled(model: Any, inputs: dict, sweeps: int, steps: int, tape: str) -> tuple[dict[str, Tensor], list[Tensor]]:
    adjoint, lengths = dv.ReverseSweep(tape=tape), []

    def run(**options: Any) -> tuple[Tensor, Tensor]:
        nonlocal lengths
        with dv.coarse.record() as lengths:
            end = dv.rollout(model, steps=steps, sweeps=sweeps, adjoint=adjoint, save="last", **options)
        return end.x[-1], end.v[-1]

    return evaluate(run, inputs), lengths


def recorded(model: Any, inputs: dict, lengths: list[Tensor]) -> list[Tensor]:
    """[corrections, ..., bodies] of each step, as the reference takes them."""
    lead = inputs["x"].shape[:-2]
    return [t.transpose(0, 1).reshape(t.shape[1], *lead, t.shape[2]) for t in lengths]


def check(device: str, case: str, kind: str, space: dv.CoarseSpace, sweeps: int, steps: int, tape: str
          ) -> list[Tensor]:  # fmt: skip
    scene = build_scene(case, kind, "small")
    model, inputs = scene.model(device, coarse=space), scene.inputs(device=device)
    result, lengths = compiled(model, inputs, sweeps, steps, tape)
    assert len(lengths) == steps and all(t.shape[1] == space.corrections(sweeps) for t in lengths)
    given = recorded(model, inputs, lengths)
    expected = assert_near_reference(model, inputs, sweeps, steps, result, given)
    for name, value in expected.items():
        if name in ("grad_x", "grad_v") or (name in ("grad_mu", "grad_density") and (sweeps or lengths[0].any())):
            assert value.abs().max() > 0, name
    return lengths


def rows() -> list[Any]:
    """Each case once, with space, sweeps, mesh and tape in turn; the others are slow."""
    out = []
    for i, (case, (j, sweeps)) in enumerate(itertools.product(EXACT, enumerate(SWEEPS))):
        at = (case, testing.KINDS[(i + j) % 3], (i + j) % len(SPACES), sweeps, (1, 2)[i % 2],
              ("full", "compact", "recompute")[(i // 2) % 3])  # fmt: skip
        quick = j == EXACT.index(case) % len(SWEEPS) or case in ("plain", "free")
        out.append(at if quick else slow(*at))
    return out


@pytest.mark.parametrize(("case", "kind", "space", "sweeps", "steps", "tape"), rows())
def test_step_and_rollout(device: str, case: str, kind: str, space: int, sweeps: int, steps: int, tape: str) -> None:
    check(device, case, kind, SPACES[space], sweeps, steps, tape)


def test_lengths_below_one_and_zero_occur(device: str) -> None:
    """What the comparison above is worth: shortened and refused corrections are among its steps."""
    found = torch.cat([lengths.reshape(-1)
                       for case in ("inverted", "violent", "floor_filtered", "huge_strain")
                       for lengths in check(device, case, "structured", SPACES[0], 8, 2, "full")])  # fmt: skip
    assert (found == 1).any() and ((found > 0) & (found < 1)).any() and (found == 0).any(), found
