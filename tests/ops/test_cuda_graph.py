"""Claim: no host in the loop. A whole optimisation iteration is one CUDA graph that replays to the bit, and neither a
step nor its backward waits for the device."""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from helpers.regimes import REGIMES, captured, forced
from helpers.results import TAPES, assert_same_bits, evaluated
from torch import Tensor

import diffvbd as dv
from diffvbd.testing import build_scene, generator

pytestmark = pytest.mark.cuda


@contextlib.contextmanager
def no_synchronisation() -> Iterator[None]:
    """Inside, torch raises where the host waits for the device."""
    torch.cuda.synchronize()
    torch.cuda.set_sync_debug_mode("error")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode("default")


# --- an optimisation in a graph ---------------------------------------------------------------------------------------


class Optimisation:
    """Material, start velocity and floor of a dropped cube are fitted to where its vertices shall be at the end."""

    def __init__(self, steps: int, lead: tuple[int, ...], tape: Any, **options: Any) -> None:
        mesh = dv.mesh.cube(3, 0.1).translate([0.0, 0.01, 0.0])  # 27 vertices, the lowest within dhat
        energies = (dv.StableNeoHookean(), dv.FloorBarrier(kappa=400.0, dhat=0.02, damping=1.0))
        self.model = dv.Model(mesh, energies=energies, device="cuda")
        self.x = self.model.rest_points.expand(*lead, -1, -1).contiguous()
        self.solver = dv.VBD(0.005, 5, tape=tape)
        self.options = {"steps": steps, "save": "last", **options}

        def leaf(value: Tensor | float) -> Tensor:
            return torch.as_tensor(value, dtype=torch.float64).to("cuda").clone().requires_grad_()

        self.leaves = {
            "log_mu": leaf(torch.full((self.model.num_tets,), 9.0)),
            "log_lam": leaf(9.5),
            "speed": leaf(torch.tensor([0.2, -0.5, 0.1])),
            "height": leaf(torch.tensor([-0.001])),
        }
        self.target = self.x + 0.01
        self.optimizer = torch.optim.Adam(list(self.leaves.values()), lr=1e-3, capturable=True)
        self.loss = torch.zeros((), dtype=torch.float64, device="cuda")

    def iteration(self) -> None:
        leaf = self.leaves
        self.optimizer.zero_grad(set_to_none=True)
        end = dv.rollout(self.model, self.x, leaf["speed"].expand_as(self.x), self.solver, mu=leaf["log_mu"].exp(),
                         lam=leaf["log_lam"].exp(), floor_height=leaf["height"], **self.options)  # fmt: skip
        loss = (end.x[-1] - self.target).square().sum()
        loss.backward()
        self.optimizer.step()
        self.loss.copy_(loss.detach())

    def state(self) -> dict[str, Tensor]:
        out = {name: t.detach().clone() for name, t in self.leaves.items()}
        return out | {f"grad_{name}": t.grad.clone() for name, t in self.leaves.items() if t.grad is not None}


def check_optimisation(
    steps: int, lead: tuple[int, ...] = (), regime: str | None = None, tape: str = "auto", **options: Any
) -> None:
    with forced(regime):
        eager, replayed = (Optimisation(steps, lead, tape, **options) for _ in range(2))
        start = eager.state()
        graph = captured(replayed.iteration)
        for _ in range(3):
            eager.iteration()
        for _ in range(4):
            eager.iteration()
            graph.replay()
            assert_same_bits(eager.state(), replayed.state())
            assert torch.equal(eager.loss, replayed.loss) and torch.isfinite(eager.loss)
    end = eager.state()
    assert all(not torch.equal(end[name], value) for name, value in start.items())


def test_an_optimisation_of_a_hundred_steps_replays_to_the_bit() -> None:
    check_optimisation(100)


@pytest.mark.parametrize("tape", TAPES)
@pytest.mark.parametrize("regime", REGIMES)
def test_every_regime_and_tape_can_be_captured(regime: str, tape: str) -> None:
    check_optimisation(6, (3,), regime, tape)


@pytest.mark.parametrize("schedule", (2, dv.BinomialCheckpoints(2)), ids=("segments", "binomial"))
def test_checkpoints_can_be_captured(schedule: Any) -> None:
    check_optimisation(7, checkpoint_every=schedule)


@pytest.mark.parametrize("regime", REGIMES)
def test_a_captured_step_reads_what_its_arguments_hold_now(regime: str) -> None:
    """No value of an argument is baked into the graph."""
    scene = build_scene("batch")
    model, inputs, solver = scene.model("cuda"), scene.inputs(device="cuda"), scene.solver(4)
    x, v = inputs["x"].clone(), inputs["v"].clone()
    options = {name: value for name, value in inputs.items() if name not in ("x", "v")}
    out: dict[str, Tensor] = {}

    def run() -> None:
        out["x"], out["v"] = dv.step(model, x, v, solver, **options)

    with forced(regime), torch.no_grad():
        graph = captured(run, 1)
        for i in range(3):
            given = inputs["x"] + 0.01 * i, inputs["v"] * (1 - 0.3 * i)
            x.copy_(given[0])
            v.copy_(given[1])
            graph.replay()
            expected = dv.step(model, *given, solver, **options)
            assert torch.equal(out["x"], expected[0]) and torch.equal(out["v"], expected[1])


# --- the host does not wait -------------------------------------------------------------------------------------------


def loss_and_gradients(run: Callable[..., tuple[Tensor, Tensor]], inputs: dict[str, Any]) -> Callable[[], list[Tensor]]:
    """A call of `run` and its backward, with leaves and weights made beforehand."""
    leaves = {name: t.clone().requires_grad_() for name, t in inputs.items()}
    weights = torch.as_tensor(generator("loss").standard_normal(tuple(inputs["x"].shape)), device="cuda")

    def once() -> list[Tensor]:
        x, v = run(**leaves)
        grads = torch.autograd.grad((weights * (x + 0.01 * v)).sum(), list(leaves.values()), allow_unused=True)
        return [x, v, *grads]

    return once


@pytest.mark.parametrize("regime", (None, *REGIMES))
@pytest.mark.parametrize("tape", TAPES)
@pytest.mark.parametrize("case", ("plain", "paper", "floor_corner", "anchored", "batch"))
def test_a_step_and_its_backward_do_not_synchronise(case: str, tape: str, regime: str | None) -> None:
    scene = build_scene(case)
    model, inputs, solver = scene.model("cuda"), scene.inputs(device="cuda"), scene.solver(3, tape=tape)
    with forced(regime):
        once = loss_and_gradients(lambda **o: dv.step(model, solver=solver, **o), inputs)
        expected = once()  # kernels are loaded on first use
        with no_synchronisation():
            actual = once()
    assert all(a is b or torch.equal(a, b) for a, b in zip(actual, expected, strict=True))


def test_numbers_and_defaults_do_not_synchronise() -> None:
    """Python numbers, the Model's own constants and gravity as a tuple take no copy that the host waits for."""
    scene = build_scene("anchored")
    model, inputs, solver = scene.model("cuda"), scene.inputs(device="cuda"), dv.VBD(0.01, 2)
    state = {name: inputs[name] for name in ("x", "v")}
    numbers = {"mu": 1e4, "lam": 2e4, "density": 900.0, "gravity": (0.1, -5.0, 0.0), "floor_kappa": 1e3}
    plain = {"mu": 1e4, "lam": 2e4}
    for dtype in (torch.float64, torch.float32):
        there = model.to(dtype=dtype)
        start = {name: t.to(dtype) for name, t in state.items()}
        for options in (numbers, plain):
            dv.step(there, solver=solver, **start, **options)
            with no_synchronisation():
                dv.step(there, solver=solver, **start, **options)
    options: dict[str, Any] = {"steps": 4, "solver": solver, **state, **numbers}
    options |= {"force": dv.per_step(inputs["force"].expand(4, -1, -1)), "mu": lambda k, x, v: inputs["mu"]}
    for schedule in (None, 2):
        dv.rollout(model, checkpoint_every=schedule, **options)
        with no_synchronisation():
            dv.rollout(model, checkpoint_every=schedule, **options)


@pytest.mark.parametrize("schedule", (None, 3, dv.BinomialCheckpoints(2)), ids=("all", "segments", "binomial"))
def test_a_rollout_and_its_backward_do_not_synchronise(schedule: Any) -> None:
    scene = build_scene("floor_damped")
    model, inputs, solver = scene.model("cuda"), scene.inputs(device="cuda"), scene.solver(2)

    def run(**options: Any) -> tuple[Tensor, Tensor]:
        end = dv.rollout(model, solver=solver, steps=7, save="last", checkpoint_every=schedule, **options)
        return end.x[-1], end.v[-1]

    once = loss_and_gradients(run, inputs)
    once()
    with no_synchronisation():
        once()


def test_tapes_without_autograd_do_not_synchronise() -> None:
    scene = build_scene("batch")
    model, inputs = scene.model("cuda"), scene.inputs(device="cuda")
    for place in (contextlib.nullcontext, no_synchronisation):  # kernels are loaded on first use
        with place():
            wrt = ("x", "v", "mu", "lam", "density")
            x, _, tape = dv.step_forward(model, solver=scene.solver(3), wrt=wrt, **inputs)
            dv.step_backward(tape, torch.ones_like(x))


# --- determinism ------------------------------------------------------------------------------------------------------


@pytest.fixture
def deterministic() -> Iterator[None]:
    """Besides, torch then fills new memory with NaN, so that reading what nobody wrote shows."""
    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(False)


@pytest.mark.parametrize("regime", (None, *REGIMES))
@pytest.mark.parametrize("tape", TAPES)
@pytest.mark.parametrize("case", ("paper", "floor_corner", "anchored", "batch"))
def test_deterministic_algorithms(case: str, tape: str, regime: str | None, request: pytest.FixtureRequest) -> None:
    scene = build_scene(case, "random")
    model, inputs, solver = scene.model("cuda"), scene.inputs(device="cuda"), scene.solver(3, tape=tape)
    with forced(regime):
        expected = evaluated(model, inputs, solver)
        request.getfixturevalue("deterministic")
        actual, rebuilt = evaluated(model, inputs, solver), evaluated(scene.model("cuda"), inputs, solver)
    for name, value in expected.items():
        assert torch.equal(actual[name], value), name
        assert torch.equal(rebuilt[name], value), name
