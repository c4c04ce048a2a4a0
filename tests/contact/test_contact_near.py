"""Claim: pairs that sweeps leave out because nothing brings them into reach change nothing: a list whose gaps say that
every pair is close, so that each is looked at in every color, gives the same bits of positions, limits and adjoints."""

import sys
from typing import Any

import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd import ops
from diffvbd.mesh import box, join, sheet
from diffvbd.testing import generator

HELD, FRICTION = "sheet", 0.3


def thrown(speed: float) -> tuple[dv.Model, Tensor, Tensor]:
    """Four boxes above each other, each askew, thrown together above a floor."""
    cube, shifts = box(2, 0.2), torch.linspace(0.0, 0.03, 4).tolist()
    bodies = join([cube.translate((a, 0.004 + 0.204 * k, 0.5 * a)) for k, a in enumerate(shifts)])
    energies = (dv.StableNeoHookean(), dv.PairBarrier(kappa=1e4, dhat=0.01), dv.FloorBarrier(0.0, kappa=1e4, dhat=0.01),
                dv.Friction(FRICTION))  # fmt: skip
    model = dv.Model(bodies, energies=energies)
    v = torch.zeros_like(model.rest_points)
    v[:, 1] = -speed * model.rest_points[:, 1]
    return model, model.rest_points, v


def folding() -> tuple[dv.Model, Tensor, Tensor]:
    """A pinned sheet whose pairs are its own."""
    body = sheet(9, 9, (0.4, 0.4), 0.005)
    model = dv.Model(body, pinned=torch.from_numpy(body.points[:, 0] < 1e-9), start="predictor",
                     energies=(dv.StableNeoHookean(), dv.PairBarrier(kappa=1e4, dhat=0.02)))  # fmt: skip
    v = torch.zeros_like(model.rest_points)
    v[:, 1] = -30.0 * model.rest_points[:, 0] ** 2  # fast enough for its pairs to push within three steps
    return model, model.rest_points, torch.where(model.pinned[:, None], 0.0, v)


def run(fields: ops.SweepFields, rest: Tensor, plan: Tensor, settings: ops.SweepSettings) -> dict[str, Tensor]:
    x, tape, cut, corrections = ops.sweep(fields, rest, plan, settings, ops.FULL_TAPE)
    bar = torch.from_numpy(generator(0).standard_normal(x.shape))
    wants: dict[str, bool] = {name: True for name in ops.SWEEP_ADJOINTS}
    bars = ops.sweep_backward(bar, x, tape, corrections, cut, fields, rest, plan, settings, ops.FULL_TAPE, wants)
    return {"x": x, "cut": cut, **bars}


@pytest.mark.filterwarnings("ignore:tets")
@pytest.mark.parametrize("scene", ["slow", "fast", "sheet"])
def test_what_is_left_out_changes_nothing(monkeypatch: pytest.MonkeyPatch, scene: str) -> None:
    model, x, v = folding() if scene == HELD else thrown(1.0 if scene == "slow" else 20.0)
    step, calls = sys.modules["diffvbd.step.contact"], []
    own = step.sweep

    def noted(*arguments: Any, **options: Any) -> Any:
        calls.append(arguments)
        return own(*arguments, **options)

    monkeypatch.setattr(step, "sweep", noted)
    for _ in range(3):
        x, v = dv.step(model, x, v, mu=1e5, lam=2e5, time_step=1 / 60, sweeps=6)
    active = moved = 0
    for fields, rest, plan, settings in calls:
        constants = fields.constants.clone()
        constants[:, -1] = -1.0
        near, all_of_them = (run(fields._replace(constants=c), rest, plan, settings)
                             for c in (fields.constants, constants))  # fmt: skip
        for name, value in near.items():
            assert torch.equal(value, all_of_them[name]), name
        active += int(near["kappa"].count_nonzero())
        moved += int((fields.constants[:, -1] > fields.constants[:, 0]).count_nonzero())
    assert active > 0 and moved > 0  # some pairs push, and some are out of reach at first
