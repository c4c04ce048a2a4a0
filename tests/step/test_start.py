"""Claim: where a step starts. A body that is not corrected starts, under "auto", from y or from x + h v, whichever has
the lower incremental potential: each body and scene for itself, and its gradient is that of the start it took."""

from typing import Any

import pytest
import torch
from torch import Tensor

import diffvbd as dv
from diffvbd import reference
from diffvbd.model.system import system_of
from diffvbd.testing import generator, relative_error, tolerance

STEP = 1 / 60
MESH = dv.mesh.beam(6, 3, 3, size=(0.5, 0.2, 0.2))
STARTS = ("predictor", "inertia")
SOFT, STIFF = 1e2, 1e7  # [Pa]
PAIRS = (dv.StableNeoHookean(), dv.PairBarrier(1e3, 1e-2))


def model_of(device: str, mesh: dv.TetMesh = MESH, **options: Any) -> dv.Model:
    return dv.Model(mesh, pinned=mesh.points[:, 0] < 1e-9, device=device, **options)


def moving(model: dv.Model) -> tuple[Tensor, Tensor]:
    """A bent body that moves: no start is the other, and none is at rest."""
    noise = torch.from_numpy(generator("start").uniform(-1, 1, (2, model.num_vertices, 3))).to(model.device)
    x = model.rest_points + 1e-3 * noise[0]
    return x, 0.02 * torch.where(model.pinned[:, None], 0.0, noise[1])


def start_of(start: Any, device: str, x: Tensor, v: Tensor, mesh: dv.TetMesh = MESH, **options: Any) -> Tensor:
    """Where a step's sweeps start: a step without sweeps."""
    return dv.step(model_of(device, mesh), x, v, dv.VBD(STEP, 0, start=start), **options)[0]


@pytest.mark.parametrize("floor", (False, True))
@pytest.mark.parametrize(("mu", "wanted"), ((SOFT, "predictor"), (3e3, None), (STIFF, "inertia")))
def test_auto_takes_the_lower_potential(device: str, mu: float, wanted: str | None, floor: bool) -> None:
    energies: tuple[Any, ...] = (dv.StableNeoHookean(), dv.Anchor(10.0))
    energies += (dv.FloorBarrier(height=-2e-3, kappa=40.0, dhat=0.01),) if floor else ()
    model = model_of(device, energies=energies)
    x, v = moving(model)
    options = {"mu": mu, "lam": 1.5 * mu}
    solvers = {start: dv.VBD(STEP, 0, start=start) for start in ("auto", *STARTS)}
    at = {start: dv.step(model, x, v, solver, **options)[0].cpu() for start, solver in solvers.items()}
    plain = model.to("cpu")
    y = x + STEP * v + STEP**2 * torch.tensor([0.0, -9.81, 0.0], dtype=x.dtype, device=device)
    y = torch.where(model.pinned[:, None], x, y).cpu()
    held_back = relative_error(at["predictor"], y)
    assert held_back > 1e-4 if floor else held_back <= tolerance("ulps")
    assert relative_error(at["predictor"], at["inertia"]) > 1e-4
    potential = {start: float(reference.incremental_potential(plain, at[start], y, x_prev=x.cpu(), time_step=STEP,
                                                                 **options))
                 for start in STARTS}  # fmt: skip
    lower = min(STARTS, key=lambda start: potential[start])
    assert wanted in (lower, None)
    assert torch.equal(at["auto"], at[lower])


def two_beams() -> dv.TetMesh:
    return dv.mesh.join([MESH, MESH.translate((0.0, 0.0, 1.0))])


def by_tet(*mu: float, device: str) -> Tensor:
    """A modulus for each body, by tet."""
    return torch.tensor(mu, dtype=torch.float64, device=device).repeat_interleave(MESH.num_tets)


def test_bodies_and_scenes_choose_for_themselves(device: str) -> None:
    mesh, half = two_beams(), MESH.num_vertices
    x, v = moving(model_of(device, mesh))
    mu = torch.stack([by_tet(SOFT, STIFF, device=device), by_tet(STIFF, SOFT, device=device)])
    xs, vs = x.repeat(2, 1, 1), v.repeat(2, 1, 1)
    auto, y, extrapolation = (start_of(start, device, xs, vs, mesh, mu=mu, lam=1.5 * mu) for start in ("auto", *STARTS))
    first, second = slice(None, half), slice(half, None)
    assert torch.equal(auto[0, first], y[0, first]) and torch.equal(auto[0, second], extrapolation[0, second])
    assert torch.equal(auto[1, first], extrapolation[1, first]) and torch.equal(auto[1, second], y[1, second])
    assert min(float((y - extrapolation)[:, rows].abs().max()) for rows in (first, second)) > 1e-3
    alone = start_of("auto", device, x, v, mesh, mu=mu[1], lam=1.5 * mu[1])
    assert torch.equal(alone, auto[1])


@pytest.mark.parametrize(("mu", "taken"), ((SOFT, "predictor"), (STIFF, "inertia")))
@pytest.mark.parametrize("sweeps", (0, 3))
def test_gradients_are_those_of_the_start_that_was_taken(device: str, mu: float, taken: str, sweeps: int) -> None:
    results = []
    for start in ("auto", taken):
        model = model_of(device)
        x, v = moving(model)
        given = {"x": x, "v": v, "mu": torch.full((model.num_tets,), mu).to(x), "force": 0.1 * torch.sin(40 * x)}
        given["gravity"] = torch.tensor([0.0, -9.81, 1.0], dtype=x.dtype, device=device)
        leaves: dict[str, Any] = {name: t.clone().requires_grad_() for name, t in given.items()}
        end, velocity = dv.step(model, solver=dv.VBD(STEP, sweeps, start=start), **leaves, lam=1.5 * mu)
        loss = (torch.cos(3 * end) * end).sum() + (velocity * torch.sin(end)).sum()
        results.append(
            dict(zip(leaves, torch.autograd.grad(loss, list(leaves.values()), allow_unused=True), strict=True))
        )
    auto, expected = results
    used = {name for name, bar in expected.items() if bar is not None and bar.any()}
    # without sweeps x + h v knows neither loads nor material
    unused = set() if sweeps else {"mu"} | ({"force", "gravity"} if taken == "inertia" else set())
    assert used == set(auto) - unused
    for name, bar in expected.items():
        if name in used:
            assert relative_error(auto[name], bar) <= tolerance("formula"), name
        else:
            assert auto[name] is None or not auto[name].any(), name


def test_what_is_executed(device: str) -> None:
    """`starts_from`: there is nothing to choose where every body is corrected; beside pairs a step chooses itself."""
    free, held = dv.Model(MESH, device=device), model_of(device)
    friction = model_of(device, energies=(dv.StableNeoHookean(), dv.FloorBarrier(height=-1.0), dv.Friction(0.3)))
    pairs = model_of(device, energies=PAIRS)

    def taken(model: dv.Model, **options: Any) -> str:
        return system_of(model, dv.VBD(STEP, 1, **options)).starts_from

    assert taken(held) == taken(free, subspace=None) == taken(friction) == "auto"
    assert taken(free) == taken(pairs) == "predictor"
    assert all(taken(held, start=start) == start for start in STARTS)


def test_bad_starts(device: str) -> None:
    for start in ("rest", "Auto", None, 1):
        with pytest.raises((ValueError, TypeError), match='^start: expected "auto" or "predictor" or "inertia", got '):
            dv.VBD(STEP, 1, start=start)  # pyright: ignore[reportArgumentType]
    model = model_of(device, energies=PAIRS)
    with pytest.raises(ValueError, match='^start: expected "auto" or "predictor" with a PairBarrier.*"inertia"'):
        dv.step(model, *moving(model), dv.VBD(STEP, 1, start="inertia"), mu=SOFT, lam=SOFT)
