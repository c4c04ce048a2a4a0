"""How a step and its gradients are held against the reference: measurements, bars, scenes of every shape.

The bar of a gradient is max(1e-12, 10 x spread), where spread is the disagreement of two references that differ only in
rounding (`diffvbd.testing.spread`; in scenes that are limited by conditioning on purpose also
`diffvbd.testing.sensitivity`), asked for only where an error is above 1e-12. The references always run on the CPU, once
for all devices.
"""

import functools
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

import diffvbd as dv
from diffvbd import reference, testing
from diffvbd.testing import build_scene, evaluate, generator, relative_error, tolerance
from helpers.regimes import forced
from helpers.results import TAPES
from helpers.spreads import beyond

CONDITIONED = ("tiny_strain", "huge_strain", "huge_saturated")  # rounding decides many of their digits


@dataclass(frozen=True)
class Measurement:
    """Errors of the worst tape policy and spreads of one scene, by entry of `testing.evaluate`."""

    row: tuple  # case, kind, size, sweeps, steps
    errors: dict[str, float]
    zeros: frozenset[str]  # gradients that vanish in both
    velocity_error: float  # of v, on the scale on which x is rounded

    @property
    def gradients(self) -> list[str]:
        return [name for name in self.errors if name.startswith("grad_")]

    def floor(self, name: str) -> float:
        return tolerance("adjoint" if name.startswith("grad_") else "forward")

    @functools.cached_property
    def spreads(self) -> dict[str, float]:
        """What rounding alone does; costs executions of the reference."""
        spreads = disagreements(*self.row)
        errors = {name: error for name, error in self.errors.items() if name != "v"}
        above = beyond(errors, {name: self.floor(name) for name in errors}, [lambda: spreads])
        if self.row[0] in CONDITIONED and above:
            # one permutation is one sample: ask also what an ulp in the inputs does to this scene
            moved = sensitivities(*self.row)
            spreads = {name: max(spreads[name], moved[name]) for name in spreads}
        return spreads

    def bar(self, name: str, error: float | None = None) -> float:
        """Of an entry; its floor where the error (by default that of the entry) is below it."""
        floor = self.floor(name)
        if (self.errors[name] if error is None else error) <= floor:
            return floor
        return max(floor, tolerance("spread_factor") * self.spreads[name])

    @property
    def worst(self) -> str:
        return max(self.gradients, key=lambda name: self.errors[name] / self.bar(name))

    @property
    def spread(self) -> float:
        return max(self.spreads[name] for name in self.gradients)


MEASURED: dict[tuple, Measurement] = {}


def compiled_result(model: Any, inputs: dict, solver: dv.VBD, steps: int) -> dict[str, Tensor]:
    """`testing.evaluate` of the package's own step or rollout, on the CPU whatever the model's device."""

    def run(**given: Any) -> tuple[Tensor, Tensor]:
        if steps == 1:
            return dv.step(model, solver=solver, **given)
        end = dv.rollout(model, solver=solver, steps=steps, save="last", **given)
        return end.x[-1], end.v[-1]

    return testing.on_device(evaluate(run, inputs, solver.time_step), "cpu")


@functools.cache
def expectation(case: str, kind: str, size: str, sweeps: int, steps: int) -> dict[str, Tensor]:
    """Result of the reference."""
    scene = build_scene(case, kind, size)
    return testing.reference_result(scene.model(), scene.inputs(), scene.solver(sweeps), steps)


@functools.cache
def disagreements(case: str, kind: str, size: str, sweeps: int, steps: int) -> dict[str, float]:
    """Spreads of the reference."""
    scene = build_scene(case, kind, size)
    expected = expectation(case, kind, size, sweeps, steps)
    return testing.spread(scene.model(), scene.inputs(), scene.solver(sweeps), steps, expected)


@functools.cache
def sensitivities(case: str, kind: str, size: str, sweeps: int, steps: int) -> dict[str, float]:
    """How far an ulp in the inputs moves the reference."""
    scene = build_scene(case, kind, size)
    expected = expectation(case, kind, size, sweeps, steps)
    return testing.sensitivity(scene.model(), scene.inputs(), scene.solver(sweeps), steps, expected)


@functools.cache
def measure(place: str, case: str, kind: str, size: str, sweeps: int, steps: int) -> Measurement:
    """Errors on a device, or, for a place like "cuda block", in one of its regimes."""
    row = (case, kind, size, sweeps, steps)
    scene = build_scene(case, kind, size)
    expected = expectation(*row)
    device, _, regime = place.partition(" ")
    model, inputs = scene.model(device), scene.inputs(device=device)
    with forced(regime or None):
        results = [compiled_result(model, inputs, scene.solver(sweeps, tape=tape), steps) for tape in TAPES]
    full, _, recompute = results
    assert all(torch.equal(full[name], recompute[name]) for name in full), "recompute must repeat full to the bit"
    zeros = frozenset(name for name in expected if not any(r[name].any() for r in (expected, *results)))
    errors = {name: max(relative_error(r[name], expected[name]) for r in results) for name in expected}
    scale = float(expected["x"].abs().max()) / scene.case.time_step
    velocity = max(float((r["v"] - expected["v"]).abs().max()) for r in results) / scale
    MEASURED[(place, *row)] = result = Measurement(row, errors, zeros, velocity)
    return result


@functools.cache
def may_vanish(name: str, case: str, kind: str, size: str, sweeps: int, steps: int) -> bool:
    """Whether an argument has no say: with another value of it the reference ends in the same bits."""
    scene = build_scene(case, kind, size)
    model, inputs = scene.model(), scene.inputs()
    value = inputs[name]
    scale = float(value.nan_to_num().abs().max()) or 1.0
    inputs[name] = value + 1e-6 * scale * torch.as_tensor(
        generator("another", name).uniform(0.5, 1, tuple(value.shape))
    )
    moved = reference.rollout(model, solver=scene.solver(sweeps), steps=steps, **inputs)
    expected = expectation(case, kind, size, sweeps, steps)
    return torch.equal(moved.x[-1], expected["x"]) and torch.equal(moved.v[-1], expected["v"])


def check(place: str, case: str, kind: str, size: str, sweeps: int, steps: int) -> None:
    m = measure(place, case, kind, size, sweeps, steps)
    for name, error in (("x", m.errors["x"]), ("v", m.velocity_error)):
        forward = m.bar("x", error)
        assert error <= forward, f"{name}: {error:.1e} > {forward:.1e}"
    missing = [name for name in m.zeros if not may_vanish(name.removeprefix("grad_"), case, kind, size, sweeps, steps)]
    assert not missing, f"gradients that must not vanish: {missing}"
    failures = [
        f"{name}: error {m.errors[name]:.1e} > bar {m.bar(name):.1e}"
        for name in m.gradients
        if not m.errors[name] <= m.bar(name)
    ]
    assert not failures, "; ".join(failures)


BATCHED = {  # shapes of each argument over scenes [2, 3]; V vertices, T tets, P planes
    "own": {"mu": (2, 3, "T"), "lam": (2, 3, "T"), "density": (2, 3, "T"), "force": (2, 3, "V", 3),
            "gravity": (2, 3, "V", 3), "prescribed": (2, 3, "V", 3), "rest_points": (2, 3, "V", 3),
            "floor_kappa": (2, 3), "floor_height": (2, 3, "P"), "floor_normal": (2, 3, "P", 3),
            "anchor_stiffness": (2, 3, "V"), "anchor_points": (2, 3, "V", 3)},
    "shared": {"mu": (1,), "lam": ("T",), "density": (1,), "force": (1, 3), "gravity": (3,), "prescribed": ("V", 3),
               "rest_points": ("V", 3), "floor_kappa": (), "floor_height": ("P",),
               "floor_normal": ("P", 3), "anchor_stiffness": ("V",), "anchor_points": ("V", 3)},
    "mixed": {"mu": (2, 3, 1), "lam": (3, 1), "density": (2, 1, 1), "force": (3, 1, 3), "gravity": (2, 1, 1, 3),
              "prescribed": (3, "V", 3), "rest_points": (2, 1, "V", 3), "floor_dhat": (3,),
              "floor_damping": (2, 1), "floor_height": (3, "P"), "anchor_points": (2, 1, "V", 3)},
}  # fmt: skip


@functools.cache
def scene_of_shapes(shapes: str, sweeps: int) -> tuple[dv.Model, dict[str, Any], dict[str, Tensor]]:
    """Model, inputs and the reference's result of six scenes whose arguments have the shapes of an entry of BATCHED."""
    scene = build_scene("anchored", "random", "small")
    planes = ((0.0, 1.0, 0.0), (-0.6, 0.8, 0.0))
    floor = dv.FloorBarrier(height=(-0.06, -0.7), normal=planes, kappa=2e4, dhat=0.1, damping=20.0)
    model = dv.Model(dv.TetMesh(scene.points, scene.tets), pinned=torch.from_numpy(scene.pinned),
                     energies=(dv.StableNeoHookean(), floor, dv.Anchor(2e3)))  # fmt: skip
    sizes = {"T": model.num_tets, "V": model.num_vertices, "P": len(planes)}
    rng = generator("shapes")

    def shaped(base: Tensor, shape: tuple) -> Tensor:
        """Values near those of `base` [own dimensions], in a shape that broadcasts over scenes."""
        shape = tuple(sizes.get(n, n) for n in shape)
        values = base.expand(2, 3, *base.shape)
        for d, n in enumerate(reversed(shape), start=1):
            values = values.narrow(-d, 0, 1) if n == 1 else values
        values = values[(0,) * (values.dim() - len(shape))]
        return values * torch.as_tensor(rng.uniform(0.999, 1.001, shape))

    base: dict[str, Any] = scene.inputs()
    base |= {"floor_normal": torch.tensor(planes), "floor_height": torch.tensor([-0.06, -0.7]),
             "floor_damping": torch.tensor(20.0)}  # fmt: skip
    base["gravity"] = base["gravity"].expand_as(base["force"])
    inputs: dict[str, Any] = {}
    inputs |= {name: shaped(base[name], (2, 3, "V", 3)) for name in ("x", "v")}
    for name, shape in BATCHED[shapes].items():
        inputs[name] = shaped(base[name].double(), shape)
    return model, inputs, testing.reference_result(model, inputs, scene.solver(sweeps))


def check_shapes(device: str, shapes: str, sweeps: int, regime: str | None = None) -> None:
    model, inputs, expected = scene_of_shapes(shapes, sweeps)
    with forced(regime):
        solver = build_scene("anchored", "random", "small").solver(sweeps, tape="full")
        result = compiled_result(model.to(device), testing.on_device(inputs, device), solver, 1)
    assert relative_error(result["x"], expected["x"]) <= tolerance("forward")
    for name in expected:
        assert result[name].any(), name
        if name.startswith("grad_"):
            assert relative_error(result[name], expected[name]) <= tolerance("adjoint"), name
