"""Gradients of a single tetrahedron against finite differences, over six steps of the difference.

One tet of 1 m, deformed and moving, mu = 1e5 Pa, lam = 5e4 Pa, h = 10 ms; unless a check says otherwise one step under
the paper's preset. A central difference moves one entry of x0, v0, mu or lam by a step relative to the largest entry of
that argument. A modulus that is zero may not fall below: it has the one-sided difference of second order, its step
relative to the other modulus. The error of an argument at a step is max |difference - adjoint| / max |adjoint| over its
entries. Large steps truncate, small ones round: what is reported of an argument is its least error over the steps, of a
check its worst argument. A check passes if that is below 1e-6 and stable: below 1e-6 over three neighboring steps,
which are two decades, for every argument. The paper lists six of its eleven checks and does not state their scene.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

import diffvbd as dv
from bench import paper
from bench.tables import Table
from diffvbd import testing
from diffvbd.ops import load as native

STEPS = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8)
BAR = 1e-6
STABLE = 3  # neighboring steps below the bar
CENTRAL = {1: 0.5, -1: -0.5}  # weights of the loss at multiples of the step, both of second order
ONE_SIDED = {0: -1.5, 1: 2.0, 2: -0.5}
Row = dict[str, Any]


@dataclass(frozen=True)
class Check:
    """One configuration. `model` and `solver`: options of dv.Model and dv.VBD.paper, which the check changes."""

    name: str
    sweeps: int = 1
    steps: int = 1
    mu: float = 1e5
    lam: float = 5e4
    device: str | None = None  # None: that of the run
    model: dict[str, Any] = field(default_factory=dict)
    solver: dict[str, Any] = field(default_factory=dict)
    exact: bool = False  # the exact block, without the preset's safeguards


FLOOR = dv.FloorBarrier(height=-0.15, kappa=2e4, dhat=0.3, damping=50.0)
CHECKS = (
    Check("K = 1, CPU", device="cpu"),
    Check("K = 1, GPU", device="cuda"),
    Check("K = 2", sweeps=2),
    Check("K = 3", sweeps=3),
    Check("mu only (lam = 0)", lam=0.0),
    Check("lam only (mu = 0)", mu=0.0),
    Check("exact block, no safeguards", exact=True),
    Check("saturation 1 mm", sweeps=2, solver={"saturation": 1e-3}),
    Check("floor contact with damping", sweeps=2, model={"energies": (dv.StableNeoHookean(), FLOOR)}),
    Check("relaxation 1.6", sweeps=2, solver={"relaxation": 1.6}),
    Check("rollout of four steps, K = 2", sweeps=2, steps=4),
)


def scene(check: Check, device: str) -> tuple[dv.Model, dict[str, Tensor]]:
    """Model and differentiated arguments of a check."""
    mesh = dv.TetMesh([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], [[0, 1, 2, 3]])
    model = dv.Model(mesh, device=device, **check.model)
    noise = testing.generator("finite differences").uniform(-1.0, 1.0, (2, 4, 3))
    moduli = {"mu": torch.full((1,), check.mu), "lam": torch.full((1,), check.lam)}
    arguments = {"x": torch.from_numpy(mesh.points + 0.1 * noise[0]), "v": torch.from_numpy(noise[1]), **moduli}
    return model, {name: value.to(device, torch.float64) for name, value in arguments.items()}


def loss(model: dv.Model, check: Check, arguments: dict[str, Tensor]) -> Tensor:
    """A fixed random linear function of the end state."""
    h = 1e-2
    solver = (dv.VBD if check.exact else dv.VBD.paper)(h, check.sweeps, **check.solver)
    end = dv.rollout(model, solver=solver, **arguments, steps=check.steps, save="last")
    weights = torch.from_numpy(testing.generator("loss").standard_normal((2, 4, 3))).to(model.device)
    return (weights[0] * end.x[-1]).sum() + h * (weights[1] * end.v[-1]).sum()


def errors_of(check: Check, device: str) -> dict[str, list[float]]:
    """Error of each argument's gradient at each step of the difference."""
    model, arguments = scene(check, device)
    leaves = {name: value.clone().requires_grad_() for name, value in arguments.items()}
    adjoints = torch.autograd.grad(loss(model, check, leaves), list(leaves.values()))
    errors = {}
    for (name, value), adjoint in zip(arguments.items(), adjoints, strict=True):
        if not adjoint.any():
            raise RuntimeError(f"{check.name}: expected a gradient to {name}, got zeros")
        scale = float(value.abs().max()) or max(check.mu, check.lam)
        errors[name] = [_error(model, check, arguments, name, step * scale, adjoint) for step in STEPS]
    return errors


def _error(
    model: dv.Model, check: Check, arguments: dict[str, Tensor], name: str, step: float, adjoint: Tensor
) -> float:
    difference = torch.zeros(adjoint.numel(), dtype=torch.float64)
    with torch.no_grad():
        for n in range(adjoint.numel()):
            total = 0.0
            for times, weight in (CENTRAL if arguments[name].any() else ONE_SIDED).items():
                moved = arguments[name].clone()
                moved.view(-1)[n] += times * step
                total += weight * float(loss(model, check, {**arguments, name: moved}))
            difference[n] = total / step
    return testing.relative_error(difference, adjoint.reshape(-1))


def stable(errors: list[float]) -> int:
    """The longest run of neighboring steps whose error is below the bar."""
    longest = run_length = 0
    for error in errors:
        run_length = run_length + 1 if error < BAR else 0
        longest = max(longest, run_length)
    return longest


def evaluate(check: Check, device: str) -> Row:
    where = check.device or device
    if missing := _missing(where):
        return {"name": check.name, "device": where, "missing": missing}
    errors = errors_of(check, where)
    worst = max(errors, key=lambda name: min(errors[name]))
    steps = min(stable(values) for values in errors.values())
    least = min(errors[worst])
    return {"name": check.name, "device": where, "errors": errors, "error": least, "argument": worst,
            "stable_steps": steps, "passed": least < BAR and steps >= STABLE}  # fmt: skip


def _missing(device: str) -> str:
    """What keeps a check off a device, or an empty string."""
    if torch.device(device).type != "cuda":
        return ""
    if not torch.cuda.is_available():
        return "no CUDA device here"
    try:
        native.require_cuda()
    except RuntimeError as error:
        return str(error).splitlines()[0]
    return ""


def run(quick: bool, *, device: str = "cpu") -> dict[str, Any]:
    """All eleven are so short that a quick run leaves none out."""
    return {"checks": [evaluate(check, device) for check in CHECKS]}


TABLES = (
    Table("Finite differences on one tetrahedron", "checks",
          {"check": "name", "largest error": "error", "paper": lambda row: paper.FINITE_DIFFERENCES.get(row["name"]),
           "argument": "argument", "neighboring steps": "stable_steps", "passed": "passed", "not run": "missing"}),
    *(Table(f"Error to {name} over the step of the difference", "checks",
            {"check": "name", **{f"{step:g}": lambda row, n=n, name=name: row["errors"][name][n]
                                 for n, step in enumerate(STEPS)}}, only=lambda row: "errors" in row)
      for name in ("x", "v", "mu", "lam")),
)  # fmt: skip
