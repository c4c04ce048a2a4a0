"""Claim: the compiled step and its reverse sweep equal autograd through an independent execution of the same sweep.

For every scene the forward comes first, then each gradient. The bar of a gradient is max(1e-12, 10 x spread), where
spread is the disagreement of two references that differ only in rounding (`diffvbd.testing.spread`; in scenes that are
limited by conditioning on purpose also `diffvbd.testing.sensitivity`). A table of the worst scene of each case and
device is printed at the end. The references always run on the CPU, once for all devices.
"""

import contextlib
import functools
import itertools
from dataclasses import dataclass
from typing import Any

import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd import reference, testing
from diffvbd.testing import CASES, KINDS, build_scene, evaluate, generator, relative_error, tolerance

SWEEPS = (0, 1, 2, 5, 20)
TAPES = ("full", "compact", "recompute")
CONDITIONED = ("tiny_strain", "huge_strain", "huge_saturated")  # rounding decides many of their digits


@dataclass(frozen=True)
class Measurement:
    """Errors of the worst tape policy and spreads of one scene, by entry of `testing.evaluate`."""

    errors: dict[str, float]
    spreads: dict[str, float]
    zeros: frozenset[str]  # gradients that vanish in both
    velocity_error: float  # of v, on the scale on which x is rounded

    @property
    def gradients(self) -> list[str]:
        return [name for name in self.errors if name.startswith("grad_")]

    @property
    def worst(self) -> str:
        return max(self.gradients, key=lambda name: self.errors[name] / testing.bar(self.spreads[name]))

    @property
    def spread(self) -> float:
        return max(self.spreads[name] for name in self.gradients)


MEASURED: dict[tuple, Measurement] = {}


def compiled_result(model: Any, inputs: dict, sweeps: int, steps: int, tape: str) -> dict[str, Tensor]:
    """`testing.evaluate` of the package's own step or rollout, on the CPU whatever the model's device."""
    adjoint = dv.ReverseSweep(tape=tape)

    def run(**options: Any) -> tuple[Tensor, Tensor]:
        if steps == 1:
            return dv.step(model, sweeps=sweeps, adjoint=adjoint, **options)
        end = dv.rollout(model, steps=steps, sweeps=sweeps, adjoint=adjoint, save="last", **options)
        return end.x[-1], end.v[-1]

    return testing.on_device(evaluate(run, inputs), "cpu")


def forward_bar(spreads: dict[str, float]) -> float:
    return max(tolerance("forward"), tolerance("spread_factor") * spreads["x"])


@functools.cache
def expectation(case: str, kind: str, size: str, sweeps: int, steps: int) -> tuple[dict[str, Tensor], dict[str, float]]:
    """Result and spreads of the reference."""
    scene = build_scene(case, kind, size)
    model, inputs = scene.model(), scene.inputs()
    expected = testing.reference_result(model, inputs, sweeps, steps)
    return expected, testing.spread(model, inputs, sweeps, steps, expected)


@functools.cache
def sensitivities(case: str, kind: str, size: str, sweeps: int, steps: int) -> dict[str, float]:
    """How far an ulp in the inputs moves the reference."""
    scene = build_scene(case, kind, size)
    expected, _ = expectation(case, kind, size, sweeps, steps)
    return testing.sensitivity(scene.model(), scene.inputs(), sweeps, steps, expected)


def forced(regime: str | None) -> contextlib.AbstractContextManager:
    """The CUDA regime in which everything inside runs; None: the package chooses."""
    return contextlib.nullcontext() if regime is None else dv.regime(regime)


@functools.cache
def measure(place: str, case: str, kind: str, size: str, sweeps: int, steps: int) -> Measurement:
    """Errors on a device, or, for a place like "cuda block", in one of its regimes."""
    row = (case, kind, size, sweeps, steps)
    scene = build_scene(case, kind, size)
    expected, spreads = expectation(*row)
    device, _, regime = place.partition(" ")
    model, inputs = scene.model(device), scene.inputs(device=device)
    with forced(regime or None):
        results = [compiled_result(model, inputs, sweeps, steps, tape) for tape in TAPES]
    full, _, recompute = results
    assert all(torch.equal(full[name], recompute[name]) for name in full), "recompute must repeat full to the bit"
    zeros = frozenset(name for name in expected if not any(r[name].any() for r in (expected, *results)))
    errors = {name: max(relative_error(r[name], expected[name]) for r in results) for name in expected}
    bars = {name: testing.bar(spreads[name]) for name in expected} | {"x": forward_bar(spreads)}
    if case in CONDITIONED and any(errors[name] > bars[name] for name in expected if name != "v"):
        # one permutation is one sample: ask also what an ulp in the inputs does to this scene
        moved = sensitivities(*row)
        spreads = {name: max(spreads[name], moved[name]) for name in expected}
    scale = float(expected["x"].abs().max()) / scene.case.time_step
    velocity = max(float((r["v"] - expected["v"]).abs().max()) for r in results) / scale
    MEASURED[(place, *row)] = result = Measurement(errors, spreads, zeros, velocity)
    return result


def may_vanish(case: str, name: str, sweeps: int) -> bool:
    """Whether a gradient is zero by construction."""
    c = CASES[case]
    if sweeps == 0:  # the step is its predictor: tets do not enter, masses only where a force acts, and other energies
        # only through the correction of a free body
        if not c.pinned and (c.floor is not None or c.anchor is not None):
            return name in ("grad_mu", "grad_lam", "grad_prescribed", "grad_floor_barrier.damping")
        massless = ("grad_density", "grad_rest_points") if c.force == 0 else ()
        energies = name.startswith(("grad_floor_barrier", "grad_anchor"))
        if c.pinned and name in ("grad_gravity", "grad_force", "grad_density", "grad_rest_points"):
            return True  # x + h v, where the body is stiff: no load has a say
        return energies or name in ("grad_mu", "grad_lam", *massless) or (name == "grad_prescribed" and not c.pinned)
    return (name == "grad_prescribed" and not c.pinned) or (case == "floor_inactive" and "floor_barrier" in name)


def check(place: str, case: str, kind: str, size: str, sweeps: int, steps: int) -> None:
    m = measure(place, case, kind, size, sweeps, steps)
    forward = forward_bar(m.spreads)
    assert m.errors["x"] <= forward, f"x: {m.errors['x']:.1e} > {forward:.1e}"
    assert m.velocity_error <= forward, f"v: {m.velocity_error:.1e} > {forward:.1e}"
    missing = [name for name in m.zeros if not may_vanish(case, name, sweeps)]
    assert not missing, f"gradients that must not vanish: {missing}"
    failures = [
        f"{name}: error {m.errors[name]:.1e} > bar {testing.bar(m.spreads[name]):.1e}"
        for name in m.gradients
        if not m.errors[name] <= testing.bar(m.spreads[name])
    ]
    assert not failures, "; ".join(failures)


@pytest.fixture(scope="module", autouse=True)
def table(request: pytest.FixtureRequest):
    """Prints the worst scene of each case when the module is done."""
    yield
    manager = request.config.pluginmanager
    terminal, capture = manager.getplugin("terminalreporter"), manager.getplugin("capturemanager")
    if terminal is None or not MEASURED:
        return
    titles = f"{'worst scene of a case':<36}{'K':>3}{'steps':>6}  {'device':<11}"
    lines = [f"{titles}{'gradient':<22}{'error':>9}{'spread':>9}{'bar':>9}"]
    for place, case in itertools.product(sorted({key[0] for key in MEASURED}), CASES):
        rows = [(key, m) for key, m in MEASURED.items() if key[:2] == (place, case)]
        if not rows:
            continue
        key, m = max(rows, key=lambda row: row[1].errors[row[1].worst] / testing.bar(row[1].spreads[row[1].worst]))
        name = m.worst
        lines.append(
            f"{'-'.join(key[1:4]):<36}{key[4]:>3}{key[5]:>6}  {place:<11}{name[5:]:<22}{m.errors[name]:>9.1e}"
            f"{m.spreads[name]:>9.1e}{testing.bar(m.spreads[name]):>9.1e}"
        )
    with capture.global_and_fixture_disabled():
        terminal.write_line("")
        for line in lines:
            terminal.write_line(line)


def pairwise() -> list[tuple]:
    """Each case with every sweep count; mesh kinds and steps rotate, so that all pairs of them occur."""
    rows = []
    for i, case in enumerate(CASES):
        for j, sweeps in enumerate(SWEEPS):
            steps = (1, 4)[(i + j) % 2] if sweeps < 20 or i % 4 == 0 else 1
            rows.append((case, KINDS[(i + j) % 3], "small", sweeps, steps))
        rows.append((case, KINDS[i % 3], "medium", 1, 1))
        rows.append((case, KINDS[(i + 1) % 3], "medium", 5, 1))
    rows += [("plain", "delaunay", "large", 2, 1), ("paper", "random", "large", 1, 4)]
    rows += [("floor_filtered", "structured", "large", 5, 1), ("inverted", "delaunay", "large", 1, 1)]
    return rows


DEFAULT = pairwise()


@pytest.mark.parametrize(("case", "kind", "size", "sweeps", "steps"), DEFAULT)
def test_step_and_rollout(device: str, case: str, kind: str, size: str, sweeps: int, steps: int) -> None:
    check(device, case, kind, size, sweeps, steps)


@pytest.mark.slow
@pytest.mark.parametrize("steps", (1, 4))
@pytest.mark.parametrize("sweeps", SWEEPS)
@pytest.mark.parametrize("size", ("small", "medium"))
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("case", CASES)
def test_full_product(device: str, case: str, kind: str, size: str, sweeps: int, steps: int) -> None:
    check(device, case, kind, size, sweeps, steps)


@pytest.mark.slow
@pytest.mark.parametrize("sweeps", (1, 5))
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("case", CASES)
def test_full_product_large(device: str, case: str, kind: str, sweeps: int) -> None:
    check(device, case, kind, "large", sweeps, 1)


def test_headline(device: str) -> None:
    """Scenes that rounding leaves alone (spread <= 1e-13): the worst gradient of each, and the typical one."""
    errors = {}
    for row in DEFAULT:
        m = measure(device, *row)
        if row[3] > 0 and m.spread <= tolerance("headline_spread"):
            errors[row] = max(m.errors[name] for name in m.gradients)
    ordered = sorted(errors.values())
    worst = max(errors, key=lambda row: errors[row])
    print(f"{len(errors)} scenes, median {ordered[len(errors) // 2]:.1e}, worst {ordered[-1]:.1e} in {worst}")
    assert len(errors) >= 100
    assert ordered[len(errors) // 2] <= tolerance("headline_median")
    assert ordered[-1] <= tolerance("headline_worst")


BATCHED = {  # shapes of each argument over scenes [2, 3]; V vertices, T tets, P planes
    "own": {"mu": (2, 3, "T"), "lam": (2, 3, "T"), "density": (2, 3, "T"), "force": (2, 3, "V", 3),
            "gravity": (2, 3, "V", 3), "prescribed": (2, 3, "V", 3), "rest_points": (2, 3, "V", 3),
            "floor_barrier.kappa": (2, 3), "floor_barrier.height": (2, 3, "P"), "floor_barrier.normal": (2, 3, "P", 3),
            "anchor.stiffness": (2, 3, "V"), "anchor.points": (2, 3, "V", 3)},
    "shared": {"mu": (1,), "lam": ("T",), "density": (1,), "force": (1, 3), "gravity": (3,), "prescribed": ("V", 3),
               "rest_points": ("V", 3), "floor_barrier.kappa": (), "floor_barrier.height": ("P",),
               "floor_barrier.normal": ("P", 3), "anchor.stiffness": ("V",), "anchor.points": ("V", 3)},
    "mixed": {"mu": (2, 3, 1), "lam": (3, 1), "density": (2, 1, 1), "force": (3, 1, 3), "gravity": (2, 1, 1, 3),
              "prescribed": (3, "V", 3), "rest_points": (2, 1, "V", 3), "floor_barrier.dhat": (3,),
              "floor_barrier.damping": (2, 1), "floor_barrier.height": (3, "P"), "anchor.points": (2, 1, "V", 3)},
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
    time_step, parameters = base.pop("time_step"), base.pop("parameters")
    parameters |= {"floor_barrier.normal": torch.tensor(planes), "floor_barrier.height": torch.tensor([-0.06, -0.7]),
                   "floor_barrier.damping": torch.tensor(20.0)}  # fmt: skip
    base["gravity"] = base["gravity"].expand_as(base["force"])
    inputs: dict[str, Any] = {"time_step": time_step, "parameters": {}}
    inputs |= {name: shaped(base[name], (2, 3, "V", 3)) for name in ("x", "v")}
    for name, shape in BATCHED[shapes].items():
        place = inputs["parameters"] if "." in name else inputs
        place[name] = shaped((parameters if "." in name else base)[name].double(), shape)
    return model, inputs, testing.reference_result(model, inputs, sweeps)


def check_shapes(device: str, shapes: str, sweeps: int, regime: str | None = None) -> None:
    model, inputs, expected = scene_of_shapes(shapes, sweeps)
    with forced(regime):
        result = compiled_result(model.to(device), testing.on_device(inputs, device), sweeps, 1, "full")
    assert relative_error(result["x"], expected["x"]) <= tolerance("forward")
    for name in expected:
        assert result[name].any(), name
        if name.startswith("grad_"):
            assert relative_error(result[name], expected[name]) <= tolerance("adjoint"), name


@pytest.mark.parametrize("sweeps", (1, 3))
@pytest.mark.parametrize("shapes", BATCHED)
def test_every_shape_of_every_argument(device: str, shapes: str, sweeps: int) -> None:
    """Values shared by scenes, or by tets, or of each: the gradient has the argument's own shape and the right sum."""
    check_shapes(device, shapes, sweeps)


def test_values_per_step(device: str) -> None:
    """Forces and prescribed positions that change from step to step."""
    scene = build_scene("plain", "delaunay", "small")
    model, inputs = scene.model(), scene.inputs()
    rng, steps = generator("per step"), 3
    forces = torch.as_tensor(rng.standard_normal((steps, *inputs["force"].shape)))
    held = inputs.pop("prescribed") + torch.as_tensor(1e-3 * rng.standard_normal((steps, *inputs["force"].shape)))
    inputs |= {"force": forces, "held": held}

    def of_reference(force: Tensor, held: Tensor, **options: Any) -> tuple[Tensor, Tensor]:
        end = reference.rollout(model, steps=steps, sweeps=2, force_per_step=force, prescribed_per_step=held, **options)
        return end.x[-1], end.v[-1]

    def of_package(force: Tensor, held: Tensor, **options: Any) -> tuple[Tensor, Tensor]:
        end = dv.rollout(there, steps=steps, sweeps=2, force=dv.per_step(force), prescribed=dv.per_step(held),
                         checkpoint_every=2, **options)  # fmt: skip
        return end.x[-1], end.v[-1]

    there = model.to(device)
    expected = evaluate(of_reference, inputs)
    result = evaluate(of_package, testing.on_device(inputs, device))
    assert relative_error(result["x"], expected["x"]) <= tolerance("forward")
    for name in (n for n in expected if n.startswith("grad_")):
        assert result[name].any(), name
        assert relative_error(result[name], expected[name]) <= tolerance("adjoint"), name
    assert all(result["grad_force"][k].any() and result["grad_held"][k].any() for k in range(steps))


def test_constants_equal_parameters(device: str) -> None:
    """The numbers of a Model's energies and the same numbers given as parameters are the same to the bit."""
    scene = build_scene("anchored", "random", "small")
    model, inputs = scene.model(device), scene.inputs(device=device)
    given = dv.step(model, sweeps=2, **inputs)
    constant = dv.step(model, sweeps=2, **{name: value for name, value in inputs.items() if name != "parameters"})
    assert torch.equal(given[0], constant[0]) and torch.equal(given[1], constant[1])
