"""An allocation that fails on the CPU says how many bytes a step wanted and what to change; the process goes on."""

import re

import pytest
import torch

import diffvbd as dv
from diffvbd.model.system import system_of
from diffvbd.ops import FULL_TAPE, NO_TAPE
from diffvbd.ops.sweep import backward_memory

SWEEPS, SCENES = 2**31 - 1, 256  # more bytes than addresses


@pytest.mark.parametrize("kind", ["plain", "floor", "contact"])
@pytest.mark.parametrize("tape", ["full", "compact"])
def test_a_tape_that_does_not_fit(kind: str, tape: str) -> None:
    energies: tuple = (dv.StableNeoHookean(),)
    energies += (dv.FloorBarrier(height=-1.0),) if kind == "floor" else ()
    energies += (dv.PairBarrier(),) if kind == "contact" else ()
    model = dv.Model(dv.mesh.cube(3, size=0.2), pinned=[0, 1], energies=energies)
    x = model.rest_points.expand(SCENES, -1, -1).clone().requires_grad_()
    options = {"mu": 1e4, "lam": 1e4}
    with pytest.raises(torch.OutOfMemoryError) as error:
        dv.step(model, x, torch.zeros_like(x), dv.VBD(0.01, SWEEPS, tape=tape), **options)
    kept = {"plain": 0, "floor": 4, "contact": 3}[kind]
    scalars = {"full": 9 + kept, "compact": kept or 3}[tape]
    wanted = 8 * scalars * SCENES * SWEEPS * model.num_active
    found = re.search(rf'CPU out of memory: a step of {SWEEPS} sweeps with tape="{tape}" wanted (\d+) bytes',
                      str(error.value))  # fmt: skip
    assert found and wanted <= int(found[1]) <= wanted + 4 * x.numel() * 8
    assert "fewer sweeps or scenes" in str(error.value)
    assert ('"compact"' in str(error.value)) == (tape == "full" or 'tape="compact"' in str(error.value))
    end, _ = dv.step(model, x, torch.zeros_like(x), dv.VBD(0.01, 1, tape=tape), **options)
    assert torch.isfinite(torch.autograd.grad(end.sum(), x)[0]).all()


def test_a_backward_that_does_not_fit() -> None:
    """As the backward sees it: a forward of so many sweeps would take days."""
    model = dv.Model(dv.mesh.cube(3, size=0.2))
    settings = system_of(model, dv.VBD(0.01, SWEEPS)).settings(0.01, SWEEPS)
    x = model.rest_points[None]
    made = 8 * 9 * SWEEPS * model.num_active
    for policy, text in ((NO_TAPE, f"with a tape of {made} bytes"), (FULL_TAPE, ": use fewer sweeps")):
        with pytest.raises(torch.OutOfMemoryError, match=f"^CPU out of memory in the backward of a step.*{text}"):
            with backward_memory(x, settings, policy):
                x.new_empty((2**60,))
    with pytest.raises(RuntimeError, match="^other$"), backward_memory(x, settings, NO_TAPE):
        raise RuntimeError("other")
