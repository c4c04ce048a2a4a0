"""Claim: the compiled step and its reverse sweep equal autograd through an independent execution of the same sweep.

For every scene the forward comes first, then each gradient, within the bars of helpers/exactness.py. A table of the
worst scene of each case and device is printed at the end.
"""

import itertools
from typing import Any

import pytest
import torch
from helpers.exactness import BATCHED, MEASURED, check, check_shapes, measure
from helpers.marks import slow
from torch import Tensor

import diffvbd as dv
from diffvbd import reference, testing
from diffvbd.testing import CASES, KINDS, build_scene, evaluate, generator, relative_error, tolerance

SWEEPS = (0, 1, 2, 5, 20)


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
        key, m = max(rows, key=lambda row: row[1].errors[row[1].worst] / row[1].bar(row[1].worst))
        name = m.worst
        spread = f"{m.spreads[name]:.1e}" if "spreads" in vars(m) else "unasked"
        lines.append(
            f"{'-'.join(key[1:4]):<36}{key[4]:>3}{key[5]:>6}  {place:<11}{name[5:]:<22}{m.errors[name]:>9.1e}"
            f"{spread:>9}{m.bar(name):>9.1e}"
        )
    with capture.global_and_fixture_disabled():
        terminal.write_line("")
        for line in lines:
            terminal.write_line(line)


def pairwise() -> tuple[list[tuple], list[tuple]]:
    """Quick rows and slow ones: each case with every sweep count; mesh kinds and steps rotate, so that all their pairs
    occur. One sweep is always quick; longer runs and larger meshes are so for every twelfth case."""
    rows, quick = [], []
    for i, case in enumerate(CASES):
        for j, sweeps in enumerate(SWEEPS):
            steps = (1, 4)[(i + j) % 2] if sweeps < 20 or i % 4 == 0 else 1
            rows.append((case, KINDS[(i + j) % 3], "small", sweeps, steps))
        rows.append((case, KINDS[i % 3], "medium", 1, 1))
        rows.append((case, KINDS[(i + 1) % 3], "medium", 5, 1))
    for case, kind, size, sweeps, steps in rows:
        short = size == "small" and (sweeps == 1 or (sweeps < 20 and steps == 1))
        if short or list(CASES).index(case) % 12 == 0:
            quick.append((case, kind, size, sweeps, steps))
    rows += [("plain", "delaunay", "large", 2, 1), ("paper", "random", "large", 1, 4)]
    rows += [("floor_filtered", "structured", "large", 5, 1), ("inverted", "delaunay", "large", 1, 1)]
    return quick, [row for row in rows if row not in quick]


QUICK, SLOW = pairwise()


@pytest.mark.parametrize(("case", "kind", "size", "sweeps", "steps"), [*QUICK, *(slow(*row) for row in SLOW)])
def test_step_and_rollout(device: str, case: str, kind: str, size: str, sweeps: int, steps: int) -> None:
    check(device, case, kind, size, sweeps, steps)


@pytest.mark.hours
@pytest.mark.parametrize("steps", (1, 4))
@pytest.mark.parametrize("sweeps", SWEEPS)
@pytest.mark.parametrize("size", ("small", "medium"))
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("case", CASES)
def test_full_product(device: str, case: str, kind: str, size: str, sweeps: int, steps: int) -> None:
    check(device, case, kind, size, sweeps, steps)


@pytest.mark.hours
@pytest.mark.parametrize("sweeps", (1, 5))
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("case", CASES)
def test_full_product_large(device: str, case: str, kind: str, sweeps: int) -> None:
    check(device, case, kind, "large", sweeps, 1)


@pytest.mark.slow
def test_headline(device: str) -> None:
    """Scenes that rounding leaves alone (spread <= 1e-13): the worst gradient of each, and the typical one."""
    errors = {}
    for row in [*QUICK, *SLOW]:
        m = measure(device, *row)
        if row[3] > 0 and m.spread <= tolerance("headline_spread"):
            errors[row] = max(m.errors[name] for name in m.gradients)
    ordered = sorted(errors.values())
    worst = max(errors, key=lambda row: errors[row])
    print(f"{len(errors)} scenes, median {ordered[len(errors) // 2]:.1e}, worst {ordered[-1]:.1e} in {worst}")
    assert len(errors) >= 100
    assert ordered[len(errors) // 2] <= tolerance("headline_median")
    assert ordered[-1] <= tolerance("headline_worst")


@pytest.mark.parametrize("sweeps", (1, 3))
@pytest.mark.parametrize("shapes", BATCHED)
def test_every_shape_of_every_argument(device: str, shapes: str, sweeps: int) -> None:
    """Values shared by scenes, or by tets, or of each: the gradient has the argument's own shape and the right sum."""
    check_shapes(device, shapes, sweeps)


def test_values_per_step(device: str) -> None:
    """Forces and prescribed positions that change from step to step."""
    scene = build_scene("plain", "delaunay", "small")
    model, inputs, solver = scene.model(), scene.inputs(), scene.solver(2)
    rng, steps = generator("per step"), 3
    forces = torch.as_tensor(rng.standard_normal((steps, *inputs["force"].shape)))
    held = inputs.pop("prescribed") + torch.as_tensor(1e-3 * rng.standard_normal((steps, *inputs["force"].shape)))
    inputs |= {"force": forces, "held": held}

    def of_reference(force: Tensor, held: Tensor, **options: Any) -> tuple[Tensor, Tensor]:
        end = reference.rollout(
            model, solver=solver, steps=steps, force_per_step=force, prescribed_per_step=held, **options
        )
        return end.x[-1], end.v[-1]

    def of_package(force: Tensor, held: Tensor, **options: Any) -> tuple[Tensor, Tensor]:
        end = dv.rollout(there, solver=solver, steps=steps, force=dv.per_step(force), prescribed=dv.per_step(held),
                         checkpoint_every=2, **options)  # fmt: skip
        return end.x[-1], end.v[-1]

    there = model.to(device)
    expected = evaluate(of_reference, inputs, solver.time_step)
    result = evaluate(of_package, testing.on_device(inputs, device), solver.time_step)
    assert relative_error(result["x"], expected["x"]) <= tolerance("forward")
    for name in (n for n in expected if n.startswith("grad_")):
        assert result[name].any(), name
        assert relative_error(result[name], expected[name]) <= tolerance("adjoint"), name
    assert all(result["grad_force"][k].any() and result["grad_held"][k].any() for k in range(steps))


def test_constants_equal_parameters(device: str) -> None:
    """The numbers of a Model's energies and the same numbers given as parameters are the same to the bit."""
    scene = build_scene("anchored", "random", "small")
    model, inputs = scene.model(device), scene.inputs(device=device)
    given = dv.step(model, solver=scene.solver(2), **inputs)
    without = {k: value for k, value in inputs.items() if not k.startswith(("floor_", "anchor_"))}
    assert len(without) < len(inputs)
    constant = dv.step(model, solver=scene.solver(2), **without)
    assert torch.equal(given[0], constant[0]) and torch.equal(given[1], constant[1])
