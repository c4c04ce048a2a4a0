"""Claim: a Model on a CUDA device is the same Model: it moves there and back, follows the current stream and its own
device, checks what it can without waiting, and survives running out of memory."""

import copy
import gc
import math
import re
from typing import Any

import pytest
import torch
from helpers.regimes import REGIMES, forced, large_inputs, large_solver
from helpers.results import assert_same_bits, evaluated
from torch import Tensor

import diffvbd as dv
from diffvbd.testing import build_scene, generator, on_device, tolerance

pytestmark = pytest.mark.cuda

NAN = float("nan")


# --- there and back ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", (torch.float64, torch.float32), ids=("float64", "float32"))
def test_a_model_moves_and_comes_back_the_same(dtype: torch.dtype) -> None:
    scene = build_scene("anchored")
    here, inputs, solver = scene.model().to(dtype=dtype), scene.inputs(dtype), scene.solver(3, tape="full")
    there = here.to("cuda")
    assert here.device.type == "cpu" and there.device.type == "cuda" and there.dtype == dtype
    assert all(t.device.type == "cuda" for t in vars(there).values() if isinstance(t, Tensor))
    assert "cuda" in repr(there)
    back = there.to("cpu")

    def found(model: dv.Model, given: dict[str, Any]) -> dict[str, Tensor]:
        """Without the gradients that vanish."""
        return {name: value for name, value in evaluated(model, given, solver).items() if value.any()}

    assert_same_bits(found(back, inputs), found(here, inputs))
    density, pinned = (torch.from_numpy(a) for a in (scene.arrays["density"], scene.pinned))
    built = dv.Model(here.mesh, density, pinned, scene.energies(), dtype=dtype, device="cuda")
    moved = on_device(inputs, "cuda")
    expected = found(there, moved)
    through = there.to(dtype=torch.float32).to(dtype=torch.float64).to(dtype=dtype)
    for same in (built, there.to("cpu").to("cuda"), copy.deepcopy(there), through):
        assert_same_bits(found(same, moved), expected)


# --- arguments --------------------------------------------------------------------------------------------------------

NAMES = ("x", "v", "mu", "lam", "force", "gravity", "prescribed", "rest_points", "density", "floor_kappa",
         "anchor_stiffness")  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_a_tensor_on_another_device_raises(name: str) -> None:
    scene = build_scene("anchored")
    for place, other in (("cuda", "cpu"), ("cpu", "cuda")):
        model, inputs = scene.model(place), scene.inputs(device=place)
        inputs[name] = inputs[name].to(other)
        with pytest.raises(ValueError, match=rf"{name}: expected device {place}.*got {other}"):
            dv.step(model, solver=scene.solver(1), **inputs)


@pytest.mark.parametrize("regime", (None, *REGIMES))
@pytest.mark.parametrize("name", ("x", "v", "mu", "force", "rest_points", "floor_kappa"))
def test_a_bad_value_outside_debug_checks_comes_out_as_nan(name: str, regime: str | None) -> None:
    """Nobody looks at it, nothing hangs, other scenes do not see it, and the next step works."""
    scene = build_scene("batch")
    model, inputs = scene.model("cuda"), scene.inputs(device="cuda")
    with forced(regime):
        good = dv.step(model, solver=scene.solver(2), **inputs)
        value = inputs[name]
        shape = (3, *value.shape) if value.dim() == 0 or value.shape[0] != 3 else value.shape
        bad = value.expand(shape).clone()
        bad[1] = NAN
        x, _ = dv.step(model, solver=scene.solver(2), **(inputs | {name: bad}))
        assert not torch.isfinite(x[1]).all()
        assert torch.isfinite(x[[0, 2]]).all()
        again = dv.step(model, solver=scene.solver(2), **inputs)
    assert torch.equal(again[0], good[0]) and torch.equal(again[1], good[1])


# --- streams and devices ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("regime", REGIMES)
def test_work_is_queued_on_the_current_stream(regime: str) -> None:
    """The arguments are written late, on a side stream: a kernel on any other stream would read the old values."""
    scene = build_scene("batch")
    model, inputs = scene.model("cuda"), scene.inputs(device="cuda")
    names = ("x", "v", "mu", "lam")
    rest = {name: value for name, value in inputs.items() if name not in names}
    weights = torch.as_tensor(generator("weights").standard_normal(tuple(inputs["x"].shape)), device="cuda")

    def run(leaves: list[Tensor]) -> list[Tensor]:
        end, v = dv.step(model, solver=scene.solver(3), **dict(zip(names, leaves, strict=True)), **rest)
        return [end.detach(), *torch.autograd.grad((weights * (end + 0.01 * v)).sum(), leaves)]

    with forced(regime):
        expected = run([inputs[name].clone().requires_grad_() for name in names])
        late = [torch.ones_like(inputs[name]) for name in names]
        torch.cuda.synchronize()
        side = torch.cuda.Stream()
        with torch.cuda.stream(side):
            torch.cuda._sleep(100_000_000)
            for t, name in zip(late, names, strict=True):
                t.copy_(inputs[name])
            actual = run([t.requires_grad_() for t in late])
        side.synchronize()
    for a, b in zip(actual, expected, strict=True):
        assert b.any() and torch.equal(a, b)


@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="needs two CUDA devices")
@pytest.mark.parametrize("regime", (None, *REGIMES))
def test_a_second_device(regime: str | None) -> None:
    """While the first is the current one, forward and backward run where the tensors are."""
    scene = build_scene("batch", "random")
    solver = scene.solver(3, tape="full")
    with forced(regime):
        expected = evaluated(scene.model("cuda:0"), scene.inputs(device="cuda:0"), solver)
        actual = evaluated(scene.model("cuda:1"), scene.inputs(device="cuda:1"), solver)
        assert torch.cuda.current_device() == 0
        moved = evaluated(scene.model("cuda:0").to("cuda:1"), scene.inputs(device="cuda:1"), solver)
    for name, value in expected.items():
        assert actual[name].device == torch.device("cuda:1")
        assert torch.equal(actual[name].cpu(), value.cpu()) and torch.equal(moved[name], actual[name]), name
    inputs = scene.inputs(device="cuda:1")
    with pytest.raises(ValueError, match="x: expected device cuda:0.*got cuda:1"):
        dv.step(scene.model("cuda:0"), solver=scene.solver(1), **inputs)


# --- out of memory ----------------------------------------------------------------------------------------------------


def sweeps_that_do_not_fit(model: dv.Model, scenes: int) -> int:
    """So many that a full tape takes twice the free memory, and a compact one two thirds of it."""
    torch.cuda.empty_cache()
    free, _ = torch.cuda.mem_get_info()
    return int(2 * free / (scenes * model.num_active * 72))


def test_a_tape_that_does_not_fit_says_which_would() -> None:
    model = dv.Model(dv.mesh.cube(11), device="cuda")
    modulus = torch.tensor(1e4, dtype=torch.float64, device="cuda")
    small = model.rest_points[None] + 0.001
    inputs, solver = {"x": small, "v": 0 * small, "mu": modulus, "lam": modulus}, dv.VBD(0.01, 3, tape="full")
    expected = evaluated(model, inputs, solver)
    x = model.rest_points.expand(64, -1, -1).clone().requires_grad_()
    sweeps = sweeps_that_do_not_fit(model, 64)
    used = torch.cuda.memory_allocated()
    with pytest.raises(torch.OutOfMemoryError) as error:
        dv.step(model, x, torch.zeros_like(x), dv.VBD(0.01, sweeps, tape="full"), mu=1e4, lam=1e4)
    message = str(error.value)
    assert re.search(r"\d.*(bytes|[KMGT]i?B)", message) and re.search("compact|recompute", message), message
    assert "tape" in message, message
    del error
    gc.collect()  # a traceback and its frames refer to each other
    assert torch.cuda.memory_allocated() <= used
    assert_same_bits(evaluated(model, inputs, solver), expected)


@pytest.mark.parametrize(("cells", "lead", "tape"), ((10, (), "full"), (10, (50,), "full"), (1, (50_000,), "recompute"),
                         (10, (50,), "compact"), (31, (), "compact")))  # fmt: skip
def test_memory_prediction(cells: int, lead: tuple[int, ...], tape: Any) -> None:
    """Peak of a step and its backward against dv.memory(), with what the arguments and gradients themselves take."""
    model, inputs = large_inputs(cells, *lead)
    solver = large_solver(30, tape=tape)
    predicted = dv.memory(model, solver, scenes=math.prod(lead), checkpoint_every=None)["total"]
    leaves = {name: inputs[name].clone().requires_grad_() for name in ("x", "v", "mu", "lam")}

    def run() -> None:
        end, _ = dv.step(model, solver=solver, **leaves)
        torch.autograd.grad(end.sum(), list(leaves.values()))

    run()
    torch.cuda.synchronize()
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    run()
    peak = torch.cuda.max_memory_allocated() - before
    own = sum(t.numel() * t.element_size() for t in leaves.values())
    assert peak <= (1 + tolerance("memory")) * predicted + own, (peak, predicted, own)
