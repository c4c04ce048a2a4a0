"""Claim: no executed sweep brings a vertex to a plane; with the exact block no sweep raises the potential."""

import itertools
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd import ops, reference
from diffvbd._common.constants import FILTER_ETA
from diffvbd.model.system import system_of
from diffvbd.ops.sweep import sweep
from diffvbd.testing import build_scene, generator, on_device, relative_error, structured, tolerance

# --- the step filter -------------------------------------------------------------------------------------------------

PLANES = {  # each keeps the unit cube above every plane at height 0
    "floor": ((0.0, 1.0, 0.0),),
    "tilted": ((0.3, 0.9, -0.3),),
    "wedge": ((0.6, 0.8, 0.0), (-0.6, 0.8, 0.0)),
    "corner": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.5, 0.6, 0.7)),
}
SPEEDS = (0.0, 1.0, 1e2, 1e4, 1e6)  # [m/s]


def gaps(model: dv.Model, x: Tensor) -> Tensor:
    """Distances to all planes [..., V, P], in float64 from the very numbers that the kernels read."""
    count = model.floor.count()
    planes = model._energy_data[0, :count].reshape(-1, 7).double()
    return x.double() @ planes[:, :3].T - planes[:, 3]


def falling(
    device: str, planes: str, height: float, dtype: torch.dtype, clearance: float = 0.05, **floor: Any
) -> tuple[dv.Model, Tensor, Tensor]:
    """A cube `clearance` above the planes, one scene for each of SPEEDS, thrown towards all planes at once."""
    points, tets = structured((2, 2, 2))
    normals = np.array([np.divide(n, np.linalg.norm(n)) for n in PLANES[planes]])
    lowest = (points @ normals.T).min(0)
    heights = tuple(lowest - clearance + height)
    points = points + height * np.linalg.lstsq(normals, np.ones(len(normals)), rcond=None)[0]
    heights = tuple((points @ normals.T).min(0) - clearance) if height else heights
    energies = (dv.StableNeoHookean(), dv.FloorBarrier(height=heights, normal=PLANES[planes], **floor))
    model = dv.Model(dv.TetMesh(points, tets), pinned=[0], energies=energies, dtype=dtype, device=device)
    x = model.rest_points.expand(len(SPEEDS), -1, -1).clone()
    down = -torch.as_tensor(normals.sum(0) / np.linalg.norm(normals.sum(0)), dtype=dtype, device=device)
    v = torch.tensor(SPEEDS, dtype=dtype, device=device)[:, None, None] * down
    v = v * (1 + 0.3 * torch.as_tensor(generator("fall").uniform(-1, 1, tuple(x.shape))).to(x))
    return model, x, v


def check_all_sweeps(model: dv.Model, x: Tensor, v: Tensor, sweeps: list[int], gravity: Any = None,
                     **options: Any) -> None:  # fmt: skip
    """A step of K sweeps is a prefix of one of K + 1, so the states after every sweep are the steps of 0, 1, ... K."""
    free = ~model.pinned
    assert (gaps(model, x)[..., free, :] > 0).all()
    previous = gaps(model, x)[..., free, :]
    for k in sweeps:
        end, _ = dv.step(model, x, v, dv.VBD(1 / 60, k, **options), mu=1e4, lam=2e4, gravity=gravity)
        gap = gaps(model, end)[..., free, :]
        assert torch.isfinite(end).all()
        assert (gap > 0).all(), f"sweep {k}: gap {float(gap.min()):.3g}"
        if sweeps == list(range(len(sweeps))) and x.dtype == torch.float64:
            # one update, or the predictor, closes at most eta of each gap; rounding moves it by ulps of the position
            ulps = 64 * torch.finfo(x.dtype).eps * float(end.abs().max())
            assert (gap >= (1 - FILTER_ETA) * previous - ulps).all()
            previous = gap


@pytest.mark.parametrize("dtype", (torch.float64, torch.float32), ids=("float64", "float32"))
@pytest.mark.parametrize("planes", PLANES)
@pytest.mark.parametrize(("kappa", "dhat"), ((400.0, 0.02), (0.0, 0.1), (1e9, 1e3), (1e-6, 1e-6), (1e12, 1e-3)))
def test_no_sweep_reaches_a_plane(device: str, planes: str, kappa: float, dhat: float, dtype: torch.dtype) -> None:
    model, x, v = falling(device, planes, 0.0, dtype, kappa=kappa, dhat=dhat, damping=8.0)
    check_all_sweeps(model, x, v, list(range(12)))
    check_all_sweeps(model, x, v, [20, 50])


@pytest.mark.parametrize("clearance", (1e-3, 1e-9, 1e-14))
def test_no_sweep_closes_a_gap_of_few_ulps(device: str, clearance: float) -> None:
    model, x, v = falling(device, "floor", 0.0, torch.float64, clearance=clearance)
    check_all_sweeps(model, x, v, list(range(6)), gravity=(0.0, -1e6, 0.0))


@pytest.mark.parametrize(("relaxation", "saturation", "block"), ((1.9, None, "exact"), (1.6, 0.05, "paper")))
def test_no_sweep_reaches_a_plane_under_other_safeguards(
    device: str, relaxation: float, saturation: Any, block: str
) -> None:
    model, x, v = falling(device, "wedge", 0.0, torch.float64)
    check_all_sweeps(model, x, v, list(range(10)), relaxation=relaxation, saturation=saturation, block=block)


@pytest.mark.parametrize("below", (0.0, 1e-3, 10.0))
def test_start_below_a_plane_names_the_vertices(device: str, value_checks: None, below: float) -> None:
    model, x, v = falling(device, "floor", 0.0, torch.float64)
    x, v = x[:1].clone(), v[:1]
    x[0, [5, 7], 1] = -0.05 - below
    with pytest.raises(ValueError, match=r"x: .*above floor plane 0.* 2 .*scene 0.*(5, 7|7, 5)"):
        dv.step(model, x, v, dv.VBD(1 / 60, 1), mu=1e4, lam=2e4)
    x[0, [5, 7], 1] = 0.0
    x[0, 0, 1] = -1.0  # pinned: it may be anywhere
    dv.step(model, x, v, dv.VBD(1 / 60, 1), mu=1e4, lam=2e4)


# --- descent ---------------------------------------------------------------------------------------------------------

DESCENT = ("plain", "soft", "stiff", "contrast", "no_shear", "inverted", "violent", "tiny", "huge")


def predictor(model: dv.Model, inputs: dict[str, Any], h: float) -> Tensor:
    """What step() aims at without forces of deformation."""
    x, v = inputs["x"], inputs["v"]
    return torch.where(model.pinned[:, None], inputs["prescribed"], x + h * v + h**2 * inputs["gravity"])


def states(
    device: str, case: str, sweeps: int, **options: Any
) -> tuple[dv.Model, dict[str, Any], Tensor, list[Tensor]]:
    """Model, arguments of the potential, predictor, and the positions after 0, 1, ... sweeps; all on the CPU."""
    scene = build_scene(case, "random", "small")
    energies = (dv.StableNeoHookean(), dv.Anchor(1.0))
    model = dv.Model(dv.TetMesh(scene.points, scene.tets), density=torch.from_numpy(scene.arrays["density"]),
                     pinned=torch.from_numpy(scene.pinned), energies=energies)  # fmt: skip
    inputs, h = scene.inputs(), scene.case.time_step
    given = {name: inputs[name] for name in ("x", "v", "mu", "lam", "gravity", "prescribed")}
    there, given = model.to(device), on_device(given, device)
    solvers = [dv.VBD(h, k, start="predictor", **options) for k in range(sweeps + 1)]
    path = [dv.step(there, solver=solver, **given)[0].cpu() for solver in solvers]
    return model, {"mu": inputs["mu"], "lam": inputs["lam"], "time_step": h}, predictor(model, inputs, h), path


@pytest.mark.parametrize("relaxation", (0.5, 1.0, 1.5, 1.9))
@pytest.mark.parametrize("case", DESCENT)
def test_no_sweep_raises_the_potential(device: str, case: str, relaxation: float) -> None:
    model, options, y, path = states(device, case, 12, relaxation=relaxation)
    assert relative_error(path[0], y) <= tolerance("ulps")
    potential = [float(reference.incremental_potential(model, x, y, **options)) for x in path]
    assert potential[1] < potential[0] and potential[-1] < potential[1]
    # mu J of a tet cancels against its |F|^2: the sum is known to ulps of these terms
    rounding = 1e-14 * abs(float(reference.incremental_potential(model, 0 * y, y, **options)))
    assert all(b <= a + rounding for a, b in itertools.pairwise(potential)), np.diff(potential)


@pytest.mark.parametrize("sweeps", (1, 4))
@pytest.mark.parametrize("case", DESCENT)
def test_an_update_minimises_in_its_vertex(device: str, case: str, sweeps: int) -> None:
    """After a sweep the gradient vanishes at the color that moved last."""
    model, options, y, path = states(device, case, sweeps)
    last = model.color_vertices[int(model.color_ptr[-2]) :]
    before = reference.residual(model, path[0], y, **options)
    after = reference.residual(model, path[-1], y, **options)
    terms = float(before.abs().max() + (model.mass[:, None] * y).abs().max())  # m x - m y + elastic
    assert float(after[last].abs().max()) <= tolerance("block_residual") * terms
    assert float(after.abs().max()) > 100 * float(after[last].abs().max())  # elsewhere it has not vanished


def test_an_update_forgets_where_its_vertex_was(device: str) -> None:
    """The first color moves away from any start to the same place; the adjoint of that start is zero."""
    scene = build_scene("violent", "delaunay", "small")
    model, inputs = scene.model(device), scene.inputs(device=device)
    first = model.color_vertices[: int(model.color_ptr[1])]
    y = predictor(model, inputs, scene.case.time_step)[None]

    def swept(start: Tensor, sweeps: int) -> Tensor:
        fields = ops.SweepFields(start, start.detach(), y, inputs["mu"][None], inputs["lam"][None], model.mass[None],
                                 None, model._energy_data)  # fmt: skip
        settings = system_of(model, scene.solver(sweeps)).settings(scene.case.time_step, sweeps)
        return sweep(fields, model._packed_rest, model._plan, settings, tape_policy=ops.FULL_TAPE)[0]

    other = y.clone()
    other[:, first] += 3.0 * torch.as_tensor(generator("other").standard_normal((1, len(first), 3)), device=device)
    assert relative_error(swept(other, 1), swept(y, 1)) <= tolerance("forward")
    start = other.clone().requires_grad_()
    weights = torch.as_tensor(generator("weights").standard_normal(tuple(y.shape)), device=device)
    (gradient,) = torch.autograd.grad((weights * swept(start, 2)).sum(), start)
    elsewhere = torch.ones(model.num_vertices, dtype=torch.bool, device=device).index_fill(0, first, False)
    own, others = gradient[:, first], gradient[:, elsewhere]
    assert float(others.abs().max()) > 0.1
    assert float(own.abs().max()) <= tolerance("block_residual") * float(others.abs().max())


# --- bounds ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("relaxation", (1.0, 1.6))
@pytest.mark.parametrize("saturation", (1e-3, 0.1, 10.0))
@pytest.mark.parametrize("case", ("plain", "violent", "huge_strain"))
def test_saturation_bounds_every_update(device: str, case: str, saturation: float, relaxation: float) -> None:
    model, _, _, path = states(device, case, 8, saturation=saturation, relaxation=relaxation)
    moved = [float((b - a).norm(dim=-1).max()) for a, b in itertools.pairwise(path)]
    rounding = 8 * torch.finfo(torch.float64).eps * float(path[0].abs().max())
    assert all(0 < m <= relaxation * saturation + rounding for m in moved)
    if case != "plain":
        assert max(moved) > 0.5 * relaxation * min(saturation, 1.0)  # the bound is reached, not merely kept


@pytest.mark.parametrize("strain", (1e2, 1e4, 1e6, 1e8))
def test_extreme_strain_stays_finite(device: str, strain: float) -> None:
    """Blocks m I + s q q^T with s far beyond m / eps: a pivot is never below m, whatever rounding says."""
    points, tets = structured((1, 1, 1))
    model = dv.Model(
        dv.TetMesh(points[tets[0]], [[0, 1, 2, 3]]), device=device
    )  # stars of one tet: no other tet lifts the rank
    noise = torch.as_tensor(generator("strain").standard_normal((64, model.num_vertices, 3)), device=device)
    x = (model.rest_points + strain * noise).requires_grad_()
    mu = torch.tensor(1e4, dtype=torch.float64, device=device, requires_grad=True)
    end, v = dv.step(model, x, torch.zeros_like(x), dv.VBD(1 / 60, 2), mu=mu, lam=2e4)
    assert torch.isfinite(end).all() and torch.isfinite(v).all()
    for gradient in torch.autograd.grad(end.sum(), (x, mu)):
        assert torch.isfinite(gradient).all()
