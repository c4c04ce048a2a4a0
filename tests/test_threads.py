"""Claim: debug_checks() and record() hold for the thread or task that is inside, and for its backward."""

import threading
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd._common import context as scopes
from diffvbd.testing import debug_checks

OPTIONS: dict[str, Any] = {"mu": 1e4, "lam": 2e4, "solver": dv.VBD(0.01, 2)}


def overflowing(run: Callable[..., Any] = dv.step) -> None:
    """A step in which positions cease to be finite: an error inside debug_checks(), none outside."""
    model = dv.Model(dv.mesh.cube(2))
    run(model, model.rest_points, 1e200 * model.rest_points, **OPTIONS)


def touching() -> tuple[dv.Model, Tensor]:
    """Two cubes that are near each other, for which a step searches twice."""
    mesh = dv.mesh.join([dv.mesh.cube(2, size=0.2), dv.mesh.cube(2, size=0.2).translate((0.0, 0.21, 0.0))])
    model = dv.Model(mesh, energies=(dv.StableNeoHookean(), dv.PairBarrier(detections=2)))
    return model, model.rest_points


def in_thread(run: Callable[[], Any]) -> list[BaseException]:
    """What a run in another thread raises."""
    raised: list[BaseException] = []

    def caught() -> None:
        try:
            run()
        except BaseException as error:
            raised.append(error)

    thread = threading.Thread(target=caught)
    thread.start()
    thread.join()
    return raised


def test_another_thread_is_not_checked() -> None:
    with debug_checks():
        assert not in_thread(overflowing)
        with pytest.raises(RuntimeError, match="step 0, sweep"):
            overflowing()
        with debug_checks(False):
            overflowing()
    overflowing()


def test_another_thread_is_not_recorded() -> None:
    model, x = touching()
    with dv.record("contact") as mine:
        assert not in_thread(lambda: dv.step(model, x, torch.zeros_like(x), **OPTIONS))
        assert mine == []
        with dv.record("contact") as inner:
            dv.step(model, x, torch.zeros_like(x), **OPTIONS)
        dv.step(model, x, torch.zeros_like(x), **OPTIONS)
    dv.step(model, x, torch.zeros_like(x), **OPTIONS)
    assert (len(mine), len(inner)) == (4, 2)


def test_a_checkpointed_backward_in_another_thread_is_recorded() -> None:
    """As torch does it on CUDA, whose backward has threads of its own."""
    model, x = touching()
    v = torch.zeros_like(x, requires_grad=True)
    with dv.record("contact") as found:
        end = dv.rollout(model, x, v, steps=4, checkpoint_every=2, save="last", **OPTIONS)
        assert len(found) == 8
        assert not in_thread(end.x[-1].sum().backward)
    assert len(found) == 16 and v.grad is not None and v.grad.abs().max() > 0


def test_a_compiled_step_sees_the_switch() -> None:
    torch.compiler.reset()

    def run(x: Tensor) -> Tensor:
        return x + 1 if scopes.checking() else 2 * x

    compiled, x = torch.compile(run, fullgraph=True, backend="eager"), torch.full((), 3.0)
    for _ in range(2):
        assert compiled(x) == 6
        with debug_checks():
            assert compiled(x) == 4
            with debug_checks(False):
                assert compiled(x) == 6
            assert compiled(x) == 4
